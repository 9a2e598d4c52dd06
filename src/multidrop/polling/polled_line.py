"""A line that is polled: its schedule, what is queued on it, and what to do when that fails.

Where all its drives answer and are polled as fast as it allows, the core repeats the bus cycle by
itself; else its queue is topped up, many exchanges at a time and some way ahead. Blocks are chosen
anew when a drive's response delay turns out to be another than its document's. A register that is
refused is set aside, and a port that was lost is opened again.
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from multidrop import core
from multidrop.bus import Bus
from multidrop.control.rules import check_own
from multidrop.core import (
    EXCEPTION_STATUS,
    STATUSES,
    Exchange,
    Field,
    Names,
    Peer,
    Port,
    RowQueue,
    Status,
)
from multidrop.core.fork import register_at_fork
from multidrop.drive.family import Drive
from multidrop.errors import LineError
from multidrop.planning.blocks import Block, Plan, alone
from multidrop.planning.bus_time import in_order, kind, sending, silence
from multidrop.planning.schedule import Asking, Job, Schedule
from multidrop.plant import model as plant
from multidrop.plant.model import PolledDrive
from multidrop.transport.clock import now_ns
from multidrop.transport.exchange import reading
from multidrop.transport.statistics import Statistics

AHEAD_NS = 300_000_000  # so far ahead the lines are planned
LEARN_NS = 1_000_000_000  # between looks at how long exchanges take
RELEARN_NS = 2_000_000_000  # the same, where the core repeats the bus cycle
MARGIN = 0.05  # of a response delay: so far beyond those that a plan suits, it is not worth another one
REFUSALS = 3  # exceptions in a row after which a register is asked for in another way
SET_ASIDE_NS = 60_000_000_000  # between attempts to read a register that the drive refuses
REOPEN_NS = 500_000_000  # between attempts to open a port that was lost


class Codes:
    """The names that rows are made of."""

    def __init__(self) -> None:
        self.drives = Names()
        self.registers = Names()

    def fields(self, drive: Drive, block: Block) -> core.RowLayout:
        return core.RowLayout(
            self.drives.number(drive.name),
            [
                Field(
                    block.offset(register),
                    register.number_format,
                    self.registers.number(register.name),
                    register.scale.numerator,
                    register.scale.denominator,
                )
                for register in block.registers
            ],
        )


@dataclass(eq=False, kw_only=True)
class PolledJob(Job):
    """A job with what the core needs to carry it out and to make rows of it."""

    owner: Drive
    block: Block
    exchange: Exchange
    fields: core.RowLayout
    own_ns: int  # of silence and characters, to which the response delay comes


@dataclass
class Chosen:
    """The jobs that read a drive in the least time, and the plan that they carry out."""

    jobs: list[PolledJob]
    plan: Plan


def over(slots: list[tuple[PolledJob, int]], ended_ns: int) -> list[tuple[PolledJob, int]]:
    """Those that are over when polling ends: in a slot that lasts longer nothing was missed."""
    return [(job, due_ns) for job, due_ns in slots if due_ns + (job.period_ns or 0) <= ended_ns]


class PolledLine:
    """A line's bus, its schedule, and what is queued on it. `number` is what the core calls it by."""

    def __init__(
        self, declared: plant.PlantLine, number: int, bus: Bus, row_queue: RowQueue, codes: Codes
    ) -> None:
        self.name = declared.name
        self.bus = bus
        self.schedule: Schedule[PolledJob] = Schedule()
        self.started_ns = now_ns()
        self._ended_ns: int | None = None  # nothing is due any more
        self._over_ns: int | None = None  # nor under way
        self.set_aside: dict[
            PolledJob, PolledJob
        ] = {}  # instead of a single register that is refused: rarely
        self._rare: dict[PolledJob, PolledJob] = {}  # by what they have stood for
        self._number = number
        self._row_queue = row_queue
        self._codes = codes
        self._port: Port | None = None  # that was tended last
        self._done = 0  # exchanges on it, when it was tended last
        self._jobs: dict[tuple[Drive, Block, int | None], PolledJob] = {}  # all there ever were
        self._chosen: dict[PolledDrive, Chosen] = {}
        self._lock = threading.Lock()  # of all above and below: drives come and go on any thread
        self._is_started = False
        self._ahead_ns = 0  # what is queued will take
        self._learnt_ns = 0
        self.switching = declared.switching  # s; in the end as measured
        self._asked_of: list[tuple[Drive, Peer]] = []
        self._seen: list[tuple[int, int, bool]] = []  # of each: failures in a row, late until, has answered
        self._reopening: threading.Thread | None = None
        self._reopen_ns = 0
        self._cycle: list[PolledJob] = []  # what the core repeats
        self._queued: deque[Asking[PolledJob]] = deque()  # what the core has not carried out yet
        register_at_fork(self)
        try:
            for polled in declared.drives:
                self.add(polled)
        except BaseException:
            self.bus.close()
            raise

    def forked(self) -> None:
        """In the child nobody tends it."""
        self._lock = threading.Lock()

    def add(self, polled: PolledDrive) -> None:
        settings = polled.drive.settings  # a port that is being opened is waited for, but not by the polling
        self.bus.line.require((settings.baudrate, settings.format))
        with self._lock:
            drive = self.bus.attach(polled.drive)
            try:
                jobs = self._jobs_of(polled)
            except BaseException:
                self.bus.detach(drive)
                raise
            if jobs:
                self._asked_of.append((drive, self.bus.peer(drive)))
            if self._is_started:
                self._schedule(drive, jobs, now_ns())
        self._row_queue.call(self._number)

    def _schedule(self, drive: Drive, jobs: list[PolledJob], due_ns: int) -> None:
        for job in jobs:
            self.schedule.add(job, due_ns)
        if jobs and not self.bus.peer(drive).has_answered:
            self.schedule.meet(drive.address)

    def _jobs_of(self, polled: PolledDrive) -> list[PolledJob]:
        """A drive that comes back has the jobs that it had."""
        drive = polled.drive
        if polled not in self._chosen:
            for poll in polled.polls:
                check_own(drive, poll.register)
            self._chosen[polled] = self._choose(polled, drive.response_delay)
        return self._chosen[polled].jobs

    def _choose(self, polled: PolledDrive, delay: float) -> Chosen:
        plan = polled.plan(delay)
        jobs = [
            self._job(one.drive, one.block, None if one.every is None else round(one.every * 1e9))
            for one in plan.planned
        ]
        return Chosen(jobs, plan)

    def remove(self, drive: Drive) -> None:
        with self._lock:
            now = now_ns()
            jobs = [it for it in self.schedule.jobs if it.owner is drive]
            self._miss(over([(it, it.due_ns) for it in jobs if it.period_ns], now), Status.POLL_ENDED)
            for job in jobs:
                self.schedule.remove(job)
            self.schedule.forget(drive.address)
            self.set_aside = {it: whole for it, whole in self.set_aside.items() if it.owner is not drive}
            self._asked_of = [it for it in self._asked_of if it[0] is not drive]
        self.bus.detach(drive)
        self._row_queue.call(self._number)

    def _job(self, drive: Drive, block: Block, period_ns: int | None) -> PolledJob:
        key = drive, block, period_ns
        if key not in self._jobs:
            self._jobs[key] = self._made(drive, block, period_ns)
        return self._jobs[key]

    def _made(self, drive: Drive, block: Block, period_ns: int | None) -> PolledJob:
        fields = self._codes.fields(drive, block)
        peer = self.bus.peer(drive)
        own_ns = round((silence(drive) + sending(drive, block)) * 1e9)
        return PolledJob(
            drive=drive.address,
            kind=kind(drive),
            period_ns=period_ns,
            duration_ns=own_ns + round(drive.response_delay * 1e9),
            owner=drive,
            block=block,
            exchange=reading(drive, block, peer, fields, period=(period_ns or 0) / 1e9),
            fields=fields,
            own_ns=own_ns,
        )

    def start(self) -> None:
        with self._lock:
            self.started_ns = now_ns()
            self.bus.tended(True)
            self.bus.reset_statistics()
            chosen = {polled.drive: it.jobs for polled, it in self._chosen.items()}
            for drive in in_order(self.bus.drives, self.switching):
                self._schedule(drive, chosen[drive], self.started_ns)
            self._is_started = True

    def is_steady(self, now: int) -> bool:
        """Nothing is to be done for it now, unless the core calls."""
        return bool(self._cycle) and now - self._learnt_ns < RELEARN_NS

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
            port.report_to(self._row_queue, self._number)
        self._forget_done(port)
        if port.lost:
            self._lose(port, now)
            return
        self._observe(now)
        self._heed_refusals(now)
        self._keep_busy(port, now)

    def _forget_done(self, port: Port) -> None:
        if port is not self._port:  # it was opened since the line was tended: nothing is queued on it
            return
        done = port.done
        for _ in range((done - self._done) & 0xFFFF_FFFF):
            job = self._queued.popleft().job
            self._ahead_ns -= job.duration_ns
            self.schedule.conclude(job)
        self._done = done

    def _lose(self, port: Port, now: int) -> None:
        """The port failed: what was queued on it is missed."""
        port.stop()
        self._forget_done(port)
        slots = [(it.job, now if it.due_ns is None else min(it.due_ns, now)) for it in self._queued]
        self._miss(slots, Status.LINE_LOST)
        for asking in self._queued:
            self.schedule.conclude(asking.job)
        self._queued.clear()
        self._cycle = []
        self._ahead_ns = 0
        self.bus.line.drop()
        self._reopen_ns = now

    def _observe(self, now: int) -> None:
        if now - self._learnt_ns >= LEARN_NS:
            self._learn(now)
        seen = [(it.failures, it.late_until_ns, it.has_answered) for _, it in self._asked_of]
        if seen == self._seen:
            return
        self._seen = seen
        for (drive, peer), (failures, late_until_ns, has_answered) in zip(self._asked_of, seen, strict=True):
            self.schedule.observe(
                drive.address,
                failures,
                now,
                late_until_ns=late_until_ns,
                cost_ns=peer.vain_ns,
                has_answered=has_answered,
            )

    def _learn(self, now: int) -> None:
        """How long exchanges take, and which blocks are best, by the drives' own response delays."""
        self._learnt_ns = now
        delays = {drive: peer.response_delay for drive, peer in self._asked_of}
        delays_ns = {drive: round((it or drive.response_delay) * 1e9) for drive, it in delays.items()}
        for job in self.schedule.jobs:
            job.duration_ns = job.own_ns + delays_ns[job.owner]
        self._ahead_ns = sum(it.job.duration_ns for it in self._queued)
        for polled, chosen in self._chosen.items():
            delay = delays.get(polled.drive)
            if delay and not chosen.plan.suits(delay, MARGIN):
                self._choose_anew(polled, chosen, delay, now)

    def _choose_anew(self, polled: PolledDrive, chosen: Chosen, delay: float, now: int) -> None:
        """Unless some of its registers are refused, and are asked for in another way."""
        if not set(chosen.jobs) <= set(self.schedule.jobs):
            return
        anew = self._choose(polled, delay)
        jobs = anew.jobs
        for period_ns in {it.period_ns for it in jobs}:
            before = [it for it in chosen.jobs if it.period_ns == period_ns and it not in jobs]
            others = [it for it in jobs if it.period_ns == period_ns and it not in chosen.jobs]
            due_ns = min((it.due_ns for it in before if period_ns), default=now)
            self.schedule.replace(before, others, due_ns)
        self._chosen[polled] = anew

    def _heed_refusals(self, now: int) -> None:
        """Registers that are refused together are asked for singly; a single one is set aside.

        So no register is lost because of its neighbours. When it is read after all, it is polled as before.
        """
        for job in [it for it in self.set_aside if not it.fields.refusals]:
            self.schedule.replace([job], [self.set_aside.pop(job)], now)
        for job in [it for it in self.schedule.jobs if self._is_refused(it)]:
            if len(job.block.registers) > 1:
                parts = [self._job(job.owner, alone(it), job.period_ns) for it in job.block.registers]
                self.schedule.replace([job], parts, now)
            elif job not in self.set_aside:
                if job not in self._rare:
                    self._rare[job] = self._made(job.owner, job.block, SET_ASIDE_NS)
                rare = self._rare[job]
                rare.fields.refusals, job.fields.refusals = job.fields.refusals, 0
                self.set_aside[rare] = job
                self.schedule.replace([job], [rare], now)

    @staticmethod
    def _is_refused(job: PolledJob) -> bool:
        return job.fields.refusals >= REFUSALS and not job.owner.is_passing(job.fields.refusal)

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
        self._tell_unasked(now)

    def _tell_unasked(self, now: int) -> None:
        """Slots that passed unasked, which is planned ahead, have a row when they have come."""
        unasked = self.schedule.unasked
        if unasked:
            self._miss([slot for slot in unasked if slot[1] <= now], Status.NOT_ASKED)
            self.schedule.unasked = [slot for slot in unasked if slot[1] > now]

    def _top_up(self, port: Port, now: int) -> None:
        done_ns = max(now + self._ahead_ns, self._queued[-1].not_before_ns if self._queued else 0)
        queued = self.schedule.take(now, done_ns, now + AHEAD_NS, port.room - len(self._queued))
        if queued:
            port.submit([it.job.exchange for it in queued], [it.not_before_ns for it in queued])
            self._queued += queued
            self._ahead_ns += sum(it.job.duration_ns for it in queued)

    def _miss(self, slots: list[tuple[PolledJob, int]], why: Status) -> None:
        for job, due_ns in slots:
            job.exchange.peer.unasked[why] += job.fields.count
            self._row_queue.add_miss(job.fields, why, due_ns)

    def _regain(self, now: int) -> None:
        """Until the port is back every value that is due is missed because of it."""
        if now < self._reopen_ns or (self._reopening and self._reopening.is_alive()):
            return
        self._miss(self.schedule.pass_all(now), Status.LINE_LOST)
        self._reopen_ns = now + REOPEN_NS
        self._reopening = threading.Thread(target=self._reopen, daemon=True)
        self._reopening.start()

    def _reopen(self) -> None:
        with suppress(LineError):
            self.bus.line.regain()

    def end(self) -> bool:
        """Nothing more is begun, and no port opened again; whether an exchange is still under way."""
        if self._reopening:
            self._reopening.join()
        self._ended_ns = self._ended_ns or now_ns()
        port = self.bus.line.queue
        if port is None:
            return False
        self.switching = port.switching
        return port.end()

    def close(self) -> None:
        with self._lock:
            self._close()

    def _close(self) -> None:
        ended_ns = self._ended_ns or now_ns()
        self._tell_unasked(ended_ns)
        port = self.bus.line.queue
        if port:
            port.stop()
            self._forget_done(port)
            queued = [(it.job, it.due_ns) for it in self._queued if it.due_ns is not None]
            slots = [*queued, *self.schedule.pass_slots(ended_ns)]
            self._miss(over(slots, ended_ns), Status.POLL_ENDED)
        else:
            self._miss(self.schedule.pass_slots(ended_ns), Status.LINE_LOST)
        self._over_ns = now_ns()
        self.schedule = Schedule()
        self.bus.close()

    def summary(self) -> dict[str, Any]:
        with self._lock:
            return self._summary()

    def _summary(self) -> dict[str, Any]:
        seconds = max(((self._over_ns or now_ns()) - self.started_ns) / 1e9, 1e-9)
        peers = self.bus.peers
        drives = {drive.name: self._told(it, seconds) for drive, it in peers.items()}
        counters_by_drive = [it.counters() for it in peers.values()]
        misses: Counter[str] = sum((Counter(it["misses"]) for it in drives.values()), Counter())
        return {
            "seconds": round(seconds, 3),
            "exchanges": sum(counters.exchanges for counters in counters_by_drive),
            "samples": sum(counters.values for counters in counters_by_drive),
            "misses": dict(misses),
            "late_replies": sum(counters.late for counters in counters_by_drive),
            "stray_bytes": sum(counters.stray_bytes for counters in counters_by_drive),
            "utilisation": round(sum(counters.ideal_ns for counters in counters_by_drive) / 1e9 / seconds, 4),
            "overrun_slots": sum(job.skipped for job in self._jobs.values()),
            "switching_ms": round(self.switching * 1e3, 3),
            "set_aside": [f"{job.owner.name}.{job.block.registers[0].name}" for job in self.set_aside],
            "drives": drives,
        }

    def _told(self, peer: Peer, seconds: float) -> dict[str, Any]:
        counters = peer.counters()
        misses = Counter({str(why): count for why, count in counters.missed.items()})
        misses.update({STATUSES[EXCEPTION_STATUS + code]: n for code, n in counters.refused.items()})
        return {
            "exchanges": counters.exchanges,
            "samples": counters.values,
            "exchanges_per_second": round(counters.answered / seconds, 2),
            "samples_per_second": round(counters.values / seconds, 2),
            "response_delay_ms": round(peer.response_delay * 1e3, 3),
            "timeout_ms": round(peer.timeout * 1e3, 3),
            "p99_delay_ms": round(Statistics(seconds, counters).delays.p99 * 1e3, 3),
            "misses": dict(misses),
        }
