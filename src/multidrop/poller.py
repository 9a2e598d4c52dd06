"""Poller: plan, schedule and line together, turned into batches of columns.

One thread a line tops up the core with exchanges and collects what became of them. Rows gather in
one table of bounded size; whoever takes them gets all that came since the last time.
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any

from multidrop import core, plant
from multidrop.batch import Batch
from multidrop.bus import Bus, exchange
from multidrop.core import Columns, Completion, Completions, Exchange, Field, Result, now_ns
from multidrop.drive import Drive
from multidrop.errors import LineError
from multidrop.line import Wake, sleep, utc_minus_monotonic_ns
from multidrop.plan import Block, blocks, duration, ideal_ns
from multidrop.plant import Plant
from multidrop.register import Register
from multidrop.schedule import Job, Schedule

RUN_NS = 50_000_000  # a run of exchanges takes about so long, so that its rows arrive soon
RUN_EXCHANGES = 256
REOPEN_S = 0.5  # between attempts to open a port that was lost
CHUNK_ROWS = 1 << 14
MOST_CHUNKS = 64  # that wait to be taken; further rows are dropped, and counted


class _Codes:
    """The names that rows are made of, each with its number."""

    def __init__(self) -> None:
        self.drives: list[str] = []
        self.registers: list[str] = []

    def fields(self, drive: Drive, block: Block) -> core.Block:
        return core.Block(
            [
                Field(
                    block.offset(register),
                    register.wire,
                    _code(self.drives, drive.name),
                    _code(self.registers, register.name),
                    register.scale.numerator,
                    register.scale.denominator,
                )
                for register in block.registers
            ]
        )


def _code(names: list[str], name: str) -> int:
    if name not in names:
        names.append(name)
    return names.index(name)


@dataclass
class Tally:
    """What became of a drive's exchanges so far."""

    exchanges: int = 0
    answered: int = 0
    values: int = 0
    skipped_bytes: int = 0
    ideal_ns: int = 0  # what the answered exchanges had to take
    misses: Counter[str] = field(default_factory=Counter)


@dataclass(eq=False, kw_only=True)
class _Asked(Job):
    """A job with all that is needed to ask, and to make rows of the answer."""

    exchange: Exchange
    fields: core.Block
    tally: Tally


class _Rows:
    """The rows that nobody has taken yet, in chunks."""

    def __init__(self, codes: _Codes) -> None:
        self.wake = Wake()
        self.dropped = 0
        self._codes = codes
        self._lock = threading.Lock()
        self._chunks = deque([Columns(CHUNK_ROWS)])

    def add(self, jobs: Sequence[_Asked], completions: Completions) -> None:
        offset = utc_minus_monotonic_ns()
        with self._lock:
            for at, job in enumerate(jobs):
                if not self._room(job.fields.count).add(job.fields, completions, at, offset):
                    self.dropped += job.fields.count
        self.wake.set()

    def add_misses(self, slots: Iterable[tuple[_Asked, int]], why: Result) -> None:
        offset = utc_minus_monotonic_ns()
        with self._lock:
            for job, due_ns in slots:
                job.tally.misses[str(why)] += job.fields.count
                if not self._room(job.fields.count).add_miss(job.fields, why, due_ns, offset):
                    self.dropped += job.fields.count
        self.wake.set()

    def _room(self, rows: int) -> Columns:
        if CHUNK_ROWS - len(self._chunks[-1]) < rows and len(self._chunks) < MOST_CHUNKS:
            self._chunks.append(Columns(CHUNK_ROWS))
        return self._chunks[-1]

    def take(self) -> Batch | None:
        with self._lock:
            oldest = self._chunks[0]
            if not len(oldest):
                self.wake.clear()
                return None
            self._chunks.popleft()
            if not self._chunks:
                self._chunks.append(Columns(CHUNK_ROWS))
        return Batch(oldest, self._codes.drives, self._codes.registers)


