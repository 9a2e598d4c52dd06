"""A table of the newest values, redrawn in place on a terminal.

The monitor needs rich, takes over the terminal and its keys, and can stop motors. This table needs nothing,
takes no key, and stays on the terminal above the summary.
"""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from math import ceil
from typing import TextIO

from multidrop.cli.support.live_plant import LiveDrive, LivePlant
from multidrop.cli.support.values import aligned, columns_of, counted, cut_to
from multidrop.plant.model import Plant
from multidrop.polling.batch import Rows
from multidrop.printable import printable

EVERY = 0.5  # s, between two drawings
_UP_AND_CLEAR = "\x1b[{}F\x1b[J"


class LiveTable:
    """One line per drive: its samples and misses so far, and its newest values."""

    def __init__(self, plant: Plant, terminal: TextIO) -> None:
        self._plant = LivePlant(plant)
        self._terminal = terminal
        self._samples: Counter[str] = Counter()
        self._misses: Counter[str] = Counter()
        self._drawn: list[str] = []  # lines of the last drawing
        self._next_draw = 0.0

    def add(self, rows: Rows) -> None:
        added = list(rows)
        self._plant.add(added)
        for row in added:
            (self._misses if row.value is None else self._samples)[row.drive] += 1

    def draw_if_due(self, now: float) -> None:
        """Draw, unless the last drawing is younger than EVERY."""
        if now >= self._next_draw:
            self._next_draw = now + EVERY
            self.draw()

    def draw(self) -> None:
        columns, height = shutil.get_terminal_size()
        encoding = self._terminal.encoding or "utf-8"  # an escape for what it lacks would be longer
        shown = (printable(line).encode(encoding, "replace").decode(encoding) for line in self._lines())
        lines = [cut_to(line, columns - 1) for line in shown]
        if len(lines) > height - 1:
            lines = [*lines[: height - 2], f"... and {counted(len(lines) - height + 2, 'more drive')}"]
        # A terminal that has become narrower has wrapped what was drawn.
        rows = sum(max(1, ceil(columns_of(line) / columns)) for line in self._drawn)
        back = _UP_AND_CLEAR.format(min(rows, height - 1)) if self._drawn else ""
        with suppress(OSError):  # of a terminal that is closed: the recording goes on to its end
            print(back + "\n".join(lines), file=self._terminal, flush=True)
        self._drawn = lines

    def _lines(self) -> Iterator[str]:
        rows = [("DRIVE", "SAMPLES", "MISSES", "NEWEST VALUES")]
        for drive in self._plant.drives:
            counts = str(self._samples[drive.name]), str(self._misses[drive.name])
            rows.append((drive.name, *counts, ", ".join(_values(drive))))
        yield from aligned(rows, "<>><")


def _values(drive: LiveDrive) -> Iterator[str]:
    for poll in drive.polled.polls:
        name = poll.register.name
        if name in drive.missed:
            yield f"{name}: {drive.missed[name].status}"
        elif name in drive.newest:
            yield f"{name} {drive.shown(name)}"
