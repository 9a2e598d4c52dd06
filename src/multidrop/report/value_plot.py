"""Draw a recording's values: curves, rows of states (lanes), and marks for faults and missed values."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from multidrop.recording.series import RAW, Array, Event
from multidrop.report.load import Recording, Series
from multidrop.report.style import (
    FAULT,
    GRID,
    MOST_DRIVES,
    TEXT,
    add_legend,
    day,
    days,
    label,
    label_time,
    line_style,
    mark_times,
    new_figure,
    set_title,
)

FIRST = (  # registers whose panels are drawn first, in case not all panels fit
    "output_frequency",
    "output_current",
    "motor_speed",
    "output_torque",
    "output_power",
    "dc_bus_voltage",
    "output_voltage",
    "heatsink_temperature",
)
MOST_PANELS = 8
MOST_POINTS = 4000  # limit of points per curve: more points could not be distinguished
FEW_POINTS = 200  # a curve with at most this many points is drawn with a dot for each
FAULTS = "fault"
MOST_EVENTS = 50  # limit of events, and of steps of a test run, in a picture
STEP = "step"  # kind of the events that mark the steps of a test run
LONGEST_EVENT = 30  # limit of an event's text in a picture

CURVES_INCHES = 1.9


class Panel(NamedTuple):
    """A panel of the picture, for all registers with this name and unit.

    Amperes and per cent, for instance, cannot share an axis.
    """

    register: str
    unit: str
    has_names: bool  # True if the raw values have names and are drawn as states

    @property
    def title(self) -> str:
        return f"{self.register}, {self.unit}" if self.unit else self.register


@dataclass(frozen=True)
class Content:
    """The series of a panel, as curves of numbers or as lanes of states."""

    panel: Panel
    series: list[Series]
    lanes: list[Lane]  # the rows of states; empty if the panel has curves
    hidden: int  # number of lanes for which there is no room

    @property
    def inches(self) -> float:
        return lanes_inches(self.lanes) if self.lanes else CURVES_INCHES


def plot(
    recording: Recording, drives: Sequence[str] = (), registers: Sequence[str] = ()
) -> tuple[Figure, list[str]]:
    """Return a picture of drives and registers (default: all), and the names for which it had no room.

    Raises ValueError for unknown names, and if there is no value to draw.
    """
    chosen = _of_drives(recording, drives, registers)
    wanted = [series for series in chosen if not registers or series.register in registers]
    if not any(series.has_values for series in wanted):
        misses = _reasons(chosen)
        raise ValueError(
            f"there is no value to draw, only failed reads: {misses}; `multidrop report` shows more"
        )
    panels = _panels([series for series in wanted if series.register != FAULTS], registers)
    shown = panels if registers else panels[:MOST_PANELS]
    contents = [_content(panel, chosen) for panel in shown]
    faults = _faults(chosen, is_alone=not shown)
    strip = [0.35 + 0.22 * len(faults)] if faults else []
    figure, axes = new_figure([*strip, *(content.inches for content in contents)], sharex=True)
    if faults:
        _draw_faults(axes[0], faults)
    for content, one in zip(contents, axes[len(strip) :], strict=True):
        _draw(one, content, recording)
        _shade(one, content, faults)
    starts = [Event(max(step.begin, recording.begin), STEP, step.what) for step in recording.steps]
    _mark_events(axes, starts)
    _mark_events(axes, recording.events)
    label_time(axes[-1])
    axes[-1].set_xlim(day(recording.begin), day(max(recording.end, recording.begin + 1_000_000)))
    _add_drives(figure, contents, recording, has_misses=any(series.missed.any() for series in chosen))
    left_out = list(dict.fromkeys(panel.title for panel in panels[len(shown) :]))
    hidden = 0 if drives else len(recording.drives[MOST_DRIVES:])
    return figure, [*left_out, *([f"{hidden} more drives"] if hidden else [])]


# ---- choice of series ----


def _of_drives(recording: Recording, drives: Sequence[str], registers: Sequence[str]) -> list[Series]:
    """Return the series of `drives`, or of the first MOST_DRIVES. Raises ValueError for unknown names."""
    _check("drive", drives, recording.drives)
    shown = set(drives or recording.drives[:MOST_DRIVES])
    chosen = [series for series in recording.series if series.drive in shown]
    _check("register", registers, tuple(dict.fromkeys(series.register for series in chosen)))
    return chosen


def _faults(chosen: Sequence[Series], *, is_alone: bool) -> list[Series]:
    """Return the fault series of drives that had faults.

    If no drive had a fault and the plot has no other panel (`is_alone`), return those of all drives.
    """
    polled = [series for series in chosen if series.register == FAULTS]
    return [series for series in polled if series.faults()] or (polled if is_alone else [])


def _content(panel: Panel, chosen: Sequence[Series]) -> Content:
    series = [one for one in chosen if _panel(one) == panel]
    lanes, hidden = lanes_of(series) if panel.has_names else ([], 0)
    return Content(panel, series, lanes, hidden)


def _panel(series: Series) -> Panel:
    return Panel(series.register, series.unit, bool(series.names))


def _check(what: str, given: Sequence[str], known: Sequence[str]) -> None:
    for name in given:
        if name not in known:
            raise ValueError(f"the recording has no {what} {name!r}; it has {', '.join(known)}")


def _reasons(series: Sequence[Series]) -> str:
    reasons = sum((one.reasons() for one in series), Counter[str]())
    return ", ".join(f"{reason} {count}" for reason, count in reasons.most_common())


def _panels(chosen: Sequence[Series], registers: Sequence[str]) -> list[Panel]:
    """Return a panel for each register and unit.

    The panels are in the order of `registers`, or of FIRST if `registers` is empty.
    """
    found = dict.fromkeys(map(_panel, chosen))
    order = {name: at for at, name in enumerate(registers or FIRST)}
    return sorted(found, key=lambda panel: (order.get(panel.register, len(order)), panel.unit == RAW))


# ---- drawing ----


def _draw(axes: Axes, content: Content, recording: Recording) -> None:
    if content.panel.has_names:
        note = f" ({content.hidden} more lanes: choose with --drive)" if content.hidden else ""
        set_title(axes, f"{label(content.panel.title)}{note}")
        draw_lanes(axes, content.lanes, recording)
    else:
        _draw_curves(axes, content.panel, content.series, recording)


def _add_drives(
    figure: Figure, contents: Sequence[Content], recording: Recording, *, has_misses: bool
) -> None:
    """Add a legend with the drives that have curves, and with the mark of a missed value."""
    curves = {series.drive for content in contents for series in content.series if not series.names}
    handles = [
        Line2D([], [], label=label(name), **line_style(number))
        for number, name in enumerate(recording.drives)
        if name in curves
    ]
    if has_misses:
        handles.append(Line2D([], [], color=TEXT, marker="|", linestyle="", label="missed"))
    add_legend(figure, handles)


def _draw_curves(axes: Axes, panel: Panel, series: Sequence[Series], recording: Recording) -> None:
    too_large = sum(int((np.isnan(one.drawable) & ~one.missed).sum()) for one in series)
    note = f" ({too_large} values of 1e150 and more are not drawn)" if too_large else ""
    set_title(axes, f"{label(panel.title)}{note}")
    for one in series:
        time, value = with_pauses(*thinned(one.time, one.drawable), one.time[:-1][one.pauses])
        style = line_style(recording.drives.index(one.drive))
        marker = "." if len(time) < FEW_POINTS else ""
        axes.plot(days(time), value, linewidth=1.3, marker=marker, markersize=3, **style)
    _mark_misses(axes, series, recording)
    _fit(axes, series)


def _fit(axes: Axes, series: Sequence[Series]) -> None:
    """Scale the y axis.

    Raw counts get whole numbers, a constant value gets room around it, and the axis includes 0 if 0 is near.
    """
    drawn = np.concatenate([one.drawable for one in series])
    seen = drawn[~np.isnan(drawn)]
    if not len(seen):
        axes.set_yticks([])
        axes.text(0.5, 0.5, "no value", transform=axes.transAxes, ha="center", va="center", color=TEXT)
        return
    if all(one.unit in ("", RAW) for one in series):
        axes.yaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
    if seen.min() == seen.max():
        low, high = min(0.0, 1.2 * seen.min()), max(1.0, 1.2 * seen.max())
        axes.set_ylim(low - 0.05 * (high - low), high)
    low, high = axes.get_ylim()
    if 0 < low < 0.6 * high:
        axes.set_ylim(bottom=0)


def _mark_misses(axes: Axes, series: Sequence[Series], recording: Recording) -> None:
    """Draw a tick at the foot of the panel, in the drive's colour, for every missed value."""
    style = {"markersize": 7, "markeredgewidth": 1.2, "transform": axes.get_xaxis_transform()}
    for one in series:
        time = one.time[one.missed]
        apart = (time[-1] - time[0]) // MOST_POINTS if len(time) else 1
        colour = line_style(recording.drives.index(one.drive))["color"]
        mark_times(axes, time, 0.025, apart, color=colour, **style)


