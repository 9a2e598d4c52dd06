"""Poller: plan, schedule and lines together, turned into batches of columns.

One thread for all lines tops up the core's queues, many exchanges at a time and some way ahead, and
collects what became of them; the lines themselves are kept busy by the core's own thread, which
waits for nobody. Rows gather in chunks of bounded number; whoever takes them gets the oldest first.
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from multidrop import core, plant
from multidrop.batch import Batch
from multidrop.bus import Bus, exchange
from multidrop.core import EXCEPTION_STATUS, STATUSES, Columns, Exchange, Field, Port, Respondent, Result
from multidrop.drive import Drive
from multidrop.errors import LineError
from multidrop.ledger import Ledger
from multidrop.line import Wake, await_notice, now_ns, sleep, utc_minus_monotonic_ns
from multidrop.plan import Block, alone, blocks, in_order, kind, sending, silence
from multidrop.plant import Plant
from multidrop.register import Register
from multidrop.schedule import Job, Schedule
from multidrop.statistics import LineStatistics

LOOK_S = 0.05  # the longest that rows wait to be collected
AHEAD_NS = 300_000_000  # so far ahead the lines are planned
PARTING_NS = 1_000_000_000  # so long the end of the polling waits for what is under way
LEARN_NS = 1_000_000_000  # between looks at how long exchanges take
REFUSALS = 3  # exceptions in a row after which a register is asked for in another way
SET_ASIDE_NS = 60_000_000_000  # between attempts to read a register that the drive refuses
REOPEN_NS = 500_000_000  # between attempts to open a port that was lost
CHUNK_ROWS = 1 << 12
MOST_FIELDS = 2000  # of a block: as many bits as one reply holds
MOST_CHUNKS = 256  # that wait to be taken; further rows are dropped, and counted


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


@dataclass(eq=False, kw_only=True)
class _Asked(Job):
    """A job with what the core needs to carry it out and to make rows of it."""

    owner: Drive
    block: Block
    exchange: Exchange
    fields: core.Block

    def expected_ns(self, response_delay: float) -> int:
        """How long it takes from the end of the one before."""
        return round((silence(self.owner) + sending(self.owner, self.block) + response_delay) * 1e9)


class _Rows:
    """The rows that nobody has taken yet, in chunks."""

    def __init__(self, codes: _Codes) -> None:
        self.wake = Wake()
        self.dropped = 0
        self._codes = codes
        self._lock = threading.Lock()
        self._chunks = deque([Columns(CHUNK_ROWS)])

    def collect(self, port: Port) -> int:
        """Make rows of all that a port has carried out; how many exchanges that were."""
        offset = utc_minus_monotonic_ns()
        count = 0
        with self._lock:
            while True:
                columns = self._last()
                count += port.reap(columns, offset)
                if CHUNK_ROWS - len(columns) >= MOST_FIELDS:
                    break
        if count:
            self.wake.set()
        return count

    def add_misses(self, slots: Iterable[tuple[_Asked, int]], why: Result) -> None:
        offset = utc_minus_monotonic_ns()
        with self._lock:
            for job, due_ns in slots:
                self._last().add_miss(job.fields, why, due_ns, offset)
        self.wake.set()

    def _last(self) -> Columns:
        """A chunk with room for any block; when too many wait, the newest one's rows are dropped."""
        if CHUNK_ROWS - len(self._chunks[-1]) < MOST_FIELDS:
            if len(self._chunks) < MOST_CHUNKS:
                self._chunks.append(Columns(CHUNK_ROWS))
            else:
                self.dropped += len(self._chunks[-1])
                self._chunks[-1].clear()
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

    def close(self) -> None:
        """No more rows will come; those that wait can still be taken."""
        with self._lock:
            self.wake.close()


