"""A path that delays everything and keeps the order: a modem, a gateway, a stalled network."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Sequence
from random import Random
from typing import Any

import pytest
from clocked_lines import BEGIN_NS, NEVER, ClockedPort, ClockedWire, transactions_of
from lines import proof
from stories import Story

from multidrop import bus
from multidrop.bus import Bus
from multidrop.core import Completion, Exchange
from multidrop.drive import Drive
from multidrop.drive.line_settings import speaks_tcp
from multidrop.errors import BusError
from multidrop.sim import SimulatedDrive
from multidrop.transport import clock, peers

Delay = Callable[[float], float]  # delay in s by the time in s at which bytes enter the path

S = 1_000_000_000
SECONDS = 150.0  # of a story: pending requests are kept for 120 s
TAIL = 20.0  # every drive must answer in these last seconds plus TURNS times the delay
TURNS = 20


class PathWire(ClockedWire):
    """A faulty wire at the end of a path that delays the drives' replies."""

    delay: Delay

    def __init__(self, *arguments: Any, **details: Any) -> None:
        super().__init__(*arguments, **details)
        self._path: deque[tuple[float, bytes]] = deque()

    def advance(self, now: float) -> bytes:
        said = super().advance(now)
        if said:
            before = self._path[-1][0] if self._path else 0.0
            self._path.append((max(before, now + self.delay(now)), said))
        received = b""
        while self._path and self._path[0][0] <= now:
            received += self._path.popleft()[1]
        return received

    @property
    def wake(self) -> float | None:
        first = super().wake
        if not self._path:
            return first
        arrival = self._path[0][0]
        return arrival if first is None else min(first, arrival)


def constant(seconds: float) -> Delay:
    return lambda now: seconds


def jittering(seconds: float) -> Delay:
    random = Random(1)
    return lambda now: seconds * random.uniform(0.8, 1.2)


def stalling(longest: float) -> Delay:
    """Return twelve stalls of up to this many seconds, each of which delays everything to its end."""
    random = Random(2)
    begins = [random.uniform(2.0, SECONDS) for _ in range(12)]
    stalls = [(begin, begin + random.uniform(0.5, 1.0) * longest) for begin in begins]

    def delay(now: float) -> float:
        now -= 1000.0  # the time at which clocked lines start
        return max((end - now for begin, end in stalls if begin <= now < end), default=0.0)

    return delay


class Path(Story):
    """A line at the end of such a path."""

    wires = PathWire

    def tell_of(self, delay: Delay, tail_s: float = TAIL) -> set[str]:
        """Check every row; return the drives with values at the end."""
        self.wire.delay = delay
        with self.clocked:
            self.run(SECONDS)
            tail = self.run(tail_s)
        self.judge_values()
        return {row.drive for row in tail if row.value is not None}


class PathLine:
    """A line at the end of such a path, with the interface that `Bus` uses; only its waits let time pass."""

    def __init__(self, wire: PathWire) -> None:
        self.port = self.identity = wire.where if speaks_tcp(wire.where) else "test line"
        self.now = BEGIN_NS
        self.wire = wire
        self.has_echo = self.is_lost = False
        self.may_send = True  # has no mastership
        self.is_tcp, self.ids = speaks_tcp(self.port), wire.ids
        self.queue = ClockedPort(self, transactions_of(self))

    def require(self, settings: tuple[int, str]) -> None:
        pass

    def overruns(self) -> None:
        pass

    def counted_ns(self, now_ns: int) -> int:
        return now_ns

    def open(self) -> PathLine:
        return self

    def close(self) -> None:
        pass

    def send(self, request: bytes, baudrate: int) -> None:
        self.wire.receive(request, self.now / S, baudrate)

    def sleep(self, seconds: float) -> None:
        self._pass_until(self.now + round(seconds * S))

    def carry_out(
        self, exchange: Exchange, *, expires_ns: int = 0, into: Completion | None = None
    ) -> Completion:
        late_until_ns = exchange.peer.late_until_ns
        self.queue.begin_urgent(exchange)
        self._pass_until(self.now + 1000 * S)
        granted = self.queue.granted
        assert granted
        granted.c.late_until_ns = late_until_ns  # like md_port_carry_out()
        return granted

    def _pass_until(self, end_ns: int) -> None:
        is_awaited = self.queue.granted is None
        while self.now < end_ns and not (is_awaited and self.queue.granted):
            wake = self.queue.advance(self.wire.advance(self.now / S))
            at = self.wire.wake
            arrival = NEVER if at is None else -int(-at * S // 1)
            if not (is_awaited and self.queue.granted):
                self.now = min(max(min(wake, arrival), self.now + 1), end_ns)


def bus_over(
    wire: PathWire, delay: Delay, sims: Sequence[SimulatedDrive], monkeypatch: pytest.MonkeyPatch
) -> tuple[Bus, PathLine]:
    """Open a bus over such a path to these simulated drives."""
    wire.delay = delay
    wire.open()
    line = PathLine(wire)
    monkeypatch.setattr(bus, "Line", lambda port, *facts: line)
    monkeypatch.setattr(peers, "_former", {})  # earlier peers belong to another clock
    monkeypatch.setattr(clock, "now_ns", lambda: line.now)
    monkeypatch.setattr(clock, "boottime_ns", lambda: line.now)
    monkeypatch.setattr(clock, "sleep", line.sleep)
    opened = Bus(line.port)
    for sim in sims:
        opened.attach(sim.drive)
    return opened, line


def read_truly(opened: Bus, line: PathLine, drives: Sequence[Drive]) -> None:
    """Read four registers of each drive in turn, repeatedly; check that each value is the register's."""
    asked = [(drive, register) for drive in drives for register in drive.readings()[:4]]
    read: Counter[str] = Counter()
    with opened:
        for _ in range(24):
            for drive, register in asked:
                try:
                    value = drive.read(register)
                except BusError:
                    line.sleep(0.05)
                else:
                    assert value == proof(drive, register)
                    read[drive.name] += 1
    assert set(read) == {drive.name for drive in drives}
