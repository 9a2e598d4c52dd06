"""What a monitor knows of a plant that is polled: the newest of everything, a little history, and rates.

It knows neither terminal nor clock: rows, summaries and times come in as arguments.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from multidrop.batch import Row, Rows
from multidrop.plant import Line, Plant, PolledDrive
from multidrop.register import Register

HISTORY = 240  # s, a point each
RATES_OVER = 5.0  # s: rates are those of so long
FREQUENCY, CURRENT, FAULT, STATE = "output_frequency", "output_current", "fault", "status"


@dataclass
class Watched:
    """One drive, and the newest that is known of it."""

    line: Line
    polled: PolledDrive
    newest: dict[str, Row] = field(default_factory=dict)  # samples, by register
    missed: dict[str, Row] = field(default_factory=dict)  # the misses that are newer than these
    samples: int = 0
    misses: Counter[str] = field(default_factory=Counter)
    history: deque[float | None] = field(default_factory=lambda: deque(maxlen=HISTORY))

    @property
    def name(self) -> str:
        return self.polled.drive.name

    def add(self, row: Row) -> None:
        if row.value is None:
            self.misses[row.status] += 1
            self.missed[row.register] = row
        else:
            self.samples += 1
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
        return max(self.missed.values(), key=lambda row: row.time).status

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


@dataclass
class Rates:
    """What a line did in the last seconds."""

    utilisation: float = 0.0
    exchanges: float = 0.0  # a second
    misses: Mapping[str, int] = field(default_factory=dict)  # since the beginning


class WatchedPlant:
    """All drives of a plant, and the rates of its lines."""

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        self.drives = [Watched(line, polled) for line in plant.lines for polled in line.drives]
        self.rates = {line.name: Rates() for line in plant.lines}
        self._by_name = {it.name: it for it in self.drives}
        self._earlier: deque[tuple[float, Mapping[str, Any]]] = deque()

    def add(self, rows: Rows) -> None:
        for row in rows:
            self._by_name[row.drive].add(row)

    def tick(self, now: float, summary: Mapping[str, Any]) -> None:
        """Once a second: what the poller says of itself by now."""
        for it in self.drives:
            it.remember()
        lines = summary["lines"]
        self._earlier.append((now, lines))
        while now - self._earlier[0][0] > RATES_OVER:
            self._earlier.popleft()
        before = self._earlier[0][1]
        for name, line in lines.items():
            was = before[name] if before is not lines else {"seconds": 0, "exchanges": 0, "utilisation": 0}
            seconds = max(line["seconds"] - was["seconds"], 1e-9)
            busy = line["seconds"] * line["utilisation"] - was["seconds"] * was["utilisation"]
            self.rates[name] = Rates(
                min(max(busy / seconds, 0.0), 1.0),
                (line["exchanges"] - was["exchanges"]) / seconds,
                line["misses"],
            )


def told(register: Register[Any], value: float) -> str:
    """A row's value as people read it."""
    if register.values is not None:
        return register.format(register.decode(value))
    if register.step is None:
        return f"{value:g} raw"
    return register.format(value)
