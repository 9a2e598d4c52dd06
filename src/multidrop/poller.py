"""Poller: plan, schedule and lines together, turned into batches of columns.

The lines are kept busy by the core's own thread, which waits for nobody. Where all drives of a line
answer and are polled as fast as it allows, that thread repeats the bus cycle by itself; else one
thread for all lines tops up the core's queues, many exchanges at a time and some way ahead. Rows
gather in the core, in chunks of bounded number; whoever takes them gets the oldest first.
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
from multidrop.core import EXCEPTION_STATUS, STATUSES, Exchange, Field, Inbox, Port, Respondent, Result
from multidrop.drive import Drive
from multidrop.errors import LineError
from multidrop.ledger import Ledger
from multidrop.line import Wake, now_ns, sleep
from multidrop.plan import Block, alone, blocks, in_order, kind, sending, silence
from multidrop.plant import Plant, PolledDrive
from multidrop.register import Register
from multidrop.schedule import Job, Schedule
from multidrop.statistics import LineStatistics, Statistics

LOOK_S = 0.05  # the longest that a line waits to be tended, or whoever wants rows to be told of them
REST_S = 0.5  # the same, where nobody waits for either
FILLING_NS = 10_000_000  # so long new rows gather before they are taken from a chunk that is not full
AHEAD_NS = 300_000_000  # so far ahead the lines are planned
PARTING_NS = 1_000_000_000  # so long the end of the polling waits for what is under way
LEARN_NS = 1_000_000_000  # between looks at how long exchanges take
REFUSALS = 3  # exceptions in a row after which a register is asked for in another way
SET_ASIDE_NS = 60_000_000_000  # between attempts to read a register that the drive refuses
REOPEN_NS = 500_000_000  # between attempts to open a port that was lost


class _Codes:
    """The names that rows are made of, each with its number."""

    def __init__(self) -> None:
        self.drives: dict[str, int] = {}
        self.registers: dict[str, int] = {}

    def fields(self, drive: Drive, block: Block) -> core.Block:
        return core.Block(
            self.drives.setdefault(drive.name, len(self.drives)),
            [
                Field(
                    block.offset(register),
                    register.wire,
                    self.registers.setdefault(register.name, len(self.registers)),
                    register.scale.numerator,
                    register.scale.denominator,
                )
                for register in block.registers
            ],
        )


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


class _PolledLine:
    """A line's bus, its schedule, and what is queued on it. `number` is what the core calls it by."""

    def __init__(self, declared: plant.Line, number: int, bus: Bus, inbox: Inbox, codes: _Codes) -> None:
        self.name = declared.name
        self.bus = bus
        self.schedule: Schedule[_Asked] = Schedule()
        self.started_ns = now_ns()
        self.ended_ns: int | None = None
        self.set_aside: list[_Asked] = []  # a single register that the drive refuses again and again
        self._number = number
        self._inbox = inbox
        self._codes = codes
        self._port: Port | None = None  # that was tended last
        self._done = 0  # exchanges on it, when it was tended last
        self._jobs: list[_Asked] = []  # all there ever were: the core may still look at them
        self._declared: dict[PolledDrive, list[_Asked]] = {}
        self._lock = threading.Lock()  # of all above and below: drives come and go on any thread
        self._is_started = False
        self._ahead_ns = 0  # what is queued will take
        self._learnt_ns = 0
        self.switching = declared.switching  # s; in the end as measured
        self._asked_of: list[tuple[Drive, Respondent]] = []
        self._seen: list[tuple[int, int]] = []  # of each of them: failures in a row, late until
        self._reopening: threading.Thread | None = None
        self._reopen_ns = 0
        self._cycle: list[_Asked] = []  # what the core repeats
        self._queued: deque[tuple[_Asked, int]] = deque()  # what the core has not carried out yet
        try:
            for polled in declared.drives:
                self.add(polled)
        except BaseException:
            self.bus.close()
            raise

    def add(self, polled: PolledDrive) -> None:
        with self._lock:
            drive = self.bus.attach(polled.drive)
            try:
                jobs = self._jobs_of(polled)
            except BaseException:
                self.bus.detach(drive)
                raise
            self._asked_of.append((drive, self.bus.respondent(drive)))
            for job in jobs if self._is_started else []:
                self.schedule.add(job, now_ns())
        self._inbox.call(self._number)

    def _jobs_of(self, polled: PolledDrive) -> list[_Asked]:
        """A drive that comes back has the jobs that it had."""
        drive = polled.drive
        self.bus.line.require((drive.settings.baudrate, drive.settings.format))
        if polled in self._declared:
            return self._declared[polled]
        rates: dict[float | None, list[Register[Any]]] = {}
        for poll in polled.polls:
            rates.setdefault(poll.every, []).append(poll.register)
        jobs: list[_Asked] = []
        for every, registers in rates.items():
            period_ns = None if every is None else round(every * 1e9)
            jobs += [self._job(drive, block, period_ns) for block in blocks(drive, registers)]
        self._jobs += jobs
        self._declared[polled] = jobs
        return jobs

    def remove(self, drive: Drive) -> None:
        with self._lock:
            now = now_ns()
            jobs = [it for it in self.schedule.jobs if it.owner is drive]
            slots = [(it, it.due_ns) for it in jobs if it.period_ns and it.due_ns <= now]
            self._miss(slots, Result.POLL_ENDED)
            for job in jobs:
                self.schedule.remove(job)
            self.schedule.forget(drive.address)
            self.set_aside = [it for it in self.set_aside if it.owner is not drive]
            self._asked_of = [it for it in self._asked_of if it[0] is not drive]
        self.bus.detach(drive)
        self._inbox.call(self._number)

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
        with self._lock:
            self.started_ns = now_ns()
            self.bus.reset_statistics()
            polled = {it.drive: jobs for it, jobs in self._declared.items()}
            for drive in in_order(self.bus.drives, self.switching):
                for job in polled[drive]:
                    self.schedule.add(job, self.started_ns)
            self._is_started = True

    @property
    def is_steady(self) -> bool:
        """Nothing is to be done for it until the core calls."""
        return bool(self._cycle)

    def tend(self, now: int) -> None:
        """See what became of what was queued, and queue what comes next."""
        with self._lock:
            self._tend(now)

    def _tend(self, now: int) -> None:
        port = self.bus.line.queue
        if port is None:
            self._regain(now)
            return
        if port is not self._port:
            self._port, self._done = port, 0
            port.report_to(self._inbox, self._number)
        self._forget_done(port)
        if port.lost:
            self._lose(port, now)
            return
        self._observe(now)
        self._heed_refusals(now)
        self._keep_busy(port, now)

    def _forget_done(self, port: Port) -> None:
        done = port.done
        for _ in range((done - self._done) & 0xFFFF_FFFF):
            self._ahead_ns -= self._queued.popleft()[0].duration_ns
        self._done = done

    def _lose(self, port: Port, now: int) -> None:
        """The port failed: what was queued on it is missed."""
        port.stop()
        self._forget_done(port)
        self._miss(list(self._queued), Result.LINE_LOST)
        self._queued.clear()
        self._cycle = []
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

    def _keep_busy(self, port: Port, now: int) -> None:
        cycle = self.schedule.cycle(now)
        if cycle != self._cycle or port.repeating != bool(cycle):
            following = port.repeat([])
            if self._cycle:
                self.schedule.go_on(self._cycle[following])
            self._cycle = self.schedule.cycle(now)
            if self._cycle:
                port.repeat([job.exchange for job in self._cycle])
        if not self._cycle:
            self._top_up(port, now)
        if self.schedule.unasked:
            self._miss(self.schedule.unasked, Result.NOT_ASKED)
            self.schedule.unasked = []

    def _top_up(self, port: Port, now: int) -> None:
        done_ns = max(now + self._ahead_ns, self._queued[-1][1] if self._queued else 0)
        queued = self.schedule.take(now, done_ns, now + AHEAD_NS, port.room - len(self._queued))
        if queued:
            port.submit([job.exchange for job, _ in queued], [due_ns for _, due_ns in queued])
            self._queued += queued
            self._ahead_ns += sum(job.duration_ns for job, _ in queued)

    def _miss(self, slots: list[tuple[_Asked, int]], why: Result) -> None:
        for job, due_ns in slots:
            job.exchange.respondent.unasked[why] += job.fields.count
            self._inbox.add_miss(job.fields, why, due_ns)

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
        """No port is opened again; what is under way goes on."""
        if self._reopening:
            self._reopening.join()
        self.ended_ns = now_ns()
        if port := self.bus.line.queue:
            self.switching = port.switching

    @property
    def is_under_way(self) -> bool:
        """An exchange that was begun is not over yet."""
        port = self.bus.line.queue
        return port is not None and port.end()

    def close(self) -> None:
        with self._lock:
            self._close()

    def _close(self) -> None:
        ended_ns = self.ended_ns or now_ns()
        port = self.bus.line.queue
        if port:
            port.stop()
            self._forget_done(port)
            slots = [*self._queued, *self.schedule.pass_slots(ended_ns)]
            self._miss([(job, due_ns) for job, due_ns in slots if 0 < due_ns <= ended_ns], Result.POLL_ENDED)
        else:
            self._miss(self.schedule.pass_slots(ended_ns), Result.LINE_LOST)
        self.schedule = Schedule()
        self.bus.close()

    def summary(self) -> dict[str, Any]:
        with self._lock:
            return self._summary()

    def _summary(self) -> dict[str, Any]:
        seconds = max(((self.ended_ns or now_ns()) - self.started_ns) / 1e9, 1e-9)
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
            "switching_ms": round(self.switching * 1e3, 3),
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
            "p99_delay_ms": round(Statistics(seconds, tally).delays.p99 * 1e3, 3),
            "misses": dict(misses),
        }


