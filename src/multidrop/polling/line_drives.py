"""LineDrives: the drives of one line, their jobs, and their measured delays.

A drive's blocks are planned again if its measured response delay differs too much from the planned one.
"""

from __future__ import annotations

from collections.abc import Mapping

from multidrop.bus import Bus
from multidrop.core import Peer
from multidrop.drive.family import Drive
from multidrop.planning.schedule import Schedule
from multidrop.plant.model import PolledDrive
from multidrop.polling.jobs import JobMaker, PlannedJobs, PolledJob
from multidrop.polling.port_queue import Slot
from multidrop.polling.refusals import Refusals
from multidrop.transport import clock

MARGIN = 0.05  # fraction by which a response delay may lie outside the range of its plan


class LineDrives:
    """The drives of one line, which may be added and removed; the caller holds the line's lock."""

    def __init__(self, bus: Bus, schedule: Schedule[PolledJob], maker: JobMaker, refusals: Refusals) -> None:
        self.schedule = schedule
        self._bus = bus
        self._maker = maker
        self._refusals = refusals
        self._planned: dict[PolledDrive, PlannedJobs] = {}  # includes removed drives
        self._present: dict[Drive, PolledDrive] = {}  # the drives on the line
        self._since_ns: dict[Drive, int] = {}  # when each drive's polls were last changed
        self._gone: dict[int, Peer] = {}  # peers of removed drives, by address; may still be in an exchange
        self._polled: list[tuple[Drive, Peer]] = []
        self._observed: list[tuple[int, int, bool]] = []  # for each: failures, late until, has answered

    @property
    def polled(self) -> tuple[PolledDrive, ...]:
        """The present drives with their polled registers."""
        return tuple(self._present.values())

    @property
    def since_ns(self) -> dict[str, int]:
        """By drive name, when the drive's polls were last changed (ns, CLOCK_MONOTONIC)."""
        return {drive.name: since_ns for drive, since_ns in self._since_ns.copy().items()}

    def polled_of(self, drive: Drive) -> PolledDrive:
        return self._present[drive]

    def take_gone(self, address: int) -> Peer | None:
        """Return, only once, the peer of a drive that was removed from this address; needs no lock."""
        return self._gone.pop(address, None)

    def add(self, polled: PolledDrive, *, is_started: bool) -> None:
        """Attach a drive, and schedule its jobs if polling has started."""
        drive = self._bus.attach(polled.drive)
        try:
            if polled not in self._planned:
                self._planned[polled] = self._maker.plan(polled, drive.response_delay)
        except BaseException:
            self._bus.detach(drive)
            raise
        self._present[drive] = polled
        self._since_ns[drive] = clock.now_ns()
        if self._planned[polled].jobs:
            self._polled.append((drive, self._bus.peer(drive)))
        if is_started:
            self.begin(drive, clock.now_ns())

    def begin(self, drive: Drive, due_ns: int) -> None:
        """Schedule the jobs of a drive, first due at `due_ns`."""
        jobs = self._planned[self._present[drive]].jobs
        for job in jobs:
            self.schedule.add(job, due_ns)
        if jobs and not self._bus.peer(drive).has_answered:
            self.schedule.back_off.meet(drive.address)

    def begin_anew(self, now_ns: int) -> None:
        """Schedule the jobs of all drives again; a failure may have left the schedule incomplete."""
        self.schedule.clear()
        self._observed = []
        for drive in self._present:
            self._refusals.forget(drive)
            self.begin(drive, now_ns)

    def slots(self, drive: Drive) -> list[Slot]:
        """Return the next slot of each of a drive's jobs that has a period."""
        return [(job, job.due_ns) for job in self._jobs(drive) if job.period_ns]

    def remove(self, drive: Drive) -> None:
        """Remove a drive's jobs; its queued exchanges are still carried out."""
        for job in self._jobs(drive):
            self.schedule.remove(job)
        self.schedule.back_off.forget(drive.address)
        self._refusals.forget(drive)
        self._present.pop(drive, None)
        self._since_ns.pop(drive, None)
        self._polled = [(other, peer) for other, peer in self._polled if other is not drive]
        self._gone[drive.address] = self._bus.peer(drive)

    def forget(self, drive: Drive) -> None:
        """Forget the jobs of a drive that was removed for good, but keep its peer."""
        self._planned = {each: jobs for each, jobs in self._planned.items() if each.drive is not drive}
        self._maker.forget_drive(drive)

    def _jobs(self, drive: Drive) -> list[PolledJob]:
        return [job for job in self.schedule.jobs if job.owner is drive]

    # ---- other registers or rates ----

    def set_polls(self, after: PolledDrive, *, is_started: bool) -> bool:
        """Change a drive's polled registers or rates; return False if they are the same."""
        drive = after.drive
        before = self._present[drive]
        if after == before:
            return False
        peer = self._bus.peer(drive)
        planned = self._maker.plan(after, peer.response_delay or drive.response_delay)
        self._since_ns[drive] = clock.now_ns()
        if is_started:
            self._change_jobs(drive, planned.jobs, clock.now_ns())
        others = [(other, known) for other, known in self._polled if other is not drive]
        self._polled = [*others, (drive, peer)] if planned.jobs else others
        self._planned.pop(before)
        self._planned[after] = planned
        self._present[drive] = after
        return True

    def _change_jobs(self, drive: Drive, wanted: list[PolledJob], now_ns: int) -> None:
        """Replace a drive's jobs by these; its queued exchanges are still carried out.

        Refused registers are polled normally again.
        """
        present = self._jobs(drive)
        dues = {job.period_ns: job.due_ns for job in sorted(present, key=_due, reverse=True)}  # earliest each
        self._refusals.forget(drive)
        old = [job for job in present if job not in wanted]
        for period_ns in dict.fromkeys(job.period_ns for job in [*wanted, *old]):
            self.schedule.replace(
                [job for job in old if job.period_ns == period_ns],
                [job for job in wanted if job.period_ns == period_ns and job not in present],
                dues.get(period_ns, now_ns) if period_ns else now_ns,
            )
        self._maker.forget(old)
        back_off = self.schedule.back_off
        if not wanted:
            back_off.forget(drive.address)
        elif not present and not self._bus.peer(drive).has_answered:
            back_off.meet(drive.address)

    # ---- what their answers show ----

    def observe(self, now_ns: int) -> None:
        """Report the drives' failures and late replies to the schedule's back-off, if they changed."""
        seen = [(peer.failures, peer.late_until_ns, peer.has_answered) for _, peer in self._polled]
        if seen == self._observed:
            return
        self._observed = seen
        for (drive, peer), (failures, late_until_ns, has_answered) in zip(self._polled, seen, strict=True):
            self.schedule.back_off.observe(
                drive.address,
                failures,
                now_ns,
                late_until_ns=late_until_ns,
                cost_ns=peer.vain_ns,
                has_answered=has_answered,
            )

    def measure(self) -> dict[Drive, float]:
        """Update exchange durations with the drives' measured response delays; return the delays in s."""
        delays = {drive: peer.response_delay for drive, peer in self._polled}
        for job in self.schedule.jobs:
            job.duration_ns = job.own_ns + round((delays[job.owner] or job.owner.response_delay) * 1e9)
        return delays

    def plan_anew(self, delays: Mapping[Drive, float], now_ns: int) -> None:
        """Plan those drives again whose measured delays no longer suit their plans."""
        for polled in self._present.values():
            planned, delay = self._planned[polled], delays.get(polled.drive)
            if delay and not planned.plan.suits(delay, MARGIN):
                self._plan_anew(polled, planned, delay, now_ns)

    def _plan_anew(self, polled: PolledDrive, before: PlannedJobs, delay: float, now_ns: int) -> None:
        """Replace a drive's jobs by those of a new plan, unless refusals have split its blocks."""
        if not set(before.jobs) <= set(self.schedule.jobs):
            return
        anew = self._maker.plan(polled, delay)
        for period_ns in {job.period_ns for job in anew.jobs}:
            old = [job for job in before.jobs if job.period_ns == period_ns and job not in anew.jobs]
            new = [job for job in anew.jobs if job.period_ns == period_ns and job not in before.jobs]
            due_ns = min((job.due_ns for job in old if period_ns), default=now_ns)
            self.schedule.replace(old, new, due_ns)
        self._planned[polled] = anew


def _due(job: PolledJob) -> int:
    return job.due_ns