class _PolledLine:
    """A line's bus, its schedule, and what is queued on it."""

    def __init__(self, declared: plant.Line, bus: Bus, rows: _Rows, codes: _Codes) -> None:
        self.name = declared.name
        self.bus = bus
        self.schedule: Schedule[_Asked] = Schedule()
        self.started_ns = self.ended_ns = now_ns()
        self.set_aside: list[_Asked] = []  # a single register that the drive refuses again and again
        self._rows = rows
        self._codes = codes
        self._jobs: list[_Asked] = []  # all there ever were: the core may still look at them
        self._ahead_ns = 0  # what is queued will take
        self._learnt_ns = 0
        self._left: int | None = None  # in the queue, with the one that was under way when it ended
        self._asked_of: list[tuple[Drive, Respondent]] = []
        self._seen: list[tuple[int, int]] = []  # of each of them: failures in a row, late until
        self._reopening: threading.Thread | None = None
        self._reopen_ns = 0
        self._queued: deque[tuple[_Asked, int]] = deque()  # what the core has and we have no outcome of
        try:
            for polled in declared.drives:
                self.bus.attach(polled.drive)
                self._asked_of.append((polled.drive, self.bus.respondent(polled.drive)))
                self._declare(polled)
            for job in self._jobs:
                self.bus.line.require(job.exchange.settings)
        except BaseException:
            self.bus.close()
            raise

    def _declare(self, polled: plant.PolledDrive) -> None:
        drive = polled.drive
        rates: dict[float | None, list[Register[Any]]] = {}
        for poll in polled.polls:
            rates.setdefault(poll.every, []).append(poll.register)
        for every, registers in rates.items():
            period_ns = None if every is None else round(every * 1e9)
            self._jobs += [self._job(drive, block, period_ns) for block in blocks(drive, registers)]

    def _job(self, drive: Drive, block: Block, period_ns: int | None) -> _Asked:
        fields = self._codes.fields(drive, block)
        request, respondent = block.request(drive.address), self.bus.respondent(drive)
        job = _Asked(
            drive=drive.address,
            kind=kind(drive),
            period_ns=period_ns,
            duration_ns=0,
            owner=drive,
            block=block,
            exchange=exchange(drive, request, respondent, fields, period=(period_ns or 0) / 1e9),
            fields=fields,
        )
        job.duration_ns = job.expected_ns(drive.response_delay)
        return job

    def start(self) -> None:
        self.started_ns = self.ended_ns = now_ns()
        self.bus.reset_statistics()
        place = {drive: at for at, drive in enumerate(in_order(self.bus.drives))}
        for job in sorted(self._jobs, key=lambda job: place[job.owner]):
            self.schedule.add(job, self.started_ns)

    def tend(self, now: int) -> None:
        """Collect what was carried out, and queue what comes next."""
        self.ended_ns = now
        port = self.bus.line.queue
        if port is None:
            self._regain(now)
            return
        count = self._collect(port)
        if port.lost:
            self._lose(port, now)
            return
        if count or port.pending == 0:
            self._observe(now)
            self._heed_refusals(now)
            self._top_up(port, now)

    def _collect(self, port: Port) -> int:
        count = self._rows.collect(port)
        for _ in range(count):
            self._ahead_ns -= self._queued.popleft()[0].duration_ns
        return count

    def _lose(self, port: Port, now: int) -> None:
        """The port failed: what was queued on it is missed."""
        port.stop()
        self._collect(port)
        self._miss(list(self._queued), Result.LINE_LOST)
        self._queued.clear()
        self._ahead_ns = 0
        self.bus.line.close()
        self._reopen_ns = now

    def _observe(self, now: int) -> None:
        if now - self._learnt_ns >= LEARN_NS:
            self._learn(now)
        seen = [(respondent.failures, respondent.late_until_ns) for _, respondent in self._asked_of]
        if seen == self._seen:
            return
        self._seen = seen
        for (drive, _), (failures, late_until_ns) in zip(self._asked_of, seen, strict=True):
            self.schedule.observe(
                drive.address,
                failures,
                now,
                late_until_ns=late_until_ns,
                cost_ns=round(drive.response_timeout * 1e9),
            )

    def _learn(self, now: int) -> None:
        """How long exchanges take, by the drives' own response delays."""
        self._learnt_ns = now
        delays = {drive: respondent.response_delay for drive, respondent in self._asked_of}
        for job in self.schedule.jobs:
            job.duration_ns = job.expected_ns(delays[job.owner] or job.owner.response_delay)
        self._ahead_ns = sum(job.duration_ns for job, _ in self._queued)

    def _heed_refusals(self, now: int) -> None:
        """Registers that are refused together are asked for singly; a single one is set aside.

        So no register is lost because of its neighbours.
        """
        for job in [it for it in self.schedule.jobs if it.fields.refusals >= REFUSALS]:
            if len(job.block.registers) > 1:
                parts = [self._job(job.owner, alone(it), job.period_ns) for it in job.block.registers]
            elif job in self.set_aside:
                continue
            else:
                parts = [self._job(job.owner, job.block, SET_ASIDE_NS)]
                self.set_aside += parts
            self.schedule.remove(job)
            for part in parts:
                self._jobs.append(part)
                self.schedule.add(part, now)

    def _top_up(self, port: Port, now: int) -> None:
        room = port.room - len(self._queued)  # what is carried out keeps its place until it is collected
        done_ns = max(now + self._ahead_ns, self._queued[-1][1] if self._queued else 0)
        queued = self.schedule.take(now, done_ns, now + AHEAD_NS, room)
        if queued:
            port.submit([job.exchange for job, _ in queued], [due_ns for _, due_ns in queued])
            self._queued += queued
            self._ahead_ns += sum(job.duration_ns for job, _ in queued)
        if self.schedule.unasked:
            self._miss(self.schedule.unasked, Result.NOT_ASKED)
            self.schedule.unasked = []

    def _miss(self, slots: list[tuple[_Asked, int]], why: Result) -> None:
        for job, _ in slots:
            job.exchange.respondent.unasked[why] += job.fields.count
        self._rows.add_misses(slots, why)

    def _regain(self, now: int) -> None:
        """Until the port is back every value that is due is missed because of it."""
        if now < self._reopen_ns or (self._reopening and self._reopening.is_alive()):
            return
        self._miss(self.schedule.pass_all(now), Result.LINE_LOST)
        self._reopen_ns = now + REOPEN_NS
        self._reopening = threading.Thread(target=self._reopen, daemon=True)
        self._reopening.start()

    def _reopen(self) -> None:
        with suppress(LineError):
            self.bus.line.reopen()

    def end(self) -> None:
        """Begin nothing more; what is under way goes on."""
        if self._reopening:
            self._reopening.join()
        self.ended_ns = now_ns()
        port = self.bus.line.queue
        if port and port.end():
            self._left = port.pending

    @property
    def is_under_way(self) -> bool:
        """An exchange that was begun is not over yet."""
        port = self.bus.line.queue
        return port is not None and port.pending == self._left

    def close(self) -> None:
        port = self.bus.line.queue
        if port:
            port.stop()
            self._collect(port)
            self._miss(self._unfinished(), Result.POLL_ENDED)
        else:
            self._miss(self.schedule.pass_slots(self.ended_ns), Result.LINE_LOST)
        self.schedule = Schedule()
        self.bus.close()

    def _unfinished(self) -> list[tuple[_Asked, int]]:
        """What was due at the end: slots that had begun, and the first in the queue if it is under way."""
        queued = list(self._queued)
        if queued and len(queued) == self._left:
            job, due_ns = queued[0]
            queued[0] = job, due_ns or self.ended_ns
        slots = [*queued, *self.schedule.pass_slots(self.ended_ns)]
        return [(job, due_ns) for job, due_ns in slots if 0 < due_ns <= self.ended_ns]

    def summary(self) -> dict[str, Any]:
        seconds = max((self.ended_ns - self.started_ns) / 1e9, 1e-9)
        drives = {drive.name: self._told(drive, seconds) for drive in self.bus.drives}
        tallies = [self.bus.respondent(drive).tally() for drive in self.bus.drives]
        misses: Counter[str] = sum((Counter(it["misses"]) for it in drives.values()), Counter())
        return {
            "seconds": round(seconds, 3),
            "exchanges": sum(tally.exchanges for tally in tallies),
            "samples": sum(tally.values for tally in tallies),
            "misses": dict(misses),
            "late_replies": sum(tally.late for tally in tallies),
            "stray_bytes": sum(tally.stray_bytes for tally in tallies),
            "utilisation": round(sum(tally.ideal_ns for tally in tallies) / 1e9 / seconds, 4),
            "overrun_slots": sum(job.skipped for job in self._jobs),
            "set_aside": [f"{job.owner.name}.{job.block.registers[0].name}" for job in self.set_aside],
            "drives": drives,
        }

    def _told(self, drive: Drive, seconds: float) -> dict[str, Any]:
        respondent = self.bus.respondent(drive)
        tally = respondent.tally()
        misses = Counter({str(why): count for why, count in tally.missed.items()})
        misses.update({STATUSES[EXCEPTION_STATUS + code]: n for code, n in tally.refused.items()})
        return {
            "exchanges": tally.exchanges,
            "samples": tally.values,
            "exchanges_per_second": round(tally.answered / seconds, 2),
            "samples_per_second": round(tally.values / seconds, 2),
            "response_delay_ms": round(respondent.response_delay * 1e3, 3),
            "misses": dict(misses),
        }


