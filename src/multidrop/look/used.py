"""What was used of a recorded line, beside what was planned: utilisation, bus cycle, exchanges a second."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from multidrop.look.recorded import Array, Look
from multidrop.look.style import days, line_style, new_figure, tell_time, time_edges


@dataclass(frozen=True, eq=False)
class Used:
    """A line's answered exchanges: when each was sent, and what it had to take of the line."""

    line: str
    planned: Mapping[str, Any]
    time: Array  # ns UTC
    needed: Array  # s: silence before it, request, response delay, reply
    asked: Mapping[str, int]  # exchanges that were answered, by drive
    seconds: float

    @property
    def utilisation(self) -> float:
        return float(self.needed.sum()) / self.seconds

    @property
    def cycle(self) -> float | None:
        """Seconds for one exchange of each block; None where some are asked for at a rate of their own."""
        blocks = [block for drive in self.planned["drives"].values() for block in drive["blocks"]]
        if any(block["every_ms"] is not None for block in blocks) or not len(self.time):
            return None
        return self.seconds * len(blocks) / len(self.time)

    def rate(self, drive: str) -> float:
        return self.asked.get(drive, 0) / self.seconds


def used(look: Look) -> list[Used]:
    """Of every line whose plan the recording carries; none, where that is not as it was written."""
    try:
        return [_used(look, line, planned) for line, planned in look.metadata.get("planned", {}).items()]
    except (AttributeError, KeyError, TypeError, ValueError):
        return []


def _used(look: Look, line: str, planned: Mapping[str, Any]) -> Used:
    parts: list[tuple[Array, Array, Array]] = []
    asked = {}
    for name, drive in planned["drives"].items():
        time, needed = _exchanges(look, name, drive)
        asked[name] = len(time)
        parts.append((time, needed, np.full(len(time), drive["silence_ms"] / 1e3)))
    if not parts:
        parts.append((np.zeros(0, np.int64), np.zeros(0), np.zeros(0)))
    time, needed, silence = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(time, kind="stable")
    time, needed, silence = time[order], needed[order], silence[order]
    if len(time):  # the longer of two neighbours' silences is kept
        needed = needed + np.maximum(silence, np.concatenate([silence[:1], silence[:-1]]))
    end = float(needed[-1]) if len(time) else 0.0
    return Used(line, planned, time, needed, asked, max(look.seconds + end, 1e-9))


def _exchanges(look: Look, name: str, drive: Mapping[str, Any]) -> tuple[Array, Array]:
    """When each answered exchange with a drive was sent, and the seconds from then to its reply's end."""
    found: dict[int, float] = {}
    for block in drive["blocks"]:
        # The stamps go from the request's begin to the first character of the reply.
        rest = (block["reply_characters"] - 1) * drive["character_ms"] / 1e3
        for register in block["registers"]:
            for it in look.of(name, register):
                there = ~it.missed
                seconds = it.uncertainty[there] / 1e9 + rest
                found.update(zip(it.time[there].tolist(), seconds.tolist(), strict=True))
    return np.array(list(found), np.int64), np.array(list(found.values()))


def draw_used(found: Sequence[Used], look: Look) -> Figure:
    """Utilisation over time, and dashed what was planned."""
    figure, (axes,) = new_figure([2.2])
    edges = time_edges(look.begin, look.end)
    width = (edges[1] - edges[0]) / 1e9
    middles = days(((edges[1:] + edges[:-1]) / 2).astype(np.int64))
    for number, it in enumerate(found):
        share = np.histogram(it.time, edges, weights=it.needed)[0] / width
        colour = line_style(number)["color"]
        axes.plot(middles, share, linewidth=1.3, color=colour, label=it.line)
        planned = min(it.planned["utilisation"], 1.0)
        label = f"{it.line}, planned"
        axes.axhline(planned, linewidth=1.0, linestyle="dashed", color=colour, label=label)
    axes.set_ylim(0, 1.08)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set_ylabel("utilisation")
    tell_time(axes)
    axes.set_xlim(*days(edges[[0, -1]].astype(np.int64)))
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper left", ncols=6, frameon=False)
    return figure
