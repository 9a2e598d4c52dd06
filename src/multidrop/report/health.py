"""Draw the health of lines: rates, response delays, missed values over time and output frequency."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from multidrop.core import UNASKED, Framing, Message, build_request, characters_on_wire, reply_length
from multidrop.drive.line_settings import Settings
from multidrop.recording.series import Array
from multidrop.report.load import Recording, Series
from multidrop.report.style import (
    COLOURS,
    MOST_DRIVES,
    TEXT,
    TimeBins,
    add_legend,
    label,
    line_style,
    new_figure,
    set_title,
)

MOST_REASONS = 6  # limit of reasons for missed values in a picture; others are drawn as "other reasons"
# A bin with fewer requested values is left out, because its share of missed values is not significant.
LEAST_IN_BIN = 20
BINS = 12  # number of bins into which output frequencies are sorted
FREQUENCY = "output_frequency"
ROOM = 2.0  # length of the axis of delays, as a multiple of their 99 % quantile
SHORTEST_AXIS = 0.001  # least length of the axis of delays, in s
SHADES = ("#B00020", "#E69F00", "#56B4E9", "#CC79A7", "#009E73", "#0072B2", "#999999")


@dataclass(frozen=True)
class DelaySeries:
    """A drive's response delays in s, from the last bit of a request to the first bit of its reply."""

    drive: str
    seconds: Array
    exact: bool  # False if the delays include the request's duration, which is unknown

    def quantile(self, part: float) -> float:
        return float(np.quantile(self.seconds, part))


def delays(recording: Recording) -> list[DelaySeries]:
    """Return the delays of every drive that answered.

    The first reply after a lost request is left out, because it may be a late reply to that request.
    """
    found = []
    for drive in recording.drives:
        request = _request_seconds(recording, drive)
        answered = [(series, ~series.missed & ~_spans_loss(series)) for series in recording.of(drive)]
        # One reply holds several registers, whose rows have the same time: count that time once.
        times = np.concatenate([series.time[there] for series, there in answered])
        stamps, firsts = np.unique(times, return_index=True)
        if len(stamps):
            taken = np.concatenate([series.uncertainty[there] for series, there in answered])
            seconds = taken[firsts] / 1e9 - (request or 0.0)
            found.append(DelaySeries(drive, np.maximum(seconds, 0.0), request is not None))
    return found


def _spans_loss(series: Series) -> Array:
    """Mark values with a lost request between their request and their reply, which may be to the lost one."""
    asked = [number for number, status in enumerate(series.statuses) if not status.startswith(UNASKED)]
    lost = np.unique(series.time[series.missed & np.isin(series.status, asked)])
    next_lost = np.append(lost, np.iinfo(np.int64).max)[np.searchsorted(lost, series.time)]
    return np.asarray(next_lost - series.time <= series.uncertainty)


def _request_seconds(recording: Recording, drive: str) -> float | None:
    """Return the time in s that a request and the first character of its reply take on the wire.

    Return None if the recording's metadata lack the drive's line settings.
    """
    about = recording.about(drive)
    try:
        baudrate, format = about["settings"].split()
        framing = {str(framing): framing for framing in Framing}[about["framing"]]
        character = Settings(int(baudrate), format).character
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError):
        return None
    message = Message(1, 7, data=bytes(4)) if framing is Framing.DELIXI else Message(1, 3, 0, 1)
    return (characters_on_wire(framing, len(build_request(framing, message))) + 1) * character


def draw_delays(found: Sequence[DelaySeries]) -> Figure:
    """Draw the delays as a box plot with whiskers at the 1 % and 99 % quantiles."""
    found = found[:MOST_DRIVES]
    figure, (axes,) = new_figure([0.8 + 0.32 * len(found)])
    axes.boxplot(
        [delay.seconds * 1e3 for delay in found],
        orientation="horizontal",
        whis=(1, 99),
        widths=0.6,
        patch_artist=True,
        tick_labels=[label(delay.drive) for delay in found],
        boxprops={"facecolor": "#CFE3F1", "edgecolor": COLOURS[0]},
        medianprops={"color": COLOURS[1], "linewidth": 1.6},
        whiskerprops={"color": COLOURS[0]},
        capprops={"color": COLOURS[0]},
        flierprops={"marker": ".", "markersize": 2.5, "alpha": 0.4, "markeredgecolor": COLOURS[0]},
    )
    axes.invert_yaxis()
    limit = ROOM * max(delay.quantile(0.99) for delay in found) + SHORTEST_AXIS
    longer = sum(int((delay.seconds > limit).sum()) for delay in found)
    axes.set_xlim(0, limit * 1e3 if longer else None)
    note = f" ({longer} longer beyond the right edge)" if longer else ""
    axes.set_xlabel(f"response delay, ms{note}", loc="left")
    return figure