class Poller:
    """Polls a plant as its file says, from `with` on until the block is left.

    Raises LineError when a port cannot be opened; later failures are rows that say why a value is
    missing. Any thread may take batches, and add or remove drives; commands go through `bus(line)`, ahead
    of the polling, and are counted in `ledger` and noted in `audit`, as Bus says.
    """

    def __init__(
        self,
        plant: Plant,
        *,
        ledger: Ledger | Path | str | None = None,
        audit: Path | str | None = None,
    ) -> None:
        self._codes = _Codes()
        self._inbox = Inbox()
        self._wake = Wake()
        self._taken_ns = 0  # the newest rows
        self._is_watched = False  # somebody waits for `fileno`
        self._lines: list[_PolledLine] = []
        self._closing = False
        self._changing = threading.Lock()  # one drive comes or goes at a time
        self._thread = threading.Thread(target=self._poll, name="multidrop poller", daemon=True)
        try:
            for number, declared in enumerate(plant.lines):
                bus = Bus(declared.port, ledger=ledger, audit=audit)
                self._lines.append(_PolledLine(declared, number, bus, self._inbox, self._codes))
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
            self._inbox.call(0)
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
        self._wake.close()

    def _poll(self) -> None:
        called: Iterable[_PolledLine] = self._lines
        while not self._closing:
            for line in called:
                line.tend(now_ns())
            if self._is_watched and self._inbox.chunks:
                self._wake.set()
            restless = [line for line in self._lines if not line.is_steady]
            seconds = LOOK_S if restless or self._is_watched else REST_S
            called = dict.fromkeys([*restless, *(self._lines[it] for it in self._inbox.await_calls(seconds))])

    def add(self, line: str, polled: PolledDrive) -> None:
        """Poll one more drive on this line, from now on.

        Raises ValueError when there is no such line, or its name or address is taken.
        """
        with self._changing:
            names = {drive.name for bus in self.buses.values() for drive in bus.drives}
            if polled.drive.name in names:
                raise ValueError(f"another drive is called {polled.drive.name}; give every one its own name")
            self._line(line).add(polled)

    def remove(self, line: str, drive: str) -> None:
        """Poll the drive of this name no more; its motor goes on as it is.

        What is queued of it is still asked. Raises ValueError when there is none.
        """
        with self._changing:
            found = self._line(line)
            for it in found.bus.drives:
                if it.name == drive:
                    return found.remove(it)
        raise ValueError(f"there is no drive {drive!r} on line {line!r}")

    def _line(self, name: str) -> _PolledLine:
        for line in self._lines:
            if line.name == name:
                return line
        raise ValueError(f"there is no line {name!r}; there are {', '.join(self.buses)}")

    @property
    def buses(self) -> dict[str, Bus]:
        """The lines' buses, by name."""
        return {polled.name: polled.bus for polled in self._lines}

    def bus(self, line: str) -> Bus:
        """The bus of the line with this name."""
        return self._line(line).bus

    def fileno(self) -> int:
        """A descriptor that is readable while rows wait to be taken, for select or an asyncio loop."""
        self._is_watched = True
        self._inbox.call(0)
        return self._wake.fileno()

    def take(self) -> Batch | None:
        """The oldest rows that wait, at once; None when there are none, or only just a few new ones."""
        now, chunks = now_ns(), self._inbox.chunks
        if chunks < 2:
            self._wake.clear()
            if now - self._taken_ns < FILLING_NS and not self._closing:
                return None
            self._taken_ns = now
        columns = self._inbox.take()
        return Batch(columns, list(self._codes.drives), list(self._codes.registers)) if columns else None

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
            "dropped": self._inbox.dropped,
        }