def _draw_faults(axes: Axes, series: Sequence[Series]) -> None:
    """Draw a row for each drive, with a named bar for each of the drive's faults."""
    set_title(axes, "faults" if any(one.faults() for one in series) else "faults: none")
    for row, one in enumerate(series):
        for span in one.faults():
            begin, end = day(span.begin), day(span.end)
            axes.barh(row, end - begin, left=begin, height=0.7, color=FAULT, alpha=0.85)
            name_bar(axes, label(span.what).lower(), begin, row)
    axes.set_yticks(range(len(series)), [label(one.drive) for one in series], fontsize=8)
    axes.set_ylim(len(series) - 0.5, -0.5)
    axes.grid(visible=True, axis="x", color=GRID, linewidth=0.6)


def _mark_events(axes: Sequence[Axes], events: Sequence[Event]) -> None:
    """At each event, draw a line through all panels, and write its text on the last panel.

    The line of a step of a test run is dashed.
    """
    for event in events[:MOST_EVENTS]:
        at = day(event.time)
        for one in axes:
            one.axvline(at, color=TEXT, linestyle="--" if event.kind == STEP else ":", linewidth=0.9)
        shown = event.text if len(event.text) <= LONGEST_EVENT else f"{event.text[: LONGEST_EVENT - 3]}..."
        place: dict[str, Any] = {"xytext": (2, 2), "textcoords": "offset points", "annotation_clip": True}
        text = axes[-1].annotate(
            label(shown),
            (at, 0.0),
            xycoords=axes[-1].get_xaxis_transform(),
            rotation=90,
            va="bottom",
            fontsize=7,
            color=TEXT,
            **place,
        )
        text.set_in_layout(False)  # otherwise the layout would reserve room for the text above the panel


