"""PolledLine: polls the drives of one line by a schedule, and reopens the line's port if it is lost.

If a drive's measured response delay makes another plan faster, its blocks are planned again.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from typing import Any

from multidrop.bus import Bus
from multidrop.core import Peer, Port, RowQueue, Status
from multidrop.core.process import register_at_fork
from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.errors import LineError
from multidrop.planning.bus_time import in_order
from multidrop.planning.schedule import Schedule
from multidrop.plant.model import PlantLine, PolledDrive
from multidrop.polling.jobs import JobMaker, PlannedJobs, PolledJob, PortQueue, RowNames, Slot
from multidrop.polling.refusals import Refusals
from multidrop.transport import clock
from multidrop.transport.aside_log import log_aside, traceback_of, words_of
from multidrop.transport.drive_records import GONE_S
from multidrop.transport.statistics import Statistics, line_statistics

_log = logging.getLogger("multidrop.polling")


class Reopening:
    """Attempts to reopen a lost port, one at a time, in a thread: a slow port must not delay other lines.

    After a successful attempt, `reopened` is called in that thread. `failure` is the last attempt's error.
    """

    def __init__(self, bus: Bus, reopened: Callable[[], object]) -> None:
        self._bus = bus
        self._reopened = reopened
        self._thread: threading.Thread | None = None
        self.failure: LineError | None = None

    @property
    def is_under_way(self) -> bool:
        return self._thread is not None and self._thread.is_alive()

    def begin(self) -> None:
        """Reopen the port on another thread. If none can be started, each stop reopens the port itself."""
        thread = threading.Thread(target=self._attempt, name="multidrop reopening", daemon=True)
        self._thread = None
        self._bus.note_reopening(True)
        try:
            thread.start()
            self._thread = thread
        except (RuntimeError, MemoryError):
            self._bus.note_reopening(False)

    def join(self) -> None:
        """Wait until the current attempt, if any, has ended."""
        if self._thread is not None:
            self._thread.join()

    def _attempt(self) -> None:
        self.failure = None
        try:
            self._bus.line.regain()
            self._reopened()
        except LineError as failure:
            self.failure = failure  # the line has logged it
        except BaseException as failure:
            log_aside(
                _log, logging.ERROR, "%s: not opened again\n%s", self._bus.line.port, traceback_of(failure)
            )
        finally:
            self._bus.note_reopening(False)


def line_summary(seconds: float, peers: Mapping[str, Peer]) -> dict[str, Any]:
    """Return the summary of a line's exchanges, in total and by drive, over `seconds` s."""
    line = line_statistics(seconds, {name: peer.counters() for name, peer in peers.items()}, None)
    return {
        "seconds": round(seconds, 3),
        "exchanges": line.counters.exchanges,
        "samples": line.samples,
        "misses": dict(line.misses),
        "late_replies": line.late_replies,
        "stray_bytes": line.skipped_bytes,
        "utilisation": round(line.utilisation, 4),
        "drives": {
            name: _drive_summary(line.drives[name], peer.response_delay) for name, peer in peers.items()
        },
    }


def _drive_summary(drive: Statistics, response_delay: float) -> dict[str, Any]:
    return {
        "exchanges": drive.counters.exchanges,
        "samples": drive.samples,
        "exchanges_per_second": round(drive.counters.answered / drive.seconds, 2),
        "samples_per_second": round(drive.samples / drive.seconds, 2),
        "response_delay_ms": round(response_delay * 1e3, 3),
        "timeout_ms": round(drive.timeout * 1e3, 3),
        "p99_delay_ms": round(drive.delays.p99 * 1e3, 3),
        "misses": dict(drive.misses),
    }


