"""A table of the newest values, drawn over itself on a terminal."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Iterator
from typing import TextIO

from multidrop.plant.model import Plant, PolledDrive
from multidrop.polling.batch import Row, Rows

EVERY = 0.5  # s, between two drawings
_UP_AND_CLEAR = "\x1b[{}F\x1b[J"


class LiveTable:
    """One line for every drive: how many samples and misses so far, and its newest values."""

    def __init__(self, plant: Plant, terminal: TextIO) -> None:
        self._drives = [polled for line in plant.lines for polled in line.drives]
        self._terminal = terminal
        self._newest: dict[tuple[str, str], Row] = {}
        self._samples: Counter[str] = Counter()
        self._misses: Counter[str] = Counter()
        self._drawn = 0  # lines
        self._next_draw = 0.0

    def add(self, rows: Rows) -> None:
        """Take rows into account at the next `draw`."""
        for row in rows:
            self._newest[row.drive, row.register] = row
            (self._misses if row.value is None else self._samples)[row.drive] += 1

    def draw_if_due(self, now: float) -> None:
        """Draw, but not more often than a person can follow."""
        if now >= self._next_draw:
            self._next_draw = now + EVERY
            self.draw()

    def draw(self) -> None:
        columns, height = shutil.get_terminal_size()
        lines = [line[: columns - 1] for line in self._lines()]
        if len(lines) > height - 1:
            lines = [*lines[: height - 2], f"... and {len(lines) - height + 2} drives more"]
        back = _UP_AND_CLEAR.format(self._drawn) if self._drawn else ""
        print(back + "\n".join(lines), file=self._terminal, flush=True)
        self._drawn = len(lines)

    def _lines(self) -> Iterator[str]:
        width = max(len(polled.drive.name) for polled in self._drives)
        yield f"{'DRIVE':<{width}}  SAMPLES  MISSES  NEWEST VALUES"
        for polled in self._drives:
            name = polled.drive.name
            counts = f"{self._samples[name]:>7}  {self._misses[name]:>6}"
            yield f"{name:<{width}}  {counts}  {self._values(polled)}"

    def _values(self, polled: PolledDrive) -> str:
        shown = []
        for register in (poll.register for poll in polled.polls):
            row = self._newest.get((polled.drive.name, register.name))
            if row is None:
                continue
            if row.value is None:
                shown.append(f"{register.name}: {row.status}")
            elif register.values is not None:
                shown.append(f"{register.name} {register.format(register.decode(row.value))}")
            elif register.step is None:
                number, _, _ = register.format(row.value).partition(" ")
                shown.append(f"{register.name} {number} raw")
            else:
                shown.append(f"{register.name} {register.format(row.value)}")
        return ", ".join(shown)
