"""Poll a line before, during and after a fault, or behind a slow network path, on a simulated clock."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Sequence
from itertools import pairwise
from random import Random
from typing import Any

import pytest
from clocked_lines import BEGIN_NS, NEVER, ClockedLines, ClockedPort, ClockedWire
from lines import polled, proof, proofs, rows_of
from motors import REASONS

from multidrop import bus, poller
from multidrop.bus import Bus
from multidrop.core import Completion, Exchange, Message, Status
from multidrop.drive import Drive
from multidrop.drive.line_settings import speaks_tcp
from multidrop.errors import BusError
from multidrop.families import YD1000
from multidrop.planning import schedule
from multidrop.plant.model import PolledDrive
from multidrop.polling import polled_line
from multidrop.polling.batch import Row
from multidrop.sim import EncodedDrive, Faults, SimulatedDrive, simulated
from multidrop.transport import clock, drive_records

S = 1_000_000_000
REGISTERS = 5  # polled registers per drive
EVERY = 0.5  # s, period of the first register; the others are polled as fast as possible
HEALTHY, FAULTY = 4.0, 8.0  # s before the fault, s of the fault
CYCLES = 10  # poll cycles within which the rate must recover
UNASKED = {str(each) for each in (Status.NOT_ASKED, Status.LINE_LOST, Status.LATE_ANSWER_DUE)}
START, STOP = (Message(31, 6, 0x1000, data=bytes([word, 0])) for word in (0xC4, 0xC0))


class PieceWire(ClockedWire):
    """A faulty wire whose bytes arrive in small pieces, as from a serial port."""

    chunk = 4e-3


class Story:
    """A line before, during and after a fault; all its rows are kept and checked."""

    wires: type[ClockedWire] = PieceWire

    def __init__(
        self, drives: Sequence[Drive], *, seed: int = 1, every: float | None = EVERY, port: str = "pty"
    ) -> None:
        self.every = every
        self.asked = [_polls(drive, every) for drive in drives]
        self.motor = YD1000(31, name="motor")
        sims = [*(EncodedDrive(drive) for drive in drives), simulated(self.motor)]
        self.wire: Any = self.wires(sims, Faults(seed=seed), port=port)
        motor = polled(self.motor, self.motor.readings()[:1], every)
        self.clocked = ClockedLines(self.wire, [*self.asked, motor])
        self.truth = proofs(*self.asked)
        self.rows: list[Row] = []
        self.drives = [*drives, self.motor]

    def run(self, seconds: float) -> list[Row]:
        first = len(self.rows)
        self.rows += self.clocked.run(seconds)
        return self.rows[first:]

    def run_motor(self, seconds: float) -> None:
        """Run for `seconds`; the motor starts and stops once per second."""
        for _ in range(round(seconds)):
            for command in (START, STOP):
                self.clocked.command(self.motor, command)
                self.run(0.5)

    def run_with_fault(self, faults: Faults) -> None:
        """Run the line before, during and after the fault; check that the poll rate recovers."""
        with self.clocked:
            cycle = _longest_gap([row for row in self.run(HEALTHY) if row.value is not None])
            healthy = [row for row in self.run(CYCLES * cycle) if row.value is not None]
            self.wire.faults = faults
            self.run_motor(FAULTY)
            self.wire.faults = Faults()
            self.run(2 * faults.late)  # long enough for all delayed replies to arrive
            begin = self.back_off_is_over() + round(cycle * S)
            end = begin + round(CYCLES * cycle * S)
            self.run((end - self.clocked.now) / S)
            again = [row for row in self.rows if begin <= row.monotonic_ns < end]
            assert len(again) >= len(healthy) * (CYCLES - 1) / CYCLES
            assert {row.status for row in again} == {"ok"}
        self.rows += rows_of(self.clocked.poller)
        self.judge()

    def back_off_is_over(self) -> int:
        """Run until every drive was polled again after the fault; return that time in ns."""
        # s per cycle that silent drives cost, estimated as half of all timeouts
        cost = sum(drive.response_timeout for drive in self.drives) / 2
        longest = max(schedule.LONGEST_PAUSE_NS / S, cost / schedule.SILENT_SHARE)
        longest += Faults().away + polled_line.REOPEN_NS / S + poller.LOOK_NS / S
        ended = self.clocked.now
        asked: dict[str, int] = {}
        while len(asked) < len(self.drives):
            assert self.clocked.now <= ended + longest * S
            for row in self.run(0.5):
                if row.monotonic_ns >= ended and row.status not in UNASKED:
                    asked.setdefault(row.drive, row.monotonic_ns)
        return max(asked.values())

    def judge_values(self) -> None:
        wrong = [
            (row, self.truth[row.drive, row.register])
            for row in self.rows
            if row.value not in (None, self.truth.get((row.drive, row.register), row.value))
        ]
        assert wrong == []

    def judge(self) -> None:
        self.judge_values()
        misses = Counter(row.status for row in self.rows if row.value is None)
        assert {why for why in misses if not why.startswith("exception ")} <= REASONS
        summary = self.clocked.poller.summary()
        line = summary["lines"]["line"]
        assert summary["dropped"] == 0
        assert summary["samples"] + misses.total() == len(self.rows)
        assert Counter(line["misses"]) == misses
        slots = int(self.clocked.seconds / self.every) - 1 if self.every else 0
        rows = Counter((row.drive, row.register) for row in self.rows)
        missing = sum(
            max(0, slots - rows[each.drive.name, each.polls[0].register.name]) for each in self.asked
        )
        assert missing <= line["overrun_slots"]


def _polls(drive: Drive, every: float | None) -> PolledDrive:
    first, *others = drive.readings()[:REGISTERS]
    timed, quick = polled(drive, [first], every), polled(drive, others)
    return PolledDrive(drive, (*timed.polls, *quick.polls))


def _longest_gap(rows: Sequence[Row]) -> float:
    """Return the bus cycle in s, measured as the longest time between successive values of a register."""
    times: dict[tuple[str, str], list[int]] = {}
    for row in rows:
        times.setdefault((row.drive, row.register), []).append(row.monotonic_ns)
    return max(b - a for time in times.values() for a, b in pairwise(time)) / S


# ---- paths that delay all bytes and keep their order, such as a modem, a gateway, a stalled network ----

# argument: time in s at which bytes enter the path; result: their delay in s
Delay = Callable[[float], float]

SECONDS = 150.0  # duration of a run; longer than the 120 s for which a line remembers pending requests
TAIL = 20.0  # s; last part of a run, in which every drive must reply
TURNS = 20  # factor of a path's delay that is added to TAIL


class PathWire(ClockedWire):
    """A faulty wire behind a path that delays the drives' replies."""

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
    """Return a delay function with twelve stalls of up to `longest` s; bytes in a stall leave at its end."""
    random = Random(2)
    begins = [random.uniform(2.0, SECONDS) for _ in range(12)]
    stalls = [(begin, begin + random.uniform(0.5, 1.0) * longest) for begin in begins]

    def delay(now: float) -> float:
        now -= 1000.0  # a run starts at 1000 s on the line's clock
        return max((end - now for begin, end in stalls if begin <= now < end), default=0.0)

    return delay


