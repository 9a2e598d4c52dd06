"""Decide which exchange of a line is carried out next. Callers pass the time, in ns.

The exchanges are planned in advance, up to a horizon, so that the line never waits for Python. A job with a
period is due at each multiple of the period and never drifts. Among the jobs that are due, the job whose
period ends first goes first. If there is time for all, jobs with equal line settings and silence are
sent one after another. If a job's period ends before its turn, this poll is counted and skipped for good.
Then, until the line has caught up, the job that has waited longest goes first, so that each job is carried
out. Jobs without a period take turns, one round after another, in the remaining time. They have a minimum
share of the line's time. Silent drives get few requests: see `BackOff`.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from typing import Generic, NamedTuple, TypeVar

TURN_SHARE = 0.05  # least fraction of the line's time for jobs without a period
# limit of the bus time that jobs without a period may use before they are entitled to it
CREDIT_NS = 50_000_000
NEVER_NS = 1 << 63
SILENT_AFTER = 2  # number of successive failures after which a drive gets no requests for a while
FIRST_PAUSE_NS = 500_000_000
LONGEST_PAUSE_NS = 2_000_000_000
SILENT_SHARE = 0.015  # fraction of the line's time for requests to silent drives
# limit of the bus time for retries of all new drives that left their first request unanswered
SECOND_COST_NS = 400_000_000


@dataclass(eq=False, kw_only=True)
class Job:
    """A repeated exchange with a drive.

    Jobs of one `kind` have the same line settings and silence. They take the least time if they follow each
    other.
    """

    drive: int  # the drive's address
    period_ns: int | None
    duration_ns: int
    # silence before the request; part of `duration_ns`, but may pass while the line is idle
    silence_ns: int = 0
    interval_ns: int = 0  # least time from the end of an exchange to the next request to the drive
    kind: Hashable = None
    due_ns: int = 0
    taken_ns: int = 0
    skipped: int = 0  # number of polls that were skipped because the line was busy
    number: int = 0  # position in the bus cycle

    @property
    def end_ns(self) -> int:
        return self.due_ns + (self.period_ns or 0)


J = TypeVar("J", bound=Job)


class Turn(NamedTuple, Generic[J]):
    """One exchange of a job, as planned."""

    job: J
    not_before_ns: int
    due_ns: int | None  # time at which the job was due; None for a job without a period


# ---- silent drives ----


@dataclass
class Health:
    """A drive's failures, and the time in which it gets no request."""

    is_new: bool = False  # True if the drive has never answered
    is_pending: bool = False  # True if the drive is new and its first request has no result yet
    failures: int = 0
    late_until_ns: int = 0
    pause_ns: int = 0
    paused_until_ns: int = 0
    cost_ns: int = 0  # bus time of a request that gets no reply