LEARN_NS = 1_000_000_000  # interval at which durations and plans are adapted to measured response delays
RELEARN_NS = 2_000_000_000  # the same interval while the C core repeats a bus cycle
REOPEN_NS = 500_000_000  # interval between attempts to reopen a lost port
# After this many losses of a port without a reply in between, the next loss is followed by a pause. The
# number is above 1, because some devices close each connection at one particular request.
MOST_AT_ONCE = 2
# time after the reopening of a lost port during which the requests of stops go before polls
STOPS_FIRST_NS = 500_000_000
# interval at which rows without a value are added while this process may not poll the line
STANDBY_NS = 500_000_000
RETRY_NS = 500_000_000  # pause before polling is retried after a failure; each further failure doubles it
LONGEST_RETRY_NS = 30_000_000_000
SOUND_NS = 10_000_000_000  # time without failures of polling after which earlier failures are forgotten
# A plan of requests is the quickest one only for a range of response delays. A drive's requests are planned
# again if its delay leaves this range by more than this fraction.
MARGIN = 0.05


class PolledLine:
    """Polls one line: its bus, drives and schedule. Any thread may add and remove drives.

    If the line needs attention, the core reports its `number` to the poller's thread, which calls `tend`.
    """

    def __init__(
        self,
        declared: PlantLine,
        number: int,
        bus: Bus,
        row_queue: RowQueue,
        names: RowNames,
        started_ns: int = 0,
    ) -> None:
        self.declared = declared  # the line as declared; `polled` has the drives that are on it now
        self.bus = bus
        bus.baudrate, bus.format = declared.baudrate, declared.format
        # s; duration of a change of the line's settings: declared, or measured at `end`
        self.switching = declared.switching
        self.started_ns = started_ns  # when polling started, also before a change of the line; 0: not yet
        self.number = number
        self._is_left = False  # whether `leave` was called
        self._ended_ns: int | None = None  # monotonic time at which polling ended
        self._over_ns: int | None = None  # monotonic time at which the last exchange ended
        self._row_queue = row_queue
        self._schedule: Schedule[PolledJob] = Schedule()
        self._maker = JobMaker(bus, names)
        self._queue = PortQueue(self._schedule)
        self._refusals = Refusals(self._schedule, self._maker)
        # plans of the drives; those of removed drives stay, in case the drives are added again
        self._planned: dict[PolledDrive, PlannedJobs] = {}
        self._present: dict[Drive, PolledDrive] = {}  # the drives on the line
        self._since_ns: dict[Drive, int] = {}  # when each drive's polls were last changed
        # the core's records of removed drives, by address: an exchange may still be in flight
        self._gone: dict[int, Peer] = {}
        self._polled: list[tuple[Drive, Peer]] = []  # the present drives that have jobs
        # for each drive in `_polled`: its failures, the end of its late replies, whether it has answered
        self._observed: list[tuple[int, int, bool]] = []
        self._is_started = False
        self._learnt_ns = 0
        # Once the port is reopened, the poller's thread is called to send a request immediately, because some
        # servers close an idle connection.
        self._reopening = Reopening(bus, lambda: row_queue.call(number))
        self._lost_ns = 0  # when the port was lost; 0 if a drive has answered since
        self._losses = 0  # number of losses since a drive answered
        self._tried_ns = 0  # when the last attempt to reopen the port was made
        self._reopen_ns = 0  # when the next attempt is due
        self._opened_ns = 0  # when the present port was first seen open
        self._standby_ns = 0
        self.failure = ""  # the last failure of polling; "" after SOUND_NS without another failure
        self._failures = 0  # number of failures of polling in a row
        self._retry_ns = 0  # when to poll again after the last failure of polling
        self._is_broken = False  # whether a failure of polling may have left the schedule incomplete
        # protects all attributes above, because any thread may add and remove drives
        self._lock = threading.Lock()
        register_at_fork(self)
        for polled in declared.drives:
            self.add(polled)

    def forked(self) -> None:
        self._lock = threading.Lock()

    @property
    def name(self) -> str:
        return self.declared.name

    # ---- the line's drives ----

    @property
    def polled(self) -> tuple[PolledDrive, ...]:
        """The drives that are on the line now, with their polled registers."""
        return tuple(self._present.values())

    @property
    def since_ns(self) -> dict[str, int]:
        """The time at which each drive's polls last changed (ns, CLOCK_MONOTONIC), by drive name."""
        return {drive.name: since_ns for drive, since_ns in self._since_ns.copy().items()}

    def add(self, polled: PolledDrive) -> None:
        """Start polling a drive. A drive that was polled before gets the same jobs again.

        A drive that is on the bus stays attached. If another drive was removed from this address, first wait
        for the end of its last exchange. Only then is it known whether a late reply of that drive may still
        come.
        """
        polled.drive.take_settings(self.declared.baudrate, self.declared.format, None, bus=self.bus)
        self.await_gone(polled.drive.address)
        # not under the lock, which polling needs: `require` may wait until a port is open
        settings = polled.drive.settings
        self.bus.line.require((settings.baudrate, settings.format))
        with self._lock:
            drive = polled.drive
            if drive.bus is not self.bus:
                self.bus.attach(drive)
            try:
                if polled not in self._planned:
                    self._planned[polled] = self._maker.plan(polled, drive.response_delay)
            except BaseException:
                self.bus.detach(drive)
                raise
            now = clock.now_ns()
            self._present[drive] = polled
            self._since_ns[drive] = now
            if self._planned[polled].jobs:
                self._polled.append((drive, self.bus.peer(drive)))
            if self._is_started:
                self._schedule_jobs(drive, now)
        self._row_queue.call(self.number)

    def _schedule_jobs(self, drive: Drive, due_ns: int) -> None:
        jobs = self._planned[self._present[drive]].jobs
        for job in jobs:
            self._schedule.add(job, due_ns)
        if jobs and not self.bus.peer(drive).has_answered:
            self._schedule.back_off.meet(drive.address)

    def _jobs(self, drive: Drive) -> list[PolledJob]:
        return [job for job in self._schedule.jobs if job.owner is drive]

    def await_gone(self, address: int) -> None:
        """Wait for the last exchange of a drive that was removed from this address."""
        peer = self._gone.pop(address, None)
        while peer and not self._is_left and self.bus.is_asking(peer):
            clock.sleep(GONE_S)

    def remove(self, drive: Drive) -> None:
        """Stop polling a drive; its queued exchanges are still carried out."""
        with self._lock:
            jobs = self._jobs(drive)
            slots = [(job, job.due_ns) for job in jobs if job.period_ns]
            self._miss(_over(slots, clock.now_ns()), Status.POLL_ENDED)
            for job in jobs:
                self._schedule.remove(job)
            self._schedule.back_off.forget(drive.address)
            self._refusals.forget(drive)
            self._present.pop(drive, None)
            self._since_ns.pop(drive, None)
            self._polled = [(other, peer) for other, peer in self._polled if other is not drive]
            self._gone[drive.address] = self.bus.peer(drive)
        self.bus.detach(drive)
        self._row_queue.call(self.number)

    def set_rate(self, drive: Drive, register: Register[Any] | None, every: float | None) -> None:
        """Set the period `every` in s of a polled register, or of all polled registers if `register` is None.

        `every` None means as fast as possible. Registers whose rate is unchanged are polled at the planned
        times. Registers with a new rate are polled now. Raises ValueError for a register that is not polled.
        """
        with self._lock:
            before = self._present[drive]
            after = before.at_rate(register, every)
            if after == before:
                return
            peer, now = self.bus.peer(drive), clock.now_ns()
            planned = self._maker.plan(after, peer.response_delay or drive.response_delay)
            self._since_ns[drive] = now
            if self._is_started:
                self._change_jobs(drive, planned.jobs, now)
            others = [(other, known) for other, known in self._polled if other is not drive]
            self._polled = [*others, (drive, peer)] if planned.jobs else others
            self._planned.pop(before)
            self._planned[after] = planned
            self._present[drive] = after
        self._row_queue.call(self.number)

    def _change_jobs(self, drive: Drive, wanted: list[PolledJob], now_ns: int) -> None:
        """Replace a drive's jobs with `wanted`; its queued exchanges are still carried out.

        Refused registers are polled normally again.
        """
        present = self._jobs(drive)
        old = [job for job in present if job not in wanted]
        # New jobs are first due when the earliest replaced job with the same period would have been due. If
        # no job with this period is replaced, they are due with the earliest other job with this period.
        latest_first = [*sorted(present, key=_due, reverse=True), *sorted(old, key=_due, reverse=True)]
        dues = {job.period_ns: job.due_ns for job in latest_first}
        self._refusals.forget(drive)
        for period_ns in dict.fromkeys(job.period_ns for job in [*wanted, *old]):
            self._schedule.replace(
                [job for job in old if job.period_ns == period_ns],
                [job for job in wanted if job.period_ns == period_ns and job not in present],
                dues.get(period_ns, now_ns) if period_ns else now_ns,
            )
        self._maker.forget(old)
        back_off = self._schedule.back_off
        if not wanted:
            back_off.forget(drive.address)
        elif not present and not self.bus.peer(drive).has_answered:
            back_off.meet(drive.address)

    # ---- polling ----

    def start(self) -> None:
        with self._lock:
            now = clock.now_ns()
            if not self.started_ns:
                self.started_ns = now
                self.bus.reset_statistics()
            polled = [polled.drive for polled in self.polled]
            for drive in in_order(polled, self.switching):
                self._schedule_jobs(drive, now)
            self._is_started = True
        self._row_queue.call(self.number)

    def is_steady(self, now_ns: int) -> bool:
        """Return True while the C core repeats the bus cycle, so that `tend` need not be called."""
        return self._queue.is_repeating and now_ns - self._learnt_ns < RELEARN_NS

    def is_well(self, now_ns: int) -> bool:
        """Return True while the port is open, this process is the master, and all drives answer."""
        if self._queue.port is None or self._queue.port is not self.bus.line.queue:
            return False
        is_asked = not self._schedule.unasked and not self._schedule.back_off.has_pauses(now_ns)
        return is_asked and self.bus.line.may_send

    def tend(self, now_ns: int) -> None:
        """Process the results of queued exchanges, and queue the next ones.

        Never raises. A failure, such as one in a user's own class, is logged, and polling is retried later.
        Until then the line's rows have no values, and the status POLLING_FAILED.
        """
        # no lock is taken for a line that is being closed, because `close` may hold the lock for long
        if self._is_left:
            return
        try:
            self._tend(now_ns)
        # any exception, even SystemExit from a user's class: other lines continue
        except BaseException as failure:
            self._fail(failure, now_ns)

    def _fail(self, failure: BaseException, now_ns: int) -> None:
        self._is_broken = True
        delay_ns = min(RETRY_NS << min(self._failures, 10), LONGEST_RETRY_NS)
        self._failures += 1
        self._retry_ns = now_ns + delay_ns
        self.failure = words_of(failure)
        said = "line %s: polling failed, and is retried in %g s: %s\n%s"
        log_aside(_log, logging.ERROR, said, self.name, delay_ns / 1e9, self.failure, traceback_of(failure))

    def _is_sound(self, now_ns: int) -> bool:
        """Return True if polling may continue after a failure.

        While the next attempt is not due, return False and record each due value as missing.
        """
        if self._is_broken:
            self._queue.abandon()
            self._schedule.clear()
            self._observed = []
            for drive in self._present:
                self._refusals.forget(drive)
                self._schedule_jobs(drive, now_ns)
            self._is_broken = False
        port = self.bus.line.queue
        if now_ns < self._retry_ns or (self._queue.port is None and port is not None and port.pending):
            self._stand_by(now_ns, Status.POLLING_FAILED)
            return False
        if now_ns >= self._retry_ns + SOUND_NS:
            self.failure, self._failures = "", 0
        return True

    def _tend(self, now_ns: int) -> None:
        with self._lock:
            port = self.bus.line.queue
            if self._is_left or not self._is_started:
                return
            if (self.failure or self._is_broken) and not self._is_sound(now_ns):
                return
            if port is None:
                if self.bus.line.may_send:
                    self._regain(now_ns)
                else:
                    self._stand_by(now_ns, Status.NOT_MASTER)
                return
            if port is not self._queue.port:  # the poller opened this port, or a stop reopened it
                self._queue.give_back()
                self._queue.move_to(port)
                port.report_to(self._row_queue, self.number)
                self._opened_ns = now_ns
            self._queue.conclude(port)
            since_ns = max(self._lost_ns, self._tried_ns)
            if self._lost_ns and any(peer.answered_ns > since_ns for _, peer in self._polled):
                self._lost_ns = self._losses = 0
            if port.lost:
                self._lose(port, now_ns)
                return
            self.bus.line.note_news()
            if not self.bus.line.may_send:
                self._queue.pause(port)
                self._stand_by(now_ns, Status.NOT_MASTER)
                return
            if self._leaves_port_to_stops(now_ns):
                return
            if now_ns - self._learnt_ns >= LEARN_NS:
                self._learn(now_ns)
            self._observe(now_ns)
            self._refusals.update(now_ns)
            self._queue.keep_busy(port, now_ns)
            self._miss_unasked(now_ns)

    def _leaves_port_to_stops(self, now_ns: int) -> bool:
        """Return True shortly after a lost port was reopened, if stops are in progress.

        Some servers close the connection after each reply. If a poll were the first request on each
        connection, the stop would never be sent.
        """
        is_new = self._lost_ns > 0 and now_ns < self._opened_ns + STOPS_FIRST_NS
        return is_new and bool(self.bus.stops_under_way())

    def _observe(self, now_ns: int) -> None:
        """Report failures and late replies to the schedule, which polls silent drives less often."""
        seen = [(peer.failures, peer.late_until_ns, peer.has_answered) for _, peer in self._polled]
        if seen == self._observed:
            return
        self._observed = seen
        self.bus.line.note_stall()
        for (drive, peer), (failures, late_until_ns, has_answered) in zip(self._polled, seen, strict=True):
            self._schedule.back_off.observe(
                drive.address,
                failures,
                now_ns,
                late_until_ns=late_until_ns,
                cost_ns=peer.next_timeout_ns,
                has_answered=has_answered,
            )

    def _learn(self, now_ns: int) -> None:
        """Update exchange durations and plans with the drives' measured response delays.

        A plan is not changed while some of its blocks are split because the drive refused them.
        """
        self._learnt_ns = now_ns
        delays = {drive: peer.response_delay for drive, peer in self._polled}
        for job in self._schedule.jobs:
            job.duration_ns = job.own_ns + round((delays[job.owner] or job.owner.response_delay) * 1e9)
        self._queue.measure()
        for polled in self._present.values():
            planned, delay = self._planned[polled], delays.get(polled.drive)
            if delay and not planned.plan.suits(delay, MARGIN) and {*planned.jobs} <= {*self._schedule.jobs}:
                self._planned[polled] = better = self._maker.plan(polled, delay)
                self._change_jobs(polled.drive, better.jobs, now_ns)

    # ---- rows without a value ----

    def _miss(self, slots: list[Slot], why: Status) -> None:
        for job, due_ns in slots:
            if job.rows.count:
                job.exchange.peer.unasked[why] += job.rows.count
                self._row_queue.add_miss(job.rows, why, due_ns)

    def _miss_unasked(self, now_ns: int) -> None:
        """Add a row without a value for each poll of a silent drive that was skipped and is due by now."""
        unasked = self._schedule.unasked
        if unasked:
            self._miss([slot for slot in unasked if slot[1] <= now_ns], Status.NOT_ASKED)
            self._schedule.unasked = [slot for slot in unasked if slot[1] > now_ns]

    # ---- lack of mastership, lost ports, and the end of polling ----

    def _stand_by(self, now_ns: int, why: Status) -> None:
        """Instead of polling, every STANDBY_NS add a row without a value for each poll that was due."""
        if now_ns >= self._standby_ns:
            self._standby_ns = now_ns + STANDBY_NS
            self._miss(self._schedule.pass_all(now_ns), why)

    def _lose(self, port: Port, now_ns: int) -> None:
        port.stop()
        self._queue.give_back()
        self.bus.line.drop_lost()
        self._lost_ns = self._lost_ns or now_ns
        self._losses += 1
        if self._losses <= MOST_AT_ONCE:
            self._reopen_ns = now_ns

    def _regain(self, now_ns: int) -> None:
        """Reopen the port in a thread; until that succeeds, add a row without a value for each due poll.

        The first attempt adds no such rows: if it succeeds, polling continues without a gap.
        """
        if now_ns < self._reopen_ns or self._reopening.is_under_way:
            return
        if now_ns - self._lost_ns >= REOPEN_NS:
            self._miss(self._schedule.pass_all(now_ns), Status.LINE_LOST)
        self._tried_ns, self._reopen_ns = now_ns, now_ns + REOPEN_NS
        self._reopening.begin()

    def reopen(self) -> None:
        """Start to open the port again, unless this process may not send on the line."""
        if self.bus.line.may_send:
            self._reopening.begin()

    def await_reopening(self) -> LineError | None:
        """Wait until the port is open, or the attempt to open it has failed; return the failure or None."""
        self._reopening.join()
        return self._reopening.failure

    def leave(self) -> None:
        """Make `tend` do nothing from now on. A lost port is then only reopened to send a stop."""
        with self._lock:
            self._is_left = True

    def end(self) -> bool:
        """Start no more polls; return True while one is in flight. Stops and other calls are still sent."""
        self._ended_ns = self._ended_ns or clock.now_ns()
        if port := self.bus.line.queue:
            self.switching = port.switching
        return self.bus.line.end()

    def close(self, why: str) -> None:
        """Add rows without a value for polls that were not sent in time, then close the bus.

        Later calls on the bus fail; `why` is part of their error sentence.
        """
        self._reopening.join()
        self.bus.line.why_closing = why
        self.bus.line.ended_ns = self._ended_ns
        with self._lock:
            try:
                self._conclude(self.bus.line.queue)
            finally:
                self.bus.close()

    def drop(self) -> None:
        """Conclude polling, and end all exchanges on the port. The next stop or `regain` opens it again."""
        with self._lock:
            port = self.bus.line.queue
            self.bus.line.drop("it is being opened again, because its line was changed")
            self._conclude(port)

    def _conclude(self, port: Port | None) -> None:
        self._miss_unsent(port, self._ended_ns or clock.now_ns())
        self._over_ns = self._over_ns or clock.now_ns()
        self._schedule.clear()

    def _miss_unsent(self, port: Port | None, ended_ns: int) -> None:
        if self._is_broken:
            self._queue.abandon()
        self._miss_unasked(ended_ns)
        if port:
            port.stop()
            self._queue.conclude(port)
            slots = [*self._queue.slots(), *self._schedule.pass_slots(ended_ns)]
            self._miss(_over(slots, ended_ns), Status.POLL_ENDED)
        else:
            self._miss(self._schedule.pass_slots(ended_ns), Status.LINE_LOST)

    # ---- summary ----

    def summary(self) -> dict[str, Any]:
        with self._lock:
            now_ns = self._over_ns or clock.now_ns()
            seconds = max((now_ns - (self.started_ns or now_ns)) / 1e9, 1e-9)
            line, peers = self.bus.line, {drive.name: peer for drive, peer in self.bus.peers.items()}
            return {
                **line_summary(seconds, peers),
                "overrun_slots": self._maker.skipped,
                "switching_ms": round(self.switching * 1e3, 3),
                "set_aside": self._refusals.names,
                **({"foreign_bytes": line.foreign} if line.mastership else {}),
            }


def _over(slots: list[Slot], ended_ns: int) -> list[Slot]:
    """Return the polls whose period ends by `ended_ns`. Later polls do not count as missed."""
    return [(job, due_ns) for job, due_ns in slots if due_ns + (job.period_ns or 0) <= ended_ns]


def _due(job: PolledJob) -> int:
    return job.due_ns