def _shade(axes: Axes, content: Content, faults: Sequence[Series]) -> None:
    """Shade the times of a drive's faults behind its curves or its rows of states."""
    shade: dict[str, Any] = {"color": FAULT, "alpha": 0.08, "lw": 0}
    for one in faults:
        rows = [row for row, lane in enumerate(content.lanes) if lane.drive == one.drive]
        is_curve = not content.lanes and any(series.drive == one.drive for series in content.series)
        for span in one.faults():
            begin, end = day(span.begin), day(span.end)
            if is_curve:
                axes.axvspan(begin, end, **shade)
            axes.barh(rows, end - begin, left=begin, height=1.0, **shade)


def with_pauses(time: Array, value: Array, begins: Array) -> tuple[Array, Array]:
    """Return the points, with a NaN inserted at the start of each pause to interrupt the drawn line."""
    at = np.searchsorted(time, begins, side="right")
    return np.insert(time, at, begins + 1), np.insert(value, at, np.nan)


def thinned(time: Array, value: Array) -> tuple[Array, Array]:
    """Reduce a long curve to the least and greatest value of each run of rows.

    Keep one of several consecutive missed values.
    """
    pieces = MOST_POINTS // 2
    if len(time) <= MOST_POINTS:
        return time, value
    length = len(time) // pieces
    whole = length * pieces
    rows = value[:whole].reshape(pieces, length)
    lows = np.where(np.isnan(rows), np.inf, rows).argmin(axis=1)
    highs = np.where(np.isnan(rows), -np.inf, rows).argmax(axis=1)
    at = np.sort(np.stack([lows, highs], axis=1), axis=1) + np.arange(pieces)[:, None] * length
    kept = np.unique(np.concatenate([at.ravel(), np.arange(whole, len(time))]))
    return time[kept], value[kept]


