"""Which exchange of a line is due next. Pure: time, in ns, comes in as an argument.

The line is planned ahead, up to a horizon, so that it never waits for Python. A job with a period
is due on its own grid: it never drifts, and a slot that could not be kept is counted and left out,
never made up for in a burst. Jobs without a period fill what is left, in turn. A drive that stays
silent is rested for longer and longer, and all silent drives together cost a small share of the
line; it is back at its full rate with the first answer.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass, field
from typing import Generic, TypeVar

SILENT_AFTER = 2  # failures in a row
FIRST_REST_NS = 500_000_000
LONGEST_REST_NS = 10_000_000_000
SILENT_SHARE = 0.02  # of the line, for asking silent drives


@dataclass(eq=False, kw_only=True)
class Job:
    """One exchange that is wanted again and again. `drive` tells whose rest it shares."""

    drive: int
    period_ns: int | None
    duration_ns: int
    due_ns: int = 0
    skipped: int = 0  # slots left out because the line was busy


J = TypeVar("J", bound=Job)


@dataclass
class _Health:
    failures: int = 0
    rest_ns: int = 0
    asleep_until_ns: int = 0


@dataclass
class Schedule(Generic[J]):
    """The jobs of one line."""

    jobs: list[J] = field(default_factory=list)
    unasked: list[tuple[J, int]] = field(default_factory=list)  # slots that passed, when each was due
    _timed: list[tuple[int, int, J]] = field(default_factory=list)  # a heap of (due, number, job)
    _turn: list[J] = field(default_factory=list)  # jobs without a period, the next one first
    _health: dict[int, _Health] = field(default_factory=dict)
    _number: int = 0
    _ill: bool = False

    def add(self, job: J, now_ns: int) -> None:
        self.jobs.append(job)
        self._health.setdefault(job.drive, _Health())
        job.due_ns = now_ns
        if job.period_ns is None:
            self._turn.append(job)
        else:
            self._push(job)

    def remove(self, job: J) -> None:
        """No longer; what is queued of it is still carried out."""
        self.jobs.remove(job)
        self._turn = [it for it in self._turn if it is not job]
        self._timed = [it for it in self._timed if it[2] is not job]
        heapq.heapify(self._timed)

    def _push(self, job: J) -> None:
        self._number += 1
        heapq.heappush(self._timed, (job.due_ns, self._number, job))

    def take(self, now_ns: int, start_ns: int, horizon_ns: int, most: int) -> list[tuple[J, int]]:
        """What keeps the line busy from `start_ns`, when it has done all it was given, to the horizon.

        At most `most` jobs, in their order, each with the time before which it is not to be sent.
        """
        if not self._timed and not self._ill:
            return self._take_in_turn(start_ns, horizon_ns, most)
        taken: list[tuple[J, int]] = []
        at = max(now_ns, start_ns)
        while len(taken) < most and at < horizon_ns:
            job = self._due(at, now_ns) or self._in_turn(at) or self._due(horizon_ns, now_ns)
            if job is None:
                break
            due = job.due_ns if job.period_ns is not None else 0
            taken.append((job, due))
            at = max(at, due) + job.duration_ns
            if job.period_ns is not None:
                self._advance(job, now_ns)
                self._push(job)
        return taken

    def _take_in_turn(self, start_ns: int, horizon_ns: int, most: int) -> list[tuple[J, int]]:
        """The common case, that all are wanted as fast as the line allows and all answer."""
        if not self._turn:
            return []
        cycle_ns = sum(job.duration_ns for job in self._turn) or 1
        wanted = -(-(horizon_ns - start_ns) * len(self._turn) // cycle_ns)
        count = min(most, max(0, wanted))
        rounds = -(-count // len(self._turn))
        taken = [(job, 0) for job in (self._turn * rounds)[:count]]
        first = count % len(self._turn)
        self._turn = self._turn[first:] + self._turn[:first]
        return taken

    def _due(self, by_ns: int, now_ns: int) -> J | None:
        """The job that is due first, if it is by then; slots of drives at rest pass."""
        while self._timed and self._timed[0][0] <= by_ns:
            job = heapq.heappop(self._timed)[2]
            if self._may_ask(job, by_ns):
                return job
            self.unasked.append((job, job.due_ns))
            self._advance(job, now_ns)
            self._push(job)
        return None

    def _in_turn(self, at_ns: int) -> J | None:
        for number, job in enumerate(self._turn):
            if self._may_ask(job, at_ns):
                self._turn = [*self._turn[:number], *self._turn[number + 1 :], job]
                return job
        return None

    def _may_ask(self, job: J, at_ns: int) -> bool:
        """Not while its drive rests; one job when the rest is over, until its outcome is known."""
        health = self._health[job.drive]
        if at_ns < health.asleep_until_ns:
            return False
        if health.rest_ns:
            health.asleep_until_ns = at_ns + health.rest_ns
        return True

    def _advance(self, job: J, now_ns: int) -> None:
        assert job.period_ns is not None
        job.due_ns += job.period_ns
        late = now_ns - job.due_ns
        if late > 0:
            slots = late // job.period_ns
            job.skipped += slots
            job.due_ns += slots * job.period_ns

    def observe(self, drive: int, failures: int, now_ns: int, *, late_until_ns: int, cost_ns: int) -> None:
        """How often in a row a drive has not answered by now, and what asking it in vain costs.

        Until `late_until_ns` its answer to an earlier question may come, so it is asked nothing.
        """
        health = self._health[drive]
        if failures == health.failures:
            return
        health.failures = failures
        if failures == 0:
            health.rest_ns = health.asleep_until_ns = 0
        else:
            if failures >= SILENT_AFTER:
                health.rest_ns = min(max(2 * health.rest_ns, FIRST_REST_NS), LONGEST_REST_NS)
            rest_ns = max(health.rest_ns, self._fair_rest_ns(cost_ns) if health.rest_ns else 0)
            health.asleep_until_ns = max(late_until_ns, now_ns + rest_ns)
            if rest_ns:  # jobs in turn have no slots: one row for each rest says why there is none
                self.unasked += [(job, now_ns) for job in self._turn if job.drive == drive]
        self._ill = any(it.failures for it in self._health.values())

    def _fair_rest_ns(self, cost_ns: int) -> int:
        """So long a rest that all silent drives together cost no more than their share."""
        silent = sum(1 for it in self._health.values() if it.rest_ns)
        return round(silent * cost_ns / SILENT_SHARE)

    def pass_all(self, now_ns: int) -> list[tuple[J, int]]:
        """Let every slot up to now pass, with the time at which each was due; jobs in turn have one."""
        passed = [(job, now_ns) for job in self._turn]
        while self._timed and self._timed[0][0] <= now_ns:
            due_ns, _, job = heapq.heappop(self._timed)
            passed.append((job, due_ns))
            job.due_ns += job.period_ns or 0
            self._push(job)
        return passed