@dataclass
class BackOff:
    """Back off from a line's silent drives, so that other drives lose little time.

    A silent drive gets no requests during a pause. Then it gets its shortest request, in spare time or in the
    bus time of jobs without a period. Without a reply, a longer pause follows. All silent drives together
    take only a small share of the bus time. But the first pause of a drive that has answered before is always
    short, because the drive may have missed two requests by chance. When a silent drive replies, its pauses
    end. Another silent drive is then tried immediately, because both may have been without power.

    A new drive, which has never answered, gets one request and no other until the outcome is known. If no
    reply comes, its pause starts immediately. Once all new drives have had their first request, the silent
    ones get a second request if they are few. Drives are given by address.
    """

    begin_pause: Callable[[int, int], None]  # called with the drive's address and the time
    health: dict[int, Health] = field(default_factory=dict)
    has_silent: bool = False  # True if any drive is new or did not answer its last request
    _late_until_ns: int = 0  # latest `late_until_ns` of all drives

    def meet(self, drive: int) -> None:
        """Treat a drive as new. It may be absent, so it gets only one request until the result is known."""
        self.health[drive].is_new = self.has_silent = True

    def forget(self, drive: int) -> None:
        self.health.pop(drive, None)

    def conclude(self, drive: int) -> None:
        """Record that a request to this drive has ended, with any outcome."""
        if drive in self.health:
            self.health[drive].is_pending = False

    def has_pauses(self, at_ns: int) -> bool:
        """Return False if no drive is paused now. If True, call `is_paused` for each drive."""
        return self.has_silent or at_ns < self._late_until_ns

    def is_paused(self, drive: int, at_ns: int) -> bool:
        health = self.health[drive]
        return health.pause_ns > 0 or at_ns < max(health.paused_until_ns, health.late_until_ns)

    def next_retry(self, at_ns: int) -> int | None:
        """Return a drive whose pause has ended, and start its next pause; None if there is no such drive."""
        for drive, health in self.health.items():
            if health.pause_ns and at_ns >= health.paused_until_ns and not health.is_pending:
                health.paused_until_ns = at_ns + health.pause_ns
                return drive
        return None

    def observe(
        self,
        drive: int,
        failures: int,
        now_ns: int,
        *,
        late_until_ns: int,
        cost_ns: int,
        has_answered: bool = True,
    ) -> None:
        """Record how many requests to a drive have failed in a row.

        `cost_ns` is the bus time of its next request if no reply comes. Until `late_until_ns` a reply to an
        earlier request may come. Until then the drive gets no request, even if it has answered another one.
        Once the late reply has come, the drive can be tried immediately.
        """
        health = self.health[drive]
        has_answered_late = late_until_ns < health.late_until_ns
        has_changed = failures != health.failures
        health.failures, health.late_until_ns, health.cost_ns = failures, late_until_ns, cost_ns
        health.is_new &= not has_answered
        if has_changed and failures:
            self._pause(drive, now_ns)
        elif has_changed:
            if health.pause_ns:
                self._end_next_pause(drive, now_ns)
            health.pause_ns = health.paused_until_ns = 0
        elif has_answered_late:
            health.paused_until_ns = now_ns
        if self.has_silent:
            self._try_new_again(now_ns)
        self.has_silent = any(health.failures or health.is_new for health in self.health.values())
        self._late_until_ns = max(health.late_until_ns for health in self.health.values())

    def _pause(self, drive: int, now_ns: int) -> None:
        health = self.health[drive]
        pause_ns = 0
        if health.failures >= (1 if health.is_new else SILENT_AFTER):
            is_first = not health.pause_ns and not health.is_new
            health.pause_ns = min(max(2 * health.pause_ns, FIRST_PAUSE_NS), LONGEST_PAUSE_NS)
            pause_ns = health.pause_ns if is_first else max(health.pause_ns, self._fair_pause_ns())
            self.begin_pause(drive, now_ns)
        health.paused_until_ns = max(health.late_until_ns, now_ns + pause_ns)

    def _fair_pause_ns(self) -> int:
        """Return the pause in ns that limits requests to silent drives to SILENT_SHARE of the time."""
        return round(sum(health.cost_ns for health in self.health.values() if health.pause_ns) / SILENT_SHARE)

    def _end_next_pause(self, drive: int, now_ns: int) -> None:
        """End the shortest remaining pause of a silent drive, except that of `drive`."""
        paused = [health for number, health in self.health.items() if health.pause_ns and number != drive]
        if paused:
            first = min(paused, key=lambda health: health.paused_until_ns)
            first.paused_until_ns = min(first.paused_until_ns, max(now_ns, first.late_until_ns))

    def _try_new_again(self, now_ns: int) -> None:
        """Retry silent new drives now, if all new drives were asked and the retries take little time."""
        new = [health for health in self.health.values() if health.is_new]
        silent = [health for health in new if health.failures == 1]
        if all(health.failures for health in new) and sum(each.cost_ns for each in silent) <= SECOND_COST_NS:
            for health in silent:
                health.paused_until_ns = max(now_ns, health.late_until_ns)


# ---- the schedule ----


