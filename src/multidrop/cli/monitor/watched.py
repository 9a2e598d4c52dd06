"""What a monitor knows of a plant that is polled: the newest of everything, a little history, and rates.

It knows neither terminal nor clock: rows, statistics and times come in as arguments.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from multidrop.core import UNASKED, Counters
from multidrop.drive.register import Register
from multidrop.plant.model import Plant, PlantLine, PolledDrive
from multidrop.polling.batch import Row, Rows
from multidrop.transport.statistics import LineStatistics, Statistics, line_statistics

HISTORY = 240  # s, a point each
LATELY = 5.0  # s: rates are those of so long
FREQUENCY, CURRENT, FAULT, STATE = "output_frequency", "output_current", "fault", "status"

_NOTHING = Statistics(1.0, Counters())


@dataclass
class Watched:
    """One drive, and the newest that is known of it."""

    line: PlantLine
    polled: PolledDrive
    newest: dict[str, Row] = field(default_factory=dict)  # samples, by register
    missed: dict[str, Row] = field(default_factory=dict)  # the misses that are newer than these
    why: str = ""  # it was missed when it was asked last
    so_far: Statistics = _NOTHING
    lately: Statistics = _NOTHING
    history: deque[float | None] = field(default_factory=lambda: deque(maxlen=HISTORY))

    @property
    def name(self) -> str:
        return self.polled.drive.name

    def add(self, row: Row) -> None:
        if row.value is None:
            self.missed[row.register] = row
            if not row.status.startswith(UNASKED):
                self.why = row.status
        else:
            self.newest[row.register] = row
            self.missed.pop(row.register, None)

    def shown(self, name: str) -> str:
        """A register's newest value with its unit; nothing where it is not polled or never came."""
        row = self.newest.get(name)
        if row is None or row.value is None:
            return ""
        return told(self.polled.drive.register(name), row.value)

    def age(self, now_ns: int) -> float | None:
        """Seconds since anything came from it."""
        newest = max((row.time for row in self.newest.values()), default=None)
        return None if newest is None else max(0.0, (now_ns - newest) / 1e9)

    @property
    def why_silent(self) -> str:
        """Why nothing comes, where all that is polled is missed."""
        if not self.missed or len(self.missed) < len(self.polled.polls):
            return ""
        return self.why or max(self.missed.values(), key=lambda row: row.time).status

    @property
    def fault(self) -> str:
        row = self.newest.get(FAULT)
        return self.shown(FAULT).lower() if row and row.value else ""

    @property
    def state(self) -> str:
        """As far as what is polled anyway says it."""
        if self.why_silent:
            return "silent"
        if self.fault:
            return "fault"
        if STATE in self.newest:
            return self.shown(STATE).lower()
        row = self.newest.get(FREQUENCY)
        if row is None or not row.value:
            return ""  # 0 Hz is not said to be a stop: it may be a run at a setpoint of 0
        return "turns"

    def remember(self) -> None:
        """One more point of history: its frequency, or what is polled first."""
        name = FREQUENCY if FREQUENCY in self.newest else next(iter(self.newest), "")
        fresh = name in self.newest and name not in self.missed
        self.history.append(self.newest[name].value if fresh else None)


class WatchedPlant:
    """All drives of a plant, and how its lines do: so far, and in the last seconds."""

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        self.drives = [Watched(line, polled) for line in plant.lines for polled in line.drives]
        self.so_far = {line.name: line_statistics(1.0, {}, None) for line in plant.lines}
        self.lately = self.so_far
        self._by_name = {it.name: it for it in self.drives}
        self._earlier: deque[tuple[float, Mapping[str, LineStatistics]]] = deque()

    def add(self, rows: Rows) -> None:
        for row in rows:
            self._by_name[row.drive].add(row)

    def tick(self, now: float, statistics: dict[str, LineStatistics]) -> None:
        """Once a second: what the poller says of its lines by now."""
        self._earlier.append((now, statistics))
        while now - self._earlier[0][0] > LATELY:
            self._earlier.popleft()
        before = self._earlier[0][1]
        self.so_far = self.lately = statistics
        if before is not statistics:
            self.lately = {name: line.since(before[name]) for name, line in statistics.items()}
        for it in self.drives:
            it.so_far = statistics[it.line.name].drives[it.name]
            it.lately = self.lately[it.line.name].drives[it.name]
            it.remember()


def told(register: Register[Any], value: float) -> str:
    """A row's value as people read it."""
    if register.values is not None:
        return register.format(register.decode(value))
    if register.step is None:
        return f"{register.format(value).partition(' ')[0]} raw"
    return register.format(value)
