"""Which exchange of a line is due next. Pure: time, in ns, comes in as an argument.

A job with a period is due on its own grid: it never drifts, and a slot that could not be kept is
counted and left out, never made up for in a burst. Jobs without a period fill what is left in
turn. A drive that stays silent is rested for longer and longer, and asked one thing when a rest is
over; it is back at its full rate with the first answer.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Generic, TypeVar

SILENT_AFTER = 2  # failures in a row
FIRST_REST_NS = 500_000_000
LONGEST_REST_NS = 10_000_000_000


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
    _health: dict[int, _Health] = field(default_factory=dict)
    _turn: int = 0

    def add(self, job: J, now_ns: int) -> None:
        job.due_ns = now_ns
        self.jobs.append(job)
        self._health.setdefault(job.drive, _Health())

    def take(self, now_ns: int, budget_ns: int) -> list[J]:
        """What to do now: due jobs, the earliest first, then the others in turn, `budget_ns` of them.

        At least one, if any is due; none if none is.
        """
        waking: set[int] = set()
        taken: list[J] = []
        for job in [*self._due(now_ns), *self._in_turn()]:
            if taken and budget_ns < job.duration_ns:
                break
            health = self._health[job.drive]
            if health.rest_ns:
                if now_ns < health.asleep_until_ns or job.drive in waking:
                    continue
                waking.add(job.drive)
            taken.append(job)
            budget_ns -= job.duration_ns
        self._remember_turn(taken)
        return taken

    def _due(self, now_ns: int) -> list[J]:
        due = [job for job in self.jobs if job.period_ns is not None and job.due_ns <= now_ns]
        return sorted(due, key=lambda job: job.due_ns)

    def _in_turn(self) -> list[J]:
        jobs = self.jobs[self._turn :] + self.jobs[: self._turn]
        return [job for job in jobs if job.period_ns is None]

    def _remember_turn(self, taken: list[J]) -> None:
        filling = [job for job in taken if job.period_ns is None]
        if filling:
            self._turn = (self.jobs.index(filling[-1]) + 1) % len(self.jobs)

    def done(self, job: J, now_ns: int, *, answered: bool, late_ns: int = 0) -> None:
        """A job was carried out; due times go on along their grid.

        `late_ns`: for so long the answer may still come. The drive is asked nothing until then,
        or its answer could be taken for that to another question.
        """
        self._advance(job, now_ns)
        health = self._health[job.drive]
        if answered:
            self._health[job.drive] = _Health()
            return
        health.failures += 1
        rest_ns = late_ns
        if health.failures >= SILENT_AFTER:
            rest_ns = max(late_ns, min(max(2 * health.rest_ns, FIRST_REST_NS), LONGEST_REST_NS))
        health.rest_ns = rest_ns
        health.asleep_until_ns = now_ns + rest_ns

    def unasked(self, now_ns: int) -> list[tuple[J, int]]:
        """Slots that passed while their drive was at rest, with the time at which each was due."""
        return [
            slot
            for job in self.jobs
            if now_ns < self._health[job.drive].asleep_until_ns
            for slot in self._pass(job, now_ns)
        ]

    def pass_all(self, now_ns: int) -> list[tuple[J, int]]:
        """Let every slot up to now pass, with the time at which each was due; jobs in turn have one."""
        return [slot for job in self.jobs for slot in (self._pass(job, now_ns) or [(job, now_ns)])]

    def _pass(self, job: J, now_ns: int) -> list[tuple[J, int]]:
        passed = []
        while job.period_ns is not None and job.due_ns <= now_ns:
            passed.append((job, job.due_ns))
            job.due_ns += job.period_ns
        return passed

    def _advance(self, job: J, now_ns: int) -> None:
        if job.period_ns is None:
            return
        job.due_ns += job.period_ns
        late = now_ns - job.due_ns
        if late > 0:
            slots = late // job.period_ns
            job.skipped += slots
            job.due_ns += slots * job.period_ns

    def next_ns(self, now_ns: int) -> int | None:
        """When there is something to do; None when there never is."""
        times = []
        for job in self.jobs:
            health = self._health[job.drive]
            due = job.due_ns if job.period_ns is not None else now_ns
            times.append(max(due, health.asleep_until_ns if health.rest_ns else 0))
        return min(times, default=None)
