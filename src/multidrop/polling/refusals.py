"""Refusals: registers that their drive refuses are asked singly, then set aside and asked rarely.

So no register is lost because of its neighbours. One that is answered after all is polled as before.
"""

from __future__ import annotations

import logging

from multidrop.drive.family import Drive
from multidrop.planning.blocks import Block
from multidrop.planning.schedule import Schedule
from multidrop.polling.jobs import JobMaker, PolledJob
from multidrop.transport.aside_log import log_aside

REFUSALS = 3  # exceptions in a row after which a register is asked for in another way
SET_ASIDE_NS = 60_000_000_000  # between attempts to read a register that the drive refuses

_log = logging.getLogger("multidrop.polling")


class Refusals:
    """Registers of one line that are set aside."""

    def __init__(self, schedule: Schedule[PolledJob], maker: JobMaker) -> None:
        self._schedule = schedule
        self._maker = maker
        self._set_aside: dict[PolledJob, PolledJob] = {}  # the rare job, and the one it replaces
        self._rare: dict[PolledJob, PolledJob] = {}  # by the job that each replaces

    @property
    def names(self) -> list[str]:
        """Drives and registers that are set aside now."""
        return [job.name for job in self._set_aside]

    def heed(self, now_ns: int) -> None:
        """Ask for refused registers in another way, and for those that are answered again as before."""
        for job in [job for job in self._set_aside if not job.rows.refusals]:
            self._schedule.replace([job], [self._set_aside.pop(job)], now_ns)
        for job in [job for job in self._schedule.jobs if _is_refused(job)]:
            if len(job.block.registers) > 1:
                parts = [
                    self._maker.job(job.owner, Block.of(job.owner, [register]), job.period_ns)
                    for register in job.block.registers
                ]
                self._schedule.replace([job], parts, now_ns)
            elif job not in self._set_aside:
                self._put_aside(job, now_ns)

    def _put_aside(self, job: PolledJob, now_ns: int) -> None:
        if job not in self._rare:
            self._rare[job] = self._maker.make(job.owner, job.block, SET_ASIDE_NS)
        rare = self._rare[job]
        rare.rows.refusals, job.rows.refusals = job.rows.refusals, 0
        self._set_aside[rare] = job
        self._schedule.replace([job], [rare], now_ns)
        said = "%s is refused (code %02XH), and asked rarely from now on"
        log_aside(_log, logging.INFO, said, job.name, job.rows.refusal)

    def forget(self, drive: Drive) -> None:
        """Set nothing of this drive aside any more: it leaves."""
        self._set_aside = {rare: job for rare, job in self._set_aside.items() if rare.owner is not drive}
        self._rare = {job: rare for job, rare in self._rare.items() if job.owner is not drive}


def _is_refused(job: PolledJob) -> bool:
    return job.rows.refusals >= REFUSALS and not job.owner.is_passing(job.rows.refusal)