class Schedule(Generic[J]):
    """The jobs of one line, and the order in which they are carried out."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget all jobs and the health of their drives."""
        self.jobs: list[J] = []
        # polls that were skipped because the drive is silent: the job, and the time at which it was due
        self.unasked: list[tuple[J, int]] = []
        self.back_off = BackOff(self._begin_pause)
        self._health: dict[int, Health] = self.back_off.health
        self._waiting: list[tuple[int, int, J]] = []  # heap of (due time, number, job)
        self._begun: list[J] = []  # jobs that are due but not carried out yet
        # earliest time of the next request, by drive; only for drives with a least interval between requests
        self._ready: dict[int, int] = {}
        # jobs without a period that wait for the end of their drive's least interval
        self._held: list[J] = []
        self._round: list[J] = []  # jobs without a period, in the order of polling
        self._next = 0  # index in `_round` of the next job
        # bus time that jobs without a period are entitled to; negative if they have used more than that
        self._owed_ns = -CREDIT_NS
        self._is_late = False  # True from a skipped poll until no job is due
        self._kind: Hashable = None  # line settings and silence of the job that was taken last
        self._number = 0

    def add(self, job: J, now_ns: int) -> None:
        self.jobs.append(job)
        self._health.setdefault(job.drive, Health())
        if job.interval_ns:
            self._ready.setdefault(job.drive, 0)
        self._number += 1
        job.number, job.due_ns = self._number, now_ns
        if job.period_ns is None:
            self._round.append(job)
        else:
            self._await(job)

    def remove(self, job: J) -> None:
        """Remove a job. Exchanges of the job that are already queued are still carried out."""
        self.jobs.remove(job)
        self._held = [held for held in self._held if held is not job]
        if job.interval_ns and all(other.drive != job.drive for other in self.jobs):
            self._ready.pop(job.drive, None)
        self._forget_due(job)
        if job in self._round:
            at = self._round.index(job)
            self._next -= at < self._next
            self._round.pop(at)

    def _forget_due(self, job: J) -> None:
        """Forget when this job is due."""
        self._begun = [begun for begun in self._begun if begun is not job]
        self._waiting = [waiting for waiting in self._waiting if waiting[2] is not job]
        heapq.heapify(self._waiting)

    def replace(self, jobs: Sequence[J], others: Sequence[J], due_ns: int) -> None:
        """Replace `jobs` by `others` at the same place in the order; `others` are first due at `due_ns`."""
        rest = self._round[self._next :] + self._round[: self._next]
        at = next((at for at, job in enumerate(rest) if job in jobs), len(rest))
        for job in others:
            self.add(job, due_ns)
        rest[at:at] = [job for job in others if job.period_ns is None]
        self._round, self._next = rest, 0
        for job in jobs:
            self.remove(job)

    def _await(self, job: J) -> None:
        heapq.heappush(self._waiting, (job.due_ns, job.number, job))

    # ---- the next jobs ----

    def cycle(self, now_ns: int) -> list[J]:
        """Return the jobs of the bus cycle, starting with the next one, if the core can repeat the cycle.

        Return [] if it cannot, because a job has a period or a least interval, or because a drive is silent.
        """
        if self.back_off.has_pauses(now_ns) or self._waiting or self._begun or self._ready:
            return []
        return self._round[self._next :] + self._round[: self._next]

    def go_on(self, job: J) -> None:
        """Make this job the next one among the jobs without a period."""
        if job in self._round:
            self._next = self._round.index(job)

    def take(self, now_ns: int, start_ns: int, horizon_ns: int, most: int) -> list[Turn[J]]:
        """Return the next turns (exchanges), at most `most`, to keep the line busy until `horizon_ns`.

        `start_ns` is the time at which the line will have carried out all earlier exchanges.
        """
        at = idle_since = max(now_ns, start_ns)
        taken: list[Turn[J]] = []
        while len(taken) < most and at < horizon_ns:
            self._begin_slots(at)
            job = (self._in_turn(at) if self._owed_ns > 0 else None) or self._due(at) or self._in_turn(at)
            if job is None:
                at = self._next_ns(at)
                continue
            taken.append(self._take(job, at))
            at = idle_since = at + self._duration_ns(job) - min(job.silence_ns, at - idle_since)
            if job.interval_ns:
                self._ready[job.drive] = at + job.interval_ns
            self._kind = job.kind
        self._put_off()
        return taken

    def _is_ready(self, job: J, at_ns: int) -> bool:
        return not self._ready or at_ns >= self._ready.get(job.drive, 0)

    def _next_ns(self, at_ns: int) -> int:
        """Return the earliest future time at which a job is due or a drive may get its next request."""
        times = [max(at_ns, self._waiting[0][0])] if self._waiting else []
        times += [ready_ns for ready_ns in self._ready.values() if ready_ns > at_ns]
        return min(times, default=NEVER_NS)

    def _begin_slots(self, by_ns: int) -> None:
        """Add the jobs that are due to `_begun`. Skip those of drives that get no request now."""
        while self._waiting and self._waiting[0][0] <= by_ns:
            job = heapq.heappop(self._waiting)[2]
            if self.back_off.is_paused(job.drive, by_ns):
                self._pass(job)
            else:
                self._begun.append(job)

    def _pass(self, job: J) -> None:
        self.unasked.append((job, job.due_ns))
        job.due_ns = job.end_ns
        self._await(job)

    def _due(self, at_ns: int) -> J | None:
        """Choose the next of the jobs that are due; return None if no job can be sent now.

        If polls were skipped, choose the job that was sent longest ago. Otherwise choose the job whose
        period ends first. If there is time for all due jobs before that, prefer a job of the same kind as the
        job that was chosen before.
        """
        if self.back_off.has_pauses(at_ns):
            for job in [job for job in self._begun if self.back_off.is_paused(job.drive, at_ns)]:
                self._begun.remove(job)
                self._pass(job)
        if not self._begun:
            self._is_late = False
            return None
        begun = [
            job
            for job in self._begun
            if not self._health[job.drive].is_pending and self._is_ready(job, at_ns)
        ]
        if not begun:
            return None
        if self._is_late:
            return min(begun, key=lambda job: (job.taken_ns, job.number))
        first = min(begun, key=lambda job: (job.end_ns, job.number))
        if at_ns + sum(job.duration_ns for job in begun) > first.end_ns:
            return first
        return min(begun, key=lambda job: (job.kind != self._kind, job.end_ns, job.number))

    def _in_turn(self, at_ns: int) -> J | None:
        """Return a job for the time that periodic jobs do not need; None if there is none.

        A silent drive whose pause has ended gets its shortest job. Else jobs without a period take turns.
        """
        if self.back_off.has_silent and (drive := self.back_off.next_retry(at_ns)) is not None:
            own = [job for job in self.jobs if job.drive == drive]
            if own:
                return min(own, key=lambda job: job.duration_ns)
        for job in self._held:
            if self._is_ready(job, at_ns) and self._may_be_sent(job, at_ns):
                self._held.remove(job)
                return job
        for step in range(len(self._round)):
            number = (self._next + step) % len(self._round)
            job = self._round[number]
            if not self._may_be_sent(job, at_ns):
                continue
            if self._is_ready(job, at_ns):
                self._next = (number + 1) % len(self._round)
                return job
            if job not in self._held:
                self._held.append(job)
        self._owed_ns = -CREDIT_NS
        return None

    def _may_be_sent(self, job: J, at_ns: int) -> bool:
        return not self.back_off.is_paused(job.drive, at_ns) and not self._health[job.drive].is_pending

    def _take(self, job: J, at_ns: int) -> Turn[J]:
        """Return the next exchange of a job. Count and skip its polls whose period has already ended."""
        health = self._health[job.drive]
        health.is_pending = health.is_new
        ready_ns = self._ready.get(job.drive, 0)
        if job.period_ns is None or health.pause_ns:  # a retry does not replace a periodic poll
            self._owed_ns = max(self._owed_ns - self._duration_ns(job), -CREDIT_NS)
            return Turn(job, max(health.late_until_ns, ready_ns), None)
        self._begun.remove(job)
        ended = (at_ns - job.due_ns) // job.period_ns
        job.skipped += ended
        self._is_late |= ended > 0
        due_ns = job.due_ns + ended * job.period_ns
        job.due_ns, job.taken_ns = due_ns + job.period_ns, at_ns
        self._await(job)
        self._owed_ns += round(job.duration_ns * TURN_SHARE / (1 - TURN_SHARE))
        return Turn(job, max(due_ns, health.late_until_ns, ready_ns), due_ns)

    def _duration_ns(self, job: J) -> int:
        health = self._health[job.drive]
        return max(job.duration_ns, health.cost_ns) if health.pause_ns else job.duration_ns

    def _put_off(self) -> None:
        """Postpone the due jobs of each new drive whose first request has no result yet."""
        for job in [job for job in self._begun if self._health[job.drive].is_pending]:
            self._begun.remove(job)
            self._await(job)

    def put_back(self, turns: Sequence[Turn[J]]) -> None:
        """Schedule these exchanges again in the same order, because they were not carried out."""
        for turn in reversed(turns):
            job = turn.job
            self.back_off.conclude(job.drive)
            if job not in self.jobs:
                continue
            if turn.due_ns is None:
                self.go_on(job)
                continue
            self._forget_due(job)
            job.due_ns, job.taken_ns = turn.due_ns, 0
            self._await(job)

    # ---- skipped polls ----

    def _begin_pause(self, drive: int, now_ns: int) -> None:
        """Add the drive's jobs without a period to `unasked`, so that each gets one row without a value."""
        self.unasked += [(job, now_ns) for job in self._round if job.drive == drive]

    def pass_slots(self, now_ns: int) -> list[tuple[J, int]]:
        """Skip every poll that is due by `now_ns`. Return the job and the due time of each skipped poll."""
        while self._begun:
            self._await(self._begun.pop())
        passed = []
        while self._waiting and self._waiting[0][0] <= now_ns:
            due_ns, _, job = heapq.heappop(self._waiting)
            passed.append((job, due_ns))
            job.due_ns = job.end_ns
            self._await(job)
        return passed

    def pass_all(self, now_ns: int) -> list[tuple[J, int]]:
        """Do the same as `pass_slots`, and also skip each job without a period once."""
        return [*((job, now_ns) for job in self._round), *self.pass_slots(now_ns)]