class Poller:
    """Polls a plant as its file says, from `with` on until the block is left.

    Raises LineError when a port cannot be opened; later failures are rows that say why a value is
    missing. Any thread may take batches; commands go through `bus(line)`, ahead of the polling, and are
    counted in `ledger` and noted in `audit`, as Bus says.
    """

    def __init__(
        self,
        plant: Plant,
        *,
        ledger: Ledger | Path | str | None = None,
        audit: Path | str | None = None,
    ) -> None:
        codes = _Codes()
        self._rows = _Rows(codes)
        self._lines: list[_PolledLine] = []
        self._closing = False
        self._thread = threading.Thread(target=self._poll, name="multidrop poller", daemon=True)
        try:
            for declared in plant.lines:
                bus = Bus(declared.port, ledger=ledger, audit=audit)
                self._lines.append(_PolledLine(declared, bus, self._rows, codes))
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Poller:
        for line in self._lines:
            line.start()
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Stop polling and close the ports; rows not yet taken can still be.

        What is under way is waited for, for a second at most; every slot that was due by now has a row.
        """
        if self._closing:
            return
        self._closing = True
        if self._thread.is_alive():
            self._thread.join()
        for line in self._lines:
            line.bus.part()  # before the port is closed, on which it stops motors
        for line in self._lines:
            line.end()
        given_up_ns = now_ns() + PARTING_NS
        while any(line.is_under_way for line in self._lines) and now_ns() < given_up_ns:
            sleep(0.001)
        for line in self._lines:
            line.close()
        self._rows.close()

    def _poll(self) -> None:
        while not self._closing:
            for line in self._lines:
                line.tend(now_ns())
            await_notice(LOOK_S)

    @property
    def buses(self) -> dict[str, Bus]:
        """The lines' buses, by name."""
        return {polled.name: polled.bus for polled in self._lines}

    def bus(self, line: str) -> Bus:
        """The bus of the line with this name."""
        if line not in self.buses:
            raise ValueError(f"there is no line {line!r}; there are {', '.join(self.buses)}")
        return self.buses[line]

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

    def statistics(self) -> dict[str, LineStatistics]:
        """Of each line by name, since polling began or `reset_statistics`, also per drive; cheap."""
        return {line.name: line.bus.statistics() for line in self._lines}

    def reset_statistics(self) -> None:
        """Count from here on; `summary` is always since the beginning."""
        for line in self._lines:
            line.bus.reset_statistics()

    def summary(self) -> dict[str, Any]:
        """So far, per line and drive: exchanges, values, misses by reason, rates, utilisation."""
        lines = {line.name: line.summary() for line in self._lines}
        return {
            "lines": lines,
            "samples": sum(line["samples"] for line in lines.values()),
            "misses": sum(sum(line["misses"].values()) for line in lines.values()),
            "dropped": self._rows.dropped,
        }
