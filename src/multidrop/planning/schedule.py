"""Which exchange of a line is due next. Pure: time, in ns, comes in as an argument.

The line is planned ahead, up to a horizon, so that it never waits for Python. A job with a period
has slots on its own grid, which never drifts. Of the slots that have begun the one goes first that
ends first; where there is time for all of them, those of one kind go together. A slot that is over
when its turn comes is counted and left out, never made up for in a burst; from then on, until the
line has caught up, the job goes first that was not asked for longest, so that everybody gets a part.
Jobs without a period fill what is left, each once in a round, and have a share of the line even where
nothing is left. A drive that stays silent is rested for longer and longer; in the others' spare time,
or that share, it is asked its shortest question, and all silent drives together cost a small part of
the line. With its first answer it is back, and another silent one is asked. A drive that has never
answered is asked one question, and no other until the outcome of that is known; if there was no
answer, it is rested at once. Once all have been asked, and few did not answer, these are asked again.
"""

from __future__ import annotations

import heapq
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from typing import Generic, NamedTuple, TypeVar

SILENT_AFTER = 2  # failures in a row
FIRST_REST_NS = 500_000_000
LONGEST_REST_NS = 2_000_000_000
SILENT_SHARE = 0.015  # of the line, for asking silent drives
SECOND_COST_NS = 400_000_000  # at most, of asking new drives again at once: a reply may have been lost
TURN_SHARE = 0.05  # of the line, for jobs without a period, at least
CREDIT_NS = 50_000_000  # of it, that they use up in advance


@dataclass(eq=False, kw_only=True)
class Job:
    """One exchange that is wanted again and again. `drive` tells whose rest it shares.

    Jobs of one `kind` follow each other in the least time: they share line settings and silence.
    """

    drive: int
    period_ns: int | None
    duration_ns: int
    kind: Hashable = None
    due_ns: int = 0
    asked_ns: int = 0
    skipped: int = 0  # slots left out because the line was busy
    number: int = 0  # in the bus cycle

    @property
    def end_ns(self) -> int:
        """When its slot is over."""
        return self.due_ns + (self.period_ns or 0)


J = TypeVar("J", bound=Job)


class Asking(NamedTuple, Generic[J]):
    """A job's turn."""

    job: J
    not_before_ns: int
    due_ns: int | None  # its slot; None: it has none


@dataclass
class _Health:
    is_new: bool = False  # it has never answered
    is_asked: bool = False  # what becomes of its question is not known yet; only where it is new
    failures: int = 0
    late_until_ns: int = 0
    rest_ns: int = 0
    asleep_until_ns: int = 0
    cost_ns: int = 0  # of asking it in vain


