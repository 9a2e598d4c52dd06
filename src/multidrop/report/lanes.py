"""Draw states as lanes: one for each drive, or for each bit of a register of bits, with their names.

A count has different names in different families, so that counts of several drives share no axis.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Patch

from multidrop.report.load import Array, Recording, Series
from multidrop.report.style import TEXT, days, label, line_style, mark_times

# Tol's pale ones: no state has the colour of a drive.
COLOURS = ("#BBCCEE", "#CCDDAA", "#EEEEBB", "#CCEEFF", "#DDDDDD", "#FFCCCC")
HATCHES = ("", "////", "....")  # the colours once more, and again
MOST_LANES = 64  # in one panel
NARROWEST = 1 / 1500  # of the time axis: a shorter state is drawn so wide
LETTER = 1 / 140  # of the time axis: the width of a letter
LANE_INCHES = 0.24
MOST_TEXTS = 50  # with one name, in one lane


@dataclass(frozen=True, eq=False)
class Lane:
    """The states of one drive's register, or of one bit of it, and their times."""

    drive: str
    title: str
    is_bit: bool  # either on or off
    time: Array  # of its rows, ns UTC
    missed: Array
    state: tuple[str, ...]  # of each run of rows that are alike
    begin: Array  # of each of them, ns UTC
    end: Array


def lanes_of(series: Sequence[Series]) -> tuple[list[Lane], int]:
    """Return the lanes of a panel, and how many had no room: bits that were never set are left out first."""
    found = list(chain.from_iterable(map(_lanes, series)))
    if len(found) > MOST_LANES:
        found = [lane for lane in found if lane.state] or found
    return found[:MOST_LANES], max(0, len(found) - MOST_LANES)


def _lanes(series: Series) -> Iterable[Lane]:
    if not series.is_bits:
        return [_lane(series, series.drive, series.value, series.name_of)]
    with np.errstate(invalid="ignore"):  # an infinite value is no count
        is_whole = series.value % 1 == 0
    is_count = is_whole & (series.value >= 0) & (series.value < 2**32)
    counts = np.where(is_count, series.value, 0.0).astype(np.int64)
    seen = int(np.bitwise_or.reduce(counts, initial=0))
    unnamed = {1 << bit: f"bit {bit}" for bit in range(32) if seen >> bit & 1}
    return [
        _lane(
            series,
            f"{series.drive} {name.lower()}",
            np.where(is_count, counts & bit == bit, np.nan),
            {0.0: "", 1.0: name}.__getitem__,
        )
        for bit, name in sorted((unnamed | series.names).items())
        if bit > 0
    ]


def _lane(series: Series, title: str, value: Array, name_of: Callable[[float], str]) -> Lane:
    """Cut the rows into runs of one value; a state lasts until the next row, or until a pause begins."""
    time = series.time
    differs = (value[1:] != value[:-1]) & ~(np.isnan(value[1:]) & np.isnan(value[:-1]))
    cuts = np.flatnonzero(differs | series.pauses)
    begins = np.concatenate([[0], cuts + 1])
    ends = np.concatenate([np.where(series.pauses[cuts], time[cuts], time[cuts + 1]), time[-1:]])
    names = {one: "" if np.isnan(one) else name_of(one) for one in np.unique(value[begins]).tolist()}
    states = [names[one] if one == one else "" for one in value[begins].tolist()]
    named = np.array([bool(state) for state in states])
    return Lane(
        series.drive,
        title,
        series.is_bits,
        time,
        series.missed,
        tuple(state for state in states if state),
        time[begins][named],
        ends[named],
    )


def lanes_inches(lanes: Sequence[Lane]) -> float:
    """Return the height of a panel of these lanes."""
    return 0.45 + LANE_INCHES * len(lanes)


def draw_lanes(axes: Axes, lanes: Sequence[Lane], recording: Recording) -> None:
    """Draw a row for each lane, its states as bars; names that fit nowhere go into a legend."""
    names = dict.fromkeys(state for lane in lanes if not lane.is_bit for state in lane.state)
    styles = {name: _style(number) for number, name in enumerate(names)}
    span = max(recording.end - recording.begin, 1)
    shown: set[str] = set()
    for row, lane in enumerate(lanes):
        of_drive = {"facecolor": line_style(recording.drives.index(lane.drive))["color"], "linewidth": 0}
        for name in _longest_first(lane):
            begin, end = _merged(lane, name, span)
            widths = np.maximum(end - begin, span * NARROWEST)
            bars = list(zip(days(begin), widths / 86400e9, strict=True))
            axes.broken_barh(bars, (row - 0.36, 0.72), **(of_drive if lane.is_bit else styles[name]))
            if not lane.is_bit:
                text = label(name).lower()
                fitting = begin[widths > span * LETTER * (len(text) + 2)][:MOST_TEXTS]
                shown.update([name] if len(fitting) else [])
                for at in days(fitting):
                    name_bar(axes, text, at, row)
        missed = lane.time[lane.missed]
        mark_times(axes, missed, row + 0.4, span // 4000, color=TEXT, markersize=5, markeredgewidth=1.0)
    hidden = [name for name in names if name not in shown]
    if hidden:
        handles = [Patch(label=label(name).lower(), **styles[name]) for name in hidden]
        axes.legend(handles=handles, loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=7, frameon=False)
    axes.set_yticks(range(len(lanes)), [label(lane.title) for lane in lanes], fontsize=8)
    axes.set_ylim(len(lanes) - 0.4, -0.6)
    axes.grid(visible=False, axis="y")


def name_bar(axes: Axes, text: str, at: float, row: int) -> None:
    """Write a name at the begin of a bar, readable also where the bar is shorter."""
    box = {"facecolor": "white", "alpha": 0.75, "pad": 0.8, "linewidth": 0}
    place: dict[str, Any] = {"xytext": (3, 0), "textcoords": "offset points", "va": "center"}
    axes.annotate(text, (at, row), fontsize=7.5, clip_on=True, bbox=box, **place)


def _style(number: int) -> dict[str, Any]:
    hatch = HATCHES[number // len(COLOURS) % len(HATCHES)]
    return {"facecolor": COLOURS[number % len(COLOURS)], "hatch": hatch, "edgecolor": TEXT, "linewidth": 0.5}


def _longest_first(lane: Lane) -> list[str]:
    """Return the states by falling duration: drawn last, short ones are not hidden by long ones."""
    lasting = dict.fromkeys(lane.state, 0)
    for name, length in zip(lane.state, (lane.end - lane.begin).tolist(), strict=True):
        lasting[name] += length
    return sorted(lasting, key=lambda name: -lasting[name])


def _merged(lane: Lane, name: str, span: int) -> tuple[Array, Array]:
    """Return begins and ends of this state, without gaps that are too narrow to be seen."""
    of = np.array([state == name for state in lane.state])
    begin, end = lane.begin[of], lane.end[of]
    apart = np.concatenate([[True], begin[1:] - end[:-1] > span * NARROWEST / 2])
    return begin[apart], end[np.concatenate([apart[1:], [True]])]