def draw_rates(recording: Recording) -> Figure:
    """Draw the values per second by drive, and below them the missed values per second by reason."""
    figure, (rates, misses) = new_figure([2.2, 1.8], sharex=True)
    bins = TimeBins(recording.begin, recording.end)
    for number, drive in enumerate(recording.drives[:MOST_DRIVES]):
        rate = sum(bins.rates(series.time[~series.missed]) for series in recording.of(drive))
        rates.plot(bins.middles, rate, linewidth=1.3, label=label(drive), **line_style(number))
    set_title(rates, "values a second")
    rates.set_ylim(bottom=0)
    stacked: dict[str, Array] = {}
    for nth, (reason, _) in enumerate(_reasons(recording.series).most_common()):
        name = reason if nth < MOST_REASONS else "other reasons"
        rate = sum(bins.rates(series.times_of(reason)) for series in recording.series)
        stacked[name] = np.asarray(stacked.get(name, 0.0) + rate)
    set_title(misses, "misses a second, by reason")
    if stacked:
        labels = list(map(label, stacked))
        heights = list(stacked.values())
        misses.stackplot(bins.middles, heights, labels=labels, colors=SHADES, step="mid", linewidth=0)
        misses.legend(fontsize=8, frameon=False, loc="upper left", ncols=3)
        misses.set_ylim(0, 1.35 * float(np.sum(heights, axis=0).max()))
    else:
        misses.text(0.5, 0.5, "none", transform=misses.transAxes, ha="center", va="center", color=TEXT)
        misses.set_ylim(0, 1)
    add_legend(figure, rates.get_legend_handles_labels()[0])
    bins.label(misses)
    return figure


def _reasons(series: Sequence[Series]) -> Counter[str]:
    return sum((one.reasons() for one in series), Counter())


def reasons_of(recording: Recording, drive: str) -> Counter[str]:
    return _reasons(recording.of(drive))


def miss_shares(recording: Recording, drive: str) -> tuple[Array, Array] | None:
    """Return output frequencies in Hz, and the drive's share of missed values near each frequency.

    The frequency of a missed value is the last one read before it. Values that were not requested are not
    counted as missed. Return None if no value was missed, if the drive has no frequency register, or if
    its frequency is constant.
    """
    (frequency, *_) = (*recording.of(drive, FREQUENCY), None)
    reasons = [reason for reason in reasons_of(recording, drive) if not reason.startswith(UNASKED)]
    if frequency is None or not reasons:
        return None
    there = ~np.isnan(frequency.drawable)
    known_time, known = frequency.time[there], frequency.value[there]
    if not len(known) or known.max() - known.min() < 1.0:
        return None
    edges = np.linspace(known.min(), known.max(), BINS + 1)
    missed, asked = np.zeros(BINS), np.zeros(BINS)
    unasked = [at for at, status in enumerate(recording.statuses) if status.startswith(UNASKED)]
    for series in recording.of(drive):
        last = np.searchsorted(known_time, series.time, side="right") - 1
        there = (last >= 0) & ~np.isin(series.status, unasked)
        place = np.clip(np.searchsorted(edges, known[last[there]], side="right") - 1, 0, BINS - 1)
        asked += np.bincount(place, minlength=BINS)
        missed += np.bincount(place[series.missed[there]], minlength=BINS)
    enough = asked >= LEAST_IN_BIN
    middles = (edges[1:] + edges[:-1]) / 2
    return middles[enough], missed[enough] / asked[enough]


def draw_miss_shares(recording: Recording) -> Figure | None:
    """Draw the share of missed values against output frequency: a slope shows noise that grows with speed."""
    shares = {drive: miss_shares(recording, drive) for drive in recording.drives[:MOST_DRIVES]}
    if not any(shares.values()):
        return None
    figure, (axes,) = new_figure([2.4])
    for number, (drive, found) in enumerate(shares.items()):
        if found:
            style = line_style(number)
            axes.plot(*found, marker="o", markersize=4, linewidth=1.3, label=label(drive), **style)
    axes.set_ylim(bottom=0, top=max(0.01, axes.get_ylim()[1]))
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set_xlabel("output frequency of the drive, Hz", loc="left")
    axes.set_ylabel("missed")
    add_legend(figure, axes.get_legend_handles_labels()[0])
    return figure


_LINE_FIGURES = ("utilisation", "cycle_ms")
_DRIVE_FIGURES = ("exchanges_per_second", "silence_ms", "character_ms")
MOST_FIGURE = 1e9  # limit of the figures in a plan; a larger figure means that the plan is damaged


@dataclass(frozen=True, eq=False)
class LineUse:
    """A line's answered exchanges: the time of each, and how long it occupied the line."""

    line: str
    planned: Mapping[str, Any]
    time: Array  # times of the exchanges, ns UTC
    needed: Array  # seconds for request, delay, reply and silence; at most the measured time
    asked: Mapping[str, int]  # number of answered exchanges, by drive
    seconds: float
    # time in s to read each register once; None if there are no values, or if a register has its own rate
    cycle: float | None

    @property
    def utilisation(self) -> float:
        return float(self.needed.sum()) / self.seconds

    def rate(self, drive: str) -> float:
        return self.asked.get(drive, 0) / self.seconds


