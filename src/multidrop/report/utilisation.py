"""What was used of a recorded line, beside what was planned: utilisation, bus cycle, exchanges a second."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from multidrop.core import Framing, Message, reply_length
from multidrop.report.load import Array, Selection
from multidrop.report.style import days, label, line_style, new_figure, tell_time, time_edges

_LINE_FIGURES = ("utilisation", "cycle_ms")
_DRIVE_FIGURES = ("exchanges_per_second", "silence_ms", "character_ms")
MOST_FIGURE = 1e9  # a plan that says more is none of ours


@dataclass(frozen=True, eq=False)
class Used:
    """A line's answered exchanges: when each was sent, and what it had to take of the line."""

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
        """Seconds to read everything once; None where some is asked for at a rate of its own."""
        blocks = [block for drive in self.planned["drives"].values() for block in drive["blocks"]]
        if any(block["every_ms"] is not None for block in blocks) or not self.values:
            return None
        return self.seconds * sum(len(block["registers"]) for block in blocks) / self.values

    def rate(self, drive: str) -> float:
        return self.asked.get(drive, 0) / self.seconds


def used(look: Selection) -> list[Used]:
    """Of every line whose plan the recording carries; none, where that is not as it was written."""
    try:
        return [_used(look, line, planned) for line, planned in look.metadata.get("planned", {}).items()]
    except (AttributeError, IndexError, KeyError, OverflowError, TypeError, ValueError):
        return []


def _checked(planned: Mapping[str, Any]) -> dict[str, Any]:
    """The same plan, if its figures are some; else an error of the kinds that `used` expects."""
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


def _used(look: Selection, line: str, planned: Mapping[str, Any]) -> Used:
    planned = _checked(planned)
    parts: list[tuple[Array, Array, Array]] = []
    asked, values = {}, 0
    for name, drive in planned["drives"].items():
        time, needed, read = _exchanges(look, name, drive)
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
    return Used(line, planned, time, needed, asked, values, max(look.seconds + end, 1e-9))


def _exchanges(look: Selection, name: str, drive: Mapping[str, Any]) -> tuple[Array, Array, int]:
    """When each answered exchange with a drive was sent, the seconds from then to its reply's end, and

    how many values there are. What was read at one time was read together: blocks may be chosen anew.
    """
    of = [
        it for block in drive["blocks"] for register in block["registers"] for it in look.of(name, register)
    ]
    read = [(it, ~it.missed) for it in of]
    if not any(known.any() for _, known in read):
        return np.zeros(0, np.int64), np.zeros(0), 0
    times = np.concatenate([it.time[known] for it, known in read])
    time, first, exchange = np.unique(times, return_index=True, return_inverse=True)
    uncertainty = np.concatenate([it.uncertainty[known] for it, known in read])[first]
    function, address, words = (
        np.concatenate([np.full(known.sum(), _word(it.meaning[key])) for it, known in read])
        for key in ("function", "address", "words")
    )
    start, end = np.full(len(time), address.max()), np.zeros(len(time), np.int64)
    np.minimum.at(start, exchange, address)
    np.maximum.at(end, exchange, address + words)
    blocks, which = np.unique(np.stack([function[first], start, end - start]), axis=1, return_inverse=True)
    framing = Framing[look.about(name)["framing"].upper()]
    requests = [Message(1, asked, at, count, bytes(4)) for asked, at, count in blocks.T.tolist()]
    characters = np.array([reply_length(framing, it) for it in requests])[which]
    # The stamps go from the request's begin to the first character of the reply.
    rest = (characters - 1) * drive["character_ms"] / 1e3
    return time, uncertainty / 1e9 + rest, len(times)


def draw_used(found: Sequence[Used], look: Selection) -> Figure:
    """Utilisation over time, and dashed what was planned."""
    figure, (axes,) = new_figure([2.2])
    edges = time_edges(look.begin, look.end)
    width = (edges[1] - edges[0]) / 1e9
    middles = days(((edges[1:] + edges[:-1]) / 2).astype(np.int64))
    for number, it in enumerate(found):
        share = np.histogram(it.time, edges, weights=it.needed)[0] / width
        colour = line_style(number)["color"]
        axes.plot(middles, share, linewidth=1.3, color=colour, label=label(it.line))
        planned = min(it.planned["utilisation"], 1.0)
        dashed = label(f"{it.line}, planned")
        axes.axhline(planned, linewidth=1.0, linestyle="dashed", color=colour, label=dashed)
    axes.set_ylim(0, 1.08)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set_ylabel("utilisation")
    tell_time(axes)
    axes.set_xlim(*days(edges[[0, -1]].astype(np.int64)))
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper left", ncols=6, frameon=False)
    return figure