# Tol's pale colours: no state has the colour of a drive
COLOURS = ("#BBCCEE", "#CCDDAA", "#EEEEBB", "#CCEEFF", "#DDDDDD", "#FFCCCC")
HATCHES = ("", "////", "....")  # patterns that distinguish states if there are more states than colours
MOST_LANES = 64  # limit of lanes in a panel
NARROWEST = 1 / 1500  # least width of a state, as a fraction of the time axis
LETTER = 1 / 140  # width of a letter, as a fraction of the time axis
LANE_INCHES = 0.24
MOST_TEXTS = 50  # limit of labels with the same name in one lane


@dataclass(frozen=True, eq=False)
class Lane:
    """A row of bars in a plot: the successive states of a drive's register, or of one of its bits."""

    drive: str
    title: str
    is_bit: bool  # True if the lane shows one bit, whose states are on and off
    time: Array  # time of each row, ns UTC
    missed: Array
    state: tuple[str, ...]  # names of the successive states; successive rows with equal values are one state
    begin: Array  # start of each state, ns UTC
    end: Array


def lanes_of(series: Sequence[Series]) -> tuple[list[Lane], int]:
    """Return the lanes to draw in a panel, and the number of lanes for which there is no room.

    A lane is a row of a panel with the states of a drive, or of one of its bits, over time. If there are too
    many, those of bits that were never set are left out first, and are not counted.
    """
    found = list(chain.from_iterable(map(_lanes, series)))
    if len(found) > MOST_LANES:
        found = [lane for lane in found if lane.state] or found
    return found[:MOST_LANES], max(0, len(found) - MOST_LANES)


def _lanes(series: Series) -> Iterable[Lane]:
    if not series.is_bits:
        return [_lane(series, series.drive, series.value, series.name_of)]
    with np.errstate(invalid="ignore"):  # an infinite value cannot be converted to a count
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
    """Return a lane with a state for each run of equal values.

    A state lasts until the next state or a pause.
    """
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
    return 0.45 + LANE_INCHES * len(lanes)


def draw_lanes(axes: Axes, lanes: Sequence[Lane], recording: Recording) -> None:
    """Draw each lane as a row of bars, one per state. Names that do not fit into a bar go into a legend."""
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
    """Write a name at the start of a bar. The name stays readable even if it is longer than the bar."""
    box = {"facecolor": "white", "alpha": 0.75, "pad": 0.8, "linewidth": 0}
    place: dict[str, Any] = {"xytext": (3, 0), "textcoords": "offset points", "va": "center"}
    axes.annotate(text, (at, row), fontsize=7.5, clip_on=True, bbox=box, **place)


def _style(number: int) -> dict[str, Any]:
    hatch = HATCHES[number // len(COLOURS) % len(HATCHES)]
    return {"facecolor": COLOURS[number % len(COLOURS)], "hatch": hatch, "edgecolor": TEXT, "linewidth": 0.5}


def _longest_first(lane: Lane) -> list[str]:
    """Return the lane's states in drawing order: long states first, so that they do not cover short ones."""
    lasting = dict.fromkeys(lane.state, 0)
    for name, length in zip(lane.state, (lane.end - lane.begin).tolist(), strict=True):
        lasting[name] += length
    return sorted(lasting, key=lambda name: -lasting[name])


def _merged(lane: Lane, name: str, span: int) -> tuple[Array, Array]:
    """Return the starts and ends of a state's bars. Bars with an invisible gap are joined."""
    of = np.array([state == name for state in lane.state])
    begin, end = lane.begin[of], lane.end[of]
    apart = np.concatenate([[True], begin[1:] - end[:-1] > span * NARROWEST / 2])
    return begin[apart], end[np.concatenate([apart[1:], [True]])]