def line_uses(recording: Recording) -> list[LineUse]:
    """Return the use of each line whose plan is in the recording; [] if a plan is damaged."""
    try:
        plans = recording.metadata.get("planned", {})
        return [_line_use(recording, line, planned) for line, planned in plans.items()]
    except (AttributeError, IndexError, KeyError, OverflowError, TypeError, ValueError):
        return []


def _checked(planned: Mapping[str, Any]) -> dict[str, Any]:
    """Return the plan with its figures as floats. A damaged plan raises an error that `line_uses` catches."""
    drives = {
        name: {**drive, **{key: _figure(drive[key]) for key in _DRIVE_FIGURES}}
        for name, drive in planned["drives"].items()
    }
    return {**planned, **{key: _figure(planned[key]) for key in _LINE_FIGURES}, "drives": drives}


def _figure(number: float) -> float:
    if not 0 <= number < MOST_FIGURE:
        raise ValueError(number)
    return float(number)


def _word(number: int) -> int:
    if not isinstance(number, int) or not 0 <= number <= 0xFFFF:
        raise ValueError(number)
    return number


def _line_use(recording: Recording, line: str, planned: Mapping[str, Any]) -> LineUse:
    planned = _checked(planned)
    parts: list[tuple[Array, Array, Array]] = []
    asked, values = {}, 0
    for name, drive in planned["drives"].items():
        time, needed, read = _exchanges(recording, name, drive)
        asked[name] = len(time)
        values += read
        parts.append((time, needed, np.full(len(time), drive["silence_ms"] / 1e3)))
    if not parts:
        parts.append((np.zeros(0, np.int64), np.zeros(0), np.zeros(0)))
    time, needed, silence = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(time, kind="stable")
    time, needed, silence = time[order], needed[order], silence[order]
    if len(time):  # the silence between two exchanges is the longer of the two that their drives need
        needed = needed + np.maximum(silence, np.concatenate([silence[1:], silence[-1:]]))
        # Some ports, such as network ports, are faster than their baud rate: limit the needed time to the
        # measured time.
        needed[:-1] = np.minimum(needed[:-1], np.diff(time) / 1e9)
    end = float(needed[-1]) if len(time) else 0.0
    seconds = max(recording.seconds + end, 1e-9)
    blocks = [block for drive in planned["drives"].values() for block in drive["blocks"]]
    has_cycle = values and all(block["every_ms"] is None for block in blocks)
    cycle = seconds * sum(len(block["registers"]) for block in blocks) / values if has_cycle else None
    return LineUse(line, planned, time, needed, asked, seconds, cycle)


def _exchanges(recording: Recording, name: str, drive: Mapping[str, Any]) -> tuple[Array, Array, int]:
    """Return the answered exchanges of a drive, and the number of values in their replies.

    The first array has the time of each exchange in ns UTC, the second its duration in s up to the reply's
    end. Values with the same time were read by one exchange.
    """
    registers = [register for block in drive["blocks"] for register in block["registers"]]
    read = [(series, ~series.missed) for register in registers for series in recording.of(name, register)]
    if not any(known.any() for _, known in read):
        return np.zeros(0, np.int64), np.zeros(0), 0
    times = np.concatenate([series.time[known] for series, known in read])
    time, first, exchange = np.unique(times, return_index=True, return_inverse=True)
    uncertainty = np.concatenate([series.uncertainty[known] for series, known in read])[first]
    function, address, words = (
        np.concatenate([np.full(known.sum(), _word(series.metadata[key])) for series, known in read])
        for key in ("function", "address", "words")
    )
    start, end = np.full(len(time), address.max()), np.zeros(len(time), np.int64)
    np.minimum.at(start, exchange, address)
    np.maximum.at(end, exchange, address + words)
    blocks, which = np.unique(np.stack([function[first], start, end - start]), axis=1, return_inverse=True)
    framing = Framing[recording.about(name)["framing"].upper()]
    requests = [Message(1, asked, at, count, bytes(4)) for asked, at, count in blocks.T.tolist()]
    replies = [characters_on_wire(framing, reply_length(framing, request)) for request in requests]
    characters = np.array(replies)[which]
    # A row's uncertainty lasts until the reply's first character, so add the time of its other characters.
    rest = (characters - 1) * drive["character_ms"] / 1e3
    return time, uncertainty / 1e9 + rest, len(times)


def draw_utilisation(uses: Sequence[LineUse], recording: Recording) -> Figure:
    """Draw each line's utilisation over time, and its planned utilisation dashed."""
    figure, (axes,) = new_figure([2.2])
    bins = TimeBins(recording.begin, recording.end)
    for number, use in enumerate(uses):
        colour = line_style(number)["color"]
        share = bins.rates(use.time, use.needed)
        axes.plot(bins.middles, share, linewidth=1.3, color=colour, label=label(use.line))
        planned = min(use.planned["utilisation"], 1.0)
        dashed = label(f"{use.line}, planned")
        axes.axhline(planned, linewidth=1.0, linestyle="dashed", color=colour, label=dashed)
    axes.set_ylim(0, 1.08)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set_ylabel("utilisation")
    bins.label(axes)
    add_legend(figure, axes.get_legend_handles_labels()[0])
    return figure
