"""The state of a polled plant for a screen: newest values, misses, a short history, and rates.

Rows, statistics and times come in as arguments: there is no terminal and no clock here.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import Flag

from multidrop.cli.support.values import value_text
from multidrop.core import UNASKED, Counters
from multidrop.plant.model import Plant, PlantLine, PolledDrive
from multidrop.polling.batch import Row
from multidrop.transport.statistics import LineStatistics, Statistics, line_statistics

HISTORY = 240  # points, one a second
LATELY = 5.0  # s over which rates are taken
FREQUENCY, CURRENT, FAULT, STATE = "output_frequency", "output_current", "fault", "status"

_NOTHING = Statistics(1.0, Counters())


@dataclass
class LiveDrive:
    """One polled drive."""

    line: PlantLine
    polled: PolledDrive
    newest: dict[str, Row] = field(default_factory=dict)  # samples, by register
    missed: dict[str, Row] = field(default_factory=dict)  # misses newer than the register's sample
    last_miss: str = ""  # status of the last miss of a request that was sent
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
                self.last_miss = row.status
        else:
            self.newest[row.register] = row
            self.missed.pop(row.register, None)

    def shown(self, name: str) -> str:
        """Return a register's newest value with its unit; "" where there is none."""
        row = self.newest.get(name)
        if row is None or row.value is None:
            return ""
        return value_text(self.polled.drive.register(name), row.value)

    def age(self, now_ns: int) -> float | None:
        """Return the seconds since the newest sample."""
        newest = max((row.time for row in self.newest.values()), default=None)
        return None if newest is None else max(0.0, (now_ns - newest) / 1e9)

    @property
    def why_silent(self) -> str:
        """Return the reason for the misses, where every polled register is missed."""
        if not self.missed or len(self.missed) < len(self.polled.polls):
            return ""
        return self.last_miss or max(self.missed.values(), key=lambda row: row.time).status

    @property
    def fault(self) -> str:
        row = self.newest.get(FAULT)
        return self.shown(FAULT).lower() if row and row.value else ""

    @property
    def state(self) -> str:
        """Return the state as far as the polled registers show it."""
        if self.why_silent:
            return "silent"
        if self.fault:
            return "fault"
        if STATE in self.newest and not self._is_bare(self.newest[STATE]):
            return self.shown(STATE).lower()
        row = self.newest.get(FREQUENCY)
        if row is None or not row.value:
            return ""  # 0 Hz may be a stop, or a run at a setpoint of 0
        return "turns"

    def _is_bare(self, row: Row) -> bool:
        """Return True for flags of which none is set: they are no name of a state."""
        values = self.polled.drive.register(row.register).values
        return not row.value and values is not None and issubclass(values, Flag)

    def remember(self) -> None:
        """Add a point of history: the frequency where it is polled, else the register polled first."""
        polled = [poll.register.name for poll in self.polled.polls]
        name = FREQUENCY if FREQUENCY in polled else next(iter(polled), "")
        fresh = name in self.newest and name not in self.missed
        self.history.append(self.newest[name].value if fresh else None)


class LivePlant:
    """All drives of a plant, and the statistics of its lines: so far, and of the last LATELY seconds."""

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        self.drives = [LiveDrive(line, polled) for line in plant.lines for polled in line.drives]
        self.so_far = {line.name: line_statistics(1.0, {}, None) for line in plant.lines}
        self.lately = self.so_far
        self._by_name = {drive.name: drive for drive in self.drives}
        self._earlier: deque[tuple[float, Mapping[str, LineStatistics]]] = deque()

    def add(self, rows: Iterable[Row]) -> None:
        for row in rows:
            self._by_name[row.drive].add(row)

    def tick(self, now: float, statistics: dict[str, LineStatistics]) -> None:
        """Take the poller's statistics; call this once a second."""
        self._earlier.append((now, statistics))
        while now - self._earlier[0][0] > LATELY:
            self._earlier.popleft()
        before = self._earlier[0][1]
        self.so_far = self.lately = statistics
        if before is not statistics:
            self.lately = {name: line.since(before[name]) for name, line in statistics.items()}
        for drive in self.drives:
            drive.so_far = statistics[drive.line.name].drives[drive.name]
            drive.lately = self.lately[drive.line.name].drives[drive.name]
            drive.remember()
