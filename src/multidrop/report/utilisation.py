"""Compare a recorded line with its plan: utilisation, bus cycle, exchanges a second."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from multidrop.core import Framing, Message, characters_on_wire, reply_length
from multidrop.report.load import Array, Recording
from multidrop.report.style import TimeBins, add_legend, label, line_style, new_figure

_LINE_FIGURES = ("utilisation", "cycle_ms")
_DRIVE_FIGURES = ("exchanges_per_second", "silence_ms", "character_ms")
MOST_FIGURE = 1e9  # a larger one is not of our plans


@dataclass(frozen=True, eq=False)
class LineUse:
    """A line's answered exchanges: their times, and the time that each needed of the line."""

    line: str
    planned: Mapping[str, Any]
    time: Array  # ns UTC
    needed: Array  # s: request, response delay, reply, silence after it; never more than it took
    asked: Mapping[str, int]  # exchanges that were answered, by drive
    values: int  # in their replies
    seconds: float

    @property
    def utilisation(self) -> float:
        return float(self.needed.sum()) / self.seconds

    @property
    def cycle(self) -> float | None:
        """Seconds to read everything once; None where a register has a rate of its own."""
        blocks = [block for drive in self.planned["drives"].values() for block in drive["blocks"]]
        if any(block["every_ms"] is not None for block in blocks) or not self.values:
            return None
        return self.seconds * sum(len(block["registers"]) for block in blocks) / self.values

    def rate(self, drive: str) -> float:
        return self.asked.get(drive, 0) / self.seconds


def line_uses(recording: Recording) -> list[LineUse]:
    """Return the use of every line whose plan the recording holds; none if a plan is damaged."""
    try:
        plans = recording.metadata.get("planned", {})
        return [_line_use(recording, line, planned) for line, planned in plans.items()]
    except (AttributeError, IndexError, KeyError, OverflowError, TypeError, ValueError):
        return []


def _checked(planned: Mapping[str, Any]) -> dict[str, Any]:
    """Return the plan with its figures as floats. Raises what `line_uses` catches."""
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
    if len(time):  # the longer of two neighbours' silences is kept
        needed = needed + np.maximum(silence, np.concatenate([silence[1:], silence[-1:]]))
        # A port that is faster than its settings, such as a network's, needs no more than it took.
        needed[:-1] = np.minimum(needed[:-1], np.diff(time) / 1e9)
    end = float(needed[-1]) if len(time) else 0.0
    return LineUse(line, planned, time, needed, asked, values, max(recording.seconds + end, 1e-9))


def _exchanges(recording: Recording, name: str, drive: Mapping[str, Any]) -> tuple[Array, Array, int]:
    """Return the time and the seconds to its reply's end of each answered exchange, and how many values.

    Values of one time were read together: blocks may have been chosen anew since the plan.
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
    characters = np.array([_characters(framing, request) for request in requests])[which]
    # The stamps are those of the request's begin and of the reply's first character.
    rest = (characters - 1) * drive["character_ms"] / 1e3
    return time, uncertainty / 1e9 + rest, len(times)


def _characters(framing: Framing, request: Message) -> int:
    return characters_on_wire(framing, reply_length(framing, request))


def draw_utilisation(uses: Sequence[LineUse], recording: Recording) -> Figure:
    """Draw utilisation over time, and dashed the planned one."""
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