@dataclass
class Schedule(Generic[J]):
    """The jobs of one line."""

    jobs: list[J] = field(default_factory=list)
    unasked: list[tuple[J, int]] = field(default_factory=list)  # slots that passed, when each was due
    _waiting: list[tuple[int, int, J]] = field(default_factory=list)  # a heap of (due, number, job)
    _begun: list[J] = field(default_factory=list)  # whose slot has begun
    _turn: list[J] = field(default_factory=list)  # jobs without a period
    _next: int = 0  # of them
    _owed_ns: int = -CREDIT_NS  # to them
    _is_late: bool = False  # a slot had to be left out since the line last had done all that was due
    _kind: Hashable = None  # of the job that was taken last
    _health: dict[int, _Health] = field(default_factory=dict)
    _number: int = 0
    _ill: bool = False
    _late_until_ns: int = 0  # of all drives

    def add(self, job: J, now_ns: int) -> None:
        self.jobs.append(job)
        self._health.setdefault(job.drive, _Health())
        self._number += 1
        job.number, job.due_ns = self._number, now_ns
        if job.period_ns is None:
            self._turn.append(job)
        else:
            self._await(job)

    def remove(self, job: J) -> None:
        """No longer; what is queued of it is still carried out."""
        self.jobs.remove(job)
        self._begun = [it for it in self._begun if it is not job]
        self._waiting = [it for it in self._waiting if it[2] is not job]
        heapq.heapify(self._waiting)
        if job in self._turn:
            at = self._turn.index(job)
            self._next -= at < self._next
            self._turn.pop(at)

    def replace(self, jobs: Sequence[J], others: Sequence[J], due_ns: int) -> None:
        """Others instead of jobs, in their place in the round; the first slot of each is due then."""
        turn = self._turn[self._next :] + self._turn[: self._next]
        at = next((at for at, job in enumerate(turn) if job in jobs), len(turn))
        for job in others:
            self.add(job, due_ns)
        turn[at:at] = [job for job in others if job.period_ns is None]
        self._turn, self._next = turn, 0
        for job in jobs:
            self.remove(job)

    def forget(self, drive: int) -> None:
        """A drive of which no job is left."""
        self._health.pop(drive, None)

    def meet(self, drive: int) -> None:
        """Ask this drive one question at a time until it answers: it may not be there."""
        self._health[drive].is_new = self._ill = True

    def conclude(self, job: J) -> None:
        """Know that a question is over, whatever became of it."""
        if job.drive in self._health:
            self._health[job.drive].is_asked = False

    def _await(self, job: J) -> None:
        heapq.heappush(self._waiting, (job.due_ns, job.number, job))

    # ---- what comes next ----

    def cycle(self, now_ns: int) -> list[J]:
        """What is to be carried out again and again, where that is all: no slots, and all drives answer."""
        if self._must_look(now_ns) or self._waiting or self._begun:
            return []
        return self._turn[self._next :] + self._turn[: self._next]

    def go_on(self, job: J) -> None:
        """That cycle has come so far that it is this job's turn."""
        if job in self._turn:
            self._next = self._turn.index(job)

    def take(self, now_ns: int, start_ns: int, horizon_ns: int, most: int) -> list[Asking[J]]:
        """What keeps the line busy from `start_ns`, when it has done all it was given, to the horizon.

        At most `most` jobs, in their order.
        """
        at = max(now_ns, start_ns)
        taken: list[Asking[J]] = []
        while len(taken) < most and at < horizon_ns:
            self._begin_slots(at)
            job = (self._in_turn(at) if self._owed_ns > 0 else None) or self._due(at) or self._in_turn(at)
            if job is None:
                if not self._waiting or self._waiting[0][0] >= horizon_ns:
                    break
                at = max(at, self._waiting[0][0])
                continue
            taken.append(self._ask(job, at))
            at += self._duration_ns(job)
            self._kind = job.kind
        self._put_off()
        return taken

    def _put_off(self) -> None:
        """Keep slots of drives whose first answer is waited for: some of them begin later than now."""
        for job in [it for it in self._begun if self._health[it.drive].is_asked]:
            self._begun.remove(job)
            self._await(job)

    def _begin_slots(self, by_ns: int) -> None:
        """Slots of drives at rest pass."""
        while self._waiting and self._waiting[0][0] <= by_ns:
            job = heapq.heappop(self._waiting)[2]
            if self._is_asleep(job, by_ns):
                self._pass(job)
            else:
                self._begun.append(job)

    def _pass(self, job: J) -> None:
        self.unasked.append((job, job.due_ns))
        job.due_ns = job.end_ns
        self._await(job)

    def _due(self, at_ns: int) -> J | None:
        """The job whose slot ends first; where all can wait for it, rather one of the kind that was last."""
        if self._must_look(at_ns):
            for job in [it for it in self._begun if self._is_asleep(it, at_ns)]:
                self._begun.remove(job)
                self._pass(job)
        if not self._begun:
            self._is_late = False
            return None
        begun = [job for job in self._begun if not self._health[job.drive].is_asked]
        if not begun:
            return None
        if self._is_late:
            return min(begun, key=lambda job: (job.asked_ns, job.number))
        first = min(begun, key=lambda job: (job.end_ns, job.number))
        if at_ns + sum(job.duration_ns for job in begun) > first.end_ns:
            return first
        return min(begun, key=lambda job: (job.kind != self._kind, job.end_ns, job.number))

    def _ask(self, job: J, at_ns: int) -> Asking[J]:
        """The job is asked at this time; where it has slots, in one of them. Those over are left out."""
        health = self._health[job.drive]
        health.is_asked = health.is_new
        if job.period_ns is None or health.rest_ns:  # or asked whether it answers
            self._owed_ns = max(self._owed_ns - self._duration_ns(job), -CREDIT_NS)
            return Asking(job, health.late_until_ns, None)
        self._begun.remove(job)
        over = (at_ns - job.due_ns) // job.period_ns
        job.skipped += over
        self._is_late |= over > 0
        due_ns = job.due_ns + over * job.period_ns
        job.due_ns, job.asked_ns = due_ns + job.period_ns, at_ns
        self._await(job)
        self._owed_ns += round(job.duration_ns * TURN_SHARE / (1 - TURN_SHARE))
        return Asking(job, max(due_ns, health.late_until_ns), due_ns)

    def _in_turn(self, at_ns: int) -> J | None:
        """A drive at rest whose turn it is to be asked, or the next of the jobs without a period."""
        if self._ill and (probe := self._probe(at_ns)):
            return probe
        for step in range(len(self._turn)):
            number = (self._next + step) % len(self._turn)
            job = self._turn[number]
            if not self._is_asleep(job, at_ns) and not self._health[job.drive].is_asked:
                self._next = (number + 1) % len(self._turn)
                return job
        self._owed_ns = -CREDIT_NS
        return None

    # ---- drives that are silent ----

    def _must_look(self, at_ns: int) -> bool:
        """Whether one may be asleep."""
        return self._ill or at_ns < self._late_until_ns

    def _is_asleep(self, job: J, at_ns: int) -> bool:
        health = self._health[job.drive]
        return health.rest_ns > 0 or at_ns < max(health.asleep_until_ns, health.late_until_ns)

    def _probe(self, at_ns: int) -> J | None:
        """The shortest question to a drive whose rest is over; then it rests until the outcome is known."""
        for drive, health in self._health.items():
            if health.rest_ns and at_ns >= health.asleep_until_ns and not health.is_asked:
                health.asleep_until_ns = at_ns + health.rest_ns
                own = (job for job in self.jobs if job.drive == drive)
                return min(own, key=lambda job: job.duration_ns, default=None)
        return None

    def _duration_ns(self, job: J) -> int:
        health = self._health[job.drive]
        return max(job.duration_ns, health.cost_ns) if health.rest_ns else job.duration_ns

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
        """How often in a row a drive has not answered by now, and what asking it in vain costs next.

        Until `late_until_ns` its answer to an earlier question may come, so it is asked nothing, even
        if it has answered since. When that has come, late as it is, the drive can be asked at once.
        """
        health = self._health[drive]
        has_answered_late = late_until_ns < health.late_until_ns
        has_changed = failures != health.failures
        health.failures, health.late_until_ns, health.cost_ns = failures, late_until_ns, cost_ns
        health.is_new &= not has_answered
        if has_changed and failures:
            self._rest(drive, now_ns)
        elif has_changed:
            if health.rest_ns:
                self._wake_next(drive, now_ns)
            health.rest_ns = health.asleep_until_ns = 0
        elif has_answered_late:
            health.asleep_until_ns = now_ns
        if self._ill:
            self._ask_again(now_ns)
        self._ill = any(it.failures or it.is_new for it in self._health.values())
        self._late_until_ns = max(it.late_until_ns for it in self._health.values())

    def _wake_next(self, drive: int, now_ns: int) -> None:
        """Let one more drive rest no longer, because this one is back: both may have had no power."""
        resting = [it for number, it in self._health.items() if it.rest_ns and number != drive]
        if resting:
            first = min(resting, key=lambda it: it.asleep_until_ns)
            first.asleep_until_ns = min(first.asleep_until_ns, max(now_ns, first.late_until_ns))

    def _ask_again(self, now_ns: int) -> None:
        """Let new drives not rest after their first question, where all had theirs and few are silent."""
        new = [it for it in self._health.values() if it.is_new]
        silent = [it for it in new if it.failures == 1]
        if all(it.failures for it in new) and sum(it.cost_ns for it in silent) <= SECOND_COST_NS:
            for health in silent:
                health.asleep_until_ns = max(now_ns, health.late_until_ns)

    def _rest(self, drive: int, now_ns: int) -> None:
        health = self._health[drive]
        if health.failures >= (1 if health.is_new else SILENT_AFTER):
            health.rest_ns = min(max(2 * health.rest_ns, FIRST_REST_NS), LONGEST_REST_NS)
        rest_ns = max(health.rest_ns, self._fair_rest_ns()) if health.rest_ns else 0
        health.asleep_until_ns = max(health.late_until_ns, now_ns + rest_ns)
        if rest_ns:  # jobs in turn have no slots: one row for each rest says why there is none
            self.unasked += [(job, now_ns) for job in self._turn if job.drive == drive]

    def _fair_rest_ns(self) -> int:
        """So long a rest that all silent drives together cost no more than their share."""
        return round(sum(it.cost_ns for it in self._health.values() if it.rest_ns) / SILENT_SHARE)

    # ---- when nothing is asked ----

    def pass_slots(self, now_ns: int) -> list[tuple[J, int]]:
        """Let every slot that begins by now pass, with the time at which each was due."""
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
        """The same, and jobs without a period have one slot now."""
        return [*((job, now_ns) for job in self._turn), *self.pass_slots(now_ns)]
