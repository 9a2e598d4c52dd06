"""Refusals: split blocks that a drive does not answer as a whole, and poll refused registers rarely.

So registers beside a refused register can still be read. Refused registers, and split blocks as a whole, are
retried every SET_ASIDE_NS. Once the drive answers a retry, the register or block is polled as before. The
retries of a split block add no rows. A drive may also give no reply to a block that is too long. Such a block
is split if it was never answered, the drive answers other requests, and its class states no limit. A drive
that has never answered is also sent requests for a single register, because it may answer only short
requests.
"""

from __future__ import annotations

import logging

from multidrop.core import RowLayout
from multidrop.drive.family import Drive
from multidrop.planning.blocks import Block, halves, least
from multidrop.planning.schedule import Schedule
from multidrop.polling.jobs import JobMaker, PolledJob
from multidrop.transport.aside_log import log_aside

REFUSALS = 3  # exceptions in a row after which a block is split or a register is set aside
FAILURES = 3  # unanswered requests in a row after which a block is split
SET_ASIDE_NS = 60_000_000_000  # interval between retries of refused blocks

_log = logging.getLogger("multidrop.polling")


class Refusals:
    """The registers and blocks of one line that its drives refuse.

    A refused register is set aside: it is polled rarely. A refused block is split into smaller ones.
    """

    def __init__(self, schedule: Schedule[PolledJob], maker: JobMaker) -> None:
        self._schedule = schedule
        self._maker = maker
        # the scheduled jobs with the long period SET_ASIDE_NS -> the normal jobs that they replace
        self._set_aside: dict[PolledJob, PolledJob] = {}
        # normal jobs -> the jobs that replace them with the long period; kept for reuse
        self._rare: dict[PolledJob, PolledJob] = {}
        # for each part of a split job: the whole job as planned
        self._wholes: dict[PolledJob, PolledJob] = {}
        # for each retry of a split job: the whole job as planned
        self._trials: dict[PolledJob, PolledJob] = {}
        # jobs for drives that may only answer short requests: each reads a single register; by drive address
        self._probes: dict[int, PolledJob] = {}

    @property
    def names(self) -> list[str]:
        """Names, as DRIVE.REGISTER, of the refused registers, which are polled rarely."""
        return [
            f"{job.owner.name}.{register.name}" for job in self._set_aside for register in job.block.registers
        ]

    def update(self, now_ns: int) -> None:
        """Split or set aside refused blocks, and restore blocks that are answered again."""
        for trial in [trial for trial in self._trials if trial.rows.is_answered]:
            self._make_whole(trial, now_ns)
        for rare in [rare for rare in self._set_aside if not rare.rows.refusals]:
            job = self._set_aside.pop(rare)
            # Start counting again: a reply that came after the job was set aside may have been a refusal.
            job.rows.refusals = 0
            self._schedule.replace([rare], [job], now_ns)
        for job in [job for job in self._schedule.jobs if self._is_refused(job)]:
            if parts := halves(job.owner, job.block):
                self._split(job, parts, now_ns)
                self._try_rarely(self._wholes.get(job, job), now_ns)
            elif job not in self._set_aside:
                self._put_aside(job, now_ns)
        for job in [job for job in self._schedule.jobs if job.may_be_too_long and job.rows.failures]:
            self._split_unanswered(job, now_ns)
        if self._probes:
            self._end_probes()

    def _is_refused(self, job: PolledJob) -> bool:
        """Return True if a job's block was refused too often in a row.

        The limit is REFUSALS exceptions. For a part of a split block that has several registers, it is 1.
        """
        count = job.rows.refusals
        if not count or job in self._trials or job is self._probes.get(job.drive):
            return False
        is_part = len(job.block.registers) > 1 and job in self._wholes
        return count >= (1 if is_part else REFUSALS) and not job.owner.is_temporary(job.rows.refusal)

    def _put_aside(self, job: PolledJob, now_ns: int) -> None:
        if job not in self._rare:
            self._rare[job] = self._maker.make(job.owner, job.block, SET_ASIDE_NS)
        rare = self._rare[job]
        rare.rows.refusals = job.rows.refusals
        self._set_aside[rare] = job
        self._schedule.replace([job], [rare], now_ns)
        said = "%s is refused (code %02XH), and polled rarely from now on"
        log_aside(_log, logging.INFO, said, job.name, job.rows.refusal)

    # ---- blocks ----

    def _split(self, job: PolledJob, blocks: tuple[Block, ...], now_ns: int) -> None:
        parts = [self._maker.job(job.owner, block, job.period_ns) for block in blocks]
        for part in parts:
            part.rows.forget()
            self._wholes[part] = self._wholes.get(job, job)
        self._schedule.replace([job], parts, now_ns)
        why = f"is refused (code {job.rows.refusal:02X}H)" if job.rows.refusals else "is not answered"
        said = "%s with %d more %s, and polled in two parts"
        log_aside(_log, logging.INFO, said, job.name, len(job.block.registers) - 1, why)

    def _try_rarely(self, whole: PolledJob, now_ns: int) -> None:
        """Every SET_ASIDE_NS, check whether the drive now answers a split block as a whole."""
        if whole in self._trials.values():
            return
        trial = self._maker.make(whole.owner, whole.block, SET_ASIDE_NS, rows=RowLayout(0, []))
        self._trials[trial] = whole
        self._schedule.add(trial, now_ns + SET_ASIDE_NS)

    def _make_whole(self, trial: PolledJob, now_ns: int) -> None:
        whole = self._trials.pop(trial)
        parts = [
            job for job in self._schedule.jobs if self._wholes.get(self._set_aside.get(job, job)) is whole
        ]
        self._set_aside = {rare: job for rare, job in self._set_aside.items() if rare not in parts}
        self._wholes = {part: other for part, other in self._wholes.items() if other is not whole}
        whole.rows.forget()
        self._schedule.replace([trial, *parts], [whole], now_ns)

    # ---- silence ----

    def _split_unanswered(self, job: PolledJob, now_ns: int) -> None:
        """Split a block that stays unanswered and may be too long.

        This is only done if the drive answers other requests. A drive that has never answered also gets
        requests for a single register, if all its blocks may be too long.
        """
        peer, drive = job.exchange.peer, job.owner
        if job.rows.is_answered or job in self._trials:
            return
        if peer.failures < FAILURES <= job.rows.failures:
            self._split(job, halves(drive, job.block), now_ns)
        elif not peer.has_answered and drive.address not in self._probes:
            jobs = [other for other in self._schedule.jobs if other.owner is drive]
            if all(other.may_be_too_long for other in jobs):
                block = least(drive, job.block)
                probe = self._probes[drive.address] = self._maker.make(drive, block, job.period_ns)
                self._schedule.add(probe, now_ns)

    def _end_probes(self) -> None:
        """Remove the jobs in `_probes` of drives that now answer all blocks of several registers."""
        doubtful = {
            job.drive for job in self._schedule.jobs if job.may_be_too_long and not job.rows.is_answered
        }
        for address in self._probes.keys() - doubtful:
            self._schedule.remove(self._probes.pop(address))

    def forget(self, drive: Drive) -> None:
        self._set_aside = {rare: job for rare, job in self._set_aside.items() if rare.owner is not drive}
        self._rare = {job: rare for job, rare in self._rare.items() if job.owner is not drive}
        self._trials = {trial: job for trial, job in self._trials.items() if trial.owner is not drive}
        self._wholes = {part: job for part, job in self._wholes.items() if part.owner is not drive}
        self._probes.pop(drive.address, None)