class Path(Story):
    """A polled line behind a delaying path."""

    wires = PathWire

    def run_over(self, delay: Delay, tail_s: float = TAIL) -> set[str]:
        """Run the line and check every row; return the drives that have values in the last seconds."""
        self.wire.delay = delay
        with self.clocked:
            self.run(SECONDS)
            tail = self.run(tail_s)
        self.judge_values()
        return {row.drive for row in tail if row.value is not None}


class PathLine:
    """A line behind a simulated path, with the interface that `Bus` uses; time passes only while it waits."""

    def __init__(self, wire: PathWire) -> None:
        self.port = self.identity = wire.where if speaks_tcp(wire.where) else "test line"
        self.now = BEGIN_NS
        self.wire = wire
        self.has_echo = self.is_lost = self.is_stalled = False
        self.may_send = True  # always True: this line needs no right to send
        self.is_tcp, self.ids = speaks_tcp(self.port), wire.ids
        self.queue = ClockedPort(self, self.ids if self.is_tcp else None)

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
    """Open a bus over a delaying path to these simulated drives; return the bus and its line."""
    wire.delay = delay
    wire.open()
    line = PathLine(wire)
    monkeypatch.setattr(bus, "Line", lambda port, *facts: line)
    monkeypatch.setattr(drive_records, "_former", {})  # forget timing that was learnt on another clock
    monkeypatch.setattr(clock, "now_ns", lambda: line.now)
    monkeypatch.setattr(clock, "boottime_ns", lambda: line.now)
    monkeypatch.setattr(clock, "sleep", line.sleep)
    opened = Bus(line.port)
    for sim in sims:
        opened.attach(sim.drive)
    return opened, line


def read_truly(opened: Bus, line: PathLine, drives: Sequence[Drive]) -> None:
    """Read four registers of each drive in turn; check that each value belongs to its register."""
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
