"""Run a line without faults, under a fault, and afterwards, on a simulated clock."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

from clocked_lines import ClockedLines, ClockedWire
from lines import polled, proofs, rows_of
from variants import REASONS

from multidrop import poller
from multidrop.core import Message, Status
from multidrop.drive import Drive
from multidrop.families import YD1000
from multidrop.planning import back_off
from multidrop.plant.model import PolledDrive
from multidrop.polling import polled_line
from multidrop.polling.batch import Row
from multidrop.sim import EncodedDrive, Faults, simulated

S = 1_000_000_000
REGISTERS = 5  # per drive
EVERY = 0.5  # s, for the first register; the others as fast as possible
HEALTHY, FAULTY = 4.0, 8.0  # s
CYCLES = 10  # within which the rate must recover
UNASKED = {str(each) for each in (Status.NOT_ASKED, Status.LINE_LOST, Status.LATE_ANSWER_DUE)}
START, STOP = (Message(31, 6, 0x1000, data=bytes([word, 0])) for word in (0xC4, 0xC0))


class PieceWire(ClockedWire):
    """A faulty wire whose bytes come in small pieces, as from a serial port."""

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
        """Run for this many seconds, in each of which the motor starts and stops."""
        for _ in range(round(seconds)):
            for command in (START, STOP):
                self.clocked.command(self.motor, command)
                self.run(0.5)

    def tell(self, faults: Faults) -> None:
        """Run before, during and after the fault; check that the rate recovers."""
        with self.clocked:
            cycle = _longest_gap([row for row in self.run(HEALTHY) if row.value is not None])
            healthy = [row for row in self.run(CYCLES * cycle) if row.value is not None]
            self.wire.faults = faults
            self.run_motor(FAULTY)
            self.wire.faults = Faults()
            self.run(2 * faults.late)  # let delayed replies arrive
            begin = self.back_off_is_over() + round(cycle * S)
            end = begin + round(CYCLES * cycle * S)
            self.run((end - self.clocked.now) / S)
            again = [row for row in self.rows if begin <= row.monotonic_ns < end]
            assert len(again) >= len(healthy) * (CYCLES - 1) / CYCLES
            assert {row.status for row in again} == {"ok"}
        self.rows += rows_of(self.clocked.poller)
        self.judge()

    def back_off_is_over(self) -> int:
        """Run until every drive was polled again; return that time.

        First the port must reopen and the rests of silent drives end.
        """
        cost = sum(drive.response_timeout for drive in self.drives) / 2  # on average, and rarely more
        longest = max(back_off.LONGEST_REST_NS / S, cost / back_off.SILENT_SHARE)
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
        told = self.clocked.poller.summary()
        line = told["lines"]["line"]
        assert told["dropped"] == 0
        assert told["samples"] + misses.total() == len(self.rows)
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
    """Return the bus cycle in s: the longest time between two values of one register."""
    times: dict[tuple[str, str], list[int]] = {}
    for row in rows:
        times.setdefault((row.drive, row.register), []).append(row.monotonic_ns)
    return max(b - a for time in times.values() for a, b in pairwise(time)) / S