class _PolledLine:
    """A line's bus, its schedule, and the thread that keeps it busy."""

    def __init__(self, declared: plant.Line, rows: _Rows, codes: _Codes) -> None:
        self.name = declared.name
        self.bus = Bus(declared.port)
        self.tallies: dict[str, Tally] = {}
        self.started_ns = self.ended_ns = now_ns()
        self.jobs: list[_Asked] = []
        self._rows = rows
        self._schedule: Schedule[_Asked] = Schedule()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._poll, name=f"multidrop {self.name}", daemon=True)
        for polled in declared.drives:
            self.bus.attach(polled.drive)
            self._declare(polled, codes)

    def _declare(self, polled: plant.PolledDrive, codes: _Codes) -> None:
        drive = polled.drive
        tally = self.tallies[drive.name] = Tally()
        rates: dict[float | None, list[Register[Any]]] = {}
        for poll in polled.polls:
            rates.setdefault(poll.every, []).append(poll.register)
        for every, registers in rates.items():
            for block in blocks(drive, registers):
                self.jobs.append(
                    _Asked(
                        drive=drive.address,
                        period_ns=None if every is None else round(every * 1e9),
                        duration_ns=round(duration(drive, block) * 1e9),
                        exchange=exchange(drive, block.request(drive.address)),
                        fields=codes.fields(drive, block),
                        tally=tally,
                    )
                )

    def start(self) -> None:
        self.started_ns = self.ended_ns = now_ns()
        for job in sorted(self.jobs, key=_kinship):
            self._schedule.add(job, self.started_ns)
        self._thread.start()

    def close(self) -> None:
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()
        self.bus.close()

    def _poll(self) -> None:
        completions = Completions(RUN_EXCHANGES)
        while not self._closing.is_set():
            now = now_ns()
            jobs = self._schedule.take(now, RUN_NS)[:RUN_EXCHANGES]
            unasked = self._schedule.unasked(now)
            if unasked:
                self._rows.add_misses(unasked, Result.NOT_ASKED)
            if not jobs:
                self._idle(now)
            elif not self._run(sorted(jobs, key=_kinship), completions):
                self._regain_port()
            self.ended_ns = now_ns()

    def _idle(self, now: int) -> None:
        due_ns = self._schedule.next_ns(now)
        wait_ns = RUN_NS if due_ns is None else min(max(0, due_ns - now), RUN_NS)
        self._closing.wait(wait_ns / 1e9)

    def _run(self, jobs: list[_Asked], completions: Completions) -> bool:
        """Carry them out and make rows of what became of them; False when the port was lost."""
        try:
            count = self.bus.line.run([job.exchange for job in jobs], completions)
        except LineError:
            return False
        now = now_ns()
        lost = None
        for job, completion in zip(jobs, completions, strict=False):
            self._finished(job, completion, now)
            lost = self.bus.line.failure(completion.result, completion.error)
        self._rows.add(jobs[:count], completions)
        return lost is None

    def _finished(self, job: _Asked, completion: Completion, now: int) -> None:
        tally = job.tally
        tally.exchanges += 1
        tally.skipped_bytes += completion.skipped + completion.stale
        if completion.status:
            tally.misses[core.status_text(completion.status)] += job.fields.count
        else:
            tally.values += job.fields.count
        answered = completion.result > 0
        if answered:
            tally.answered += 1
            tally.ideal_ns += ideal_ns(job.exchange, completion)
        may_come_late = completion.result in (Result.NO_REPLY, Result.CUT_SHORT)
        late_ns = job.exchange.timeout_ns if may_come_late else 0
        self._schedule.done(job, now, answered=answered, late_ns=late_ns)

    def _regain_port(self) -> None:
        """Until the port is back every value that is due is missed because of it."""
        while not self._closing.wait(REOPEN_S):
            self._rows.add_misses(self._schedule.pass_all(now_ns()), Result.LINE_LOST)
            try:
                return self.bus.line.reopen()
            except LineError:
                continue
        return None


def _kinship(job: _Asked) -> tuple[object, ...]:
    """Exchanges of like settings and silence stand side by side, so that the line switches seldom."""
    return (*job.exchange.settings, job.exchange.silence_ns)


class Poller:
    """Polls a plant as its file says, from `with` on until the block is left.

    Raises LineError when a port cannot be opened; later failures are rows that say why a value is
    missing. Any thread may take batches; commands go through `bus(line)`, ahead of the polling.
    """

    def __init__(self, plant: Plant) -> None:
        codes = _Codes()
        self._rows = _Rows(codes)
        self._lines: list[_PolledLine] = []
        try:
            for declared in plant.lines:
                self._lines.append(_PolledLine(declared, self._rows, codes))
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Poller:
        for line in self._lines:
            line.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Stop polling and close the ports; rows not yet taken can still be."""
        for line in self._lines:
            line.close()

    def bus(self, line: str) -> Bus:
        """The bus of the line with this name."""
        for polled in self._lines:
            if polled.name == line:
                return polled.bus
        raise ValueError(f"there is no line {line!r}; there are {', '.join(it.name for it in self._lines)}")

    def fileno(self) -> int:
        """A descriptor that is readable while rows wait to be taken, for select or an asyncio loop."""
        return self._rows.wake.fileno()

    def take(self) -> Batch | None:
        """The oldest rows that wait, at once; None when there are none."""
        return self._rows.take()

    def batches(self, seconds: float | None = None, *, every: float = 0.1) -> Iterator[Batch]:
        """Batches as they come, about one `every` s, for `seconds` s or until the caller leaves off."""
        end_ns = None if seconds is None else now_ns() + round(seconds * 1e9)
        while end_ns is None or now_ns() < end_ns:
            sleep(every if end_ns is None else min(every, max(0.0, (end_ns - now_ns()) / 1e9)))
            while batch := self.take():
                yield batch

    def summary(self) -> dict[str, Any]:
        """So far, per line and drive: exchanges, values, misses by reason, rates, utilisation."""
        lines = {line.name: _line_summary(line) for line in self._lines}
        return {
            "lines": lines,
            "samples": sum(line["samples"] for line in lines.values()),
            "misses": sum(sum(line["misses"].values()) for line in lines.values()),
            "dropped": self._rows.dropped,
        }


def _line_summary(line: _PolledLine) -> dict[str, Any]:
    seconds = max((line.ended_ns - line.started_ns) / 1e9, 1e-9)
    tallies = line.tallies.values()
    misses: Counter[str] = sum((tally.misses for tally in tallies), Counter())
    return {
        "seconds": round(seconds, 3),
        "exchanges": sum(tally.exchanges for tally in tallies),
        "samples": sum(tally.values for tally in tallies),
        "misses": dict(misses),
        "skipped_bytes": sum(tally.skipped_bytes for tally in tallies),
        "utilisation": round(sum(tally.ideal_ns for tally in tallies) / 1e9 / seconds, 4),
        "overrun_slots": sum(job.skipped for job in line.jobs),
        "drives": {
            name: {
                "exchanges": tally.exchanges,
                "samples": tally.values,
                "samples_per_second": round(tally.values / seconds, 2),
                "exchanges_per_second": round(tally.answered / seconds, 2),
                "misses": dict(tally.misses),
            }
            for name, tally in line.tallies.items()
        },
    }
