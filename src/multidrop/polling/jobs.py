"""Jobs: blocks of a drive's registers that are polled together, each with its exchange and row layout."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from multidrop.bus import Bus
from multidrop.core import Exchange, Names, RowLayout
from multidrop.drive.family import Drive, check_own
from multidrop.drive.register import row_field
from multidrop.planning.blocks import Block, Plan, may_be_too_long, plan, sending
from multidrop.planning.bus_time import kind, silence
from multidrop.planning.schedule import Job
from multidrop.plant.model import PolledDrive
from multidrop.transport.prepared import make_read

MOST_NAMES = 1 << 16  # limit of the uint16 name codes


class RowNames:
    """Names of drives and registers, and the numbers that rows store instead of names."""

    def __init__(self) -> None:
        self.drives = Names()
        self.registers = Names()

    def check_room(self, drives: Iterable[PolledDrive]) -> None:
        """Raise ValueError if these drives would bring the number of names above MOST_NAMES."""
        wanted = list(drives)
        of_drives = {*self.drives.listed, *(polled.drive.name for polled in wanted)}
        of_registers = {*self.registers.listed, *(poll.register.name for d in wanted for poll in d.series)}
        for names, of in ((of_drives, "drives"), (of_registers, "registers")):
            if len(names) > MOST_NAMES:
                raise ValueError(
                    f"a poller uses at most {MOST_NAMES} names of {of} while it runs, and this one would use "
                    f"{len(names)}; start another poller"
                )

    def layout(self, drive: Drive, block: Block) -> RowLayout:
        """Return the layout of the rows that a reply with this block is decoded into."""
        return RowLayout(
            self.drives.number(drive.name),
            [
                row_field(register, block.offset(register), self.registers.number(register.name))
                for register in block.registers
            ],
        )


@dataclass(eq=False, kw_only=True)
class PolledJob(Job):
    """A job of the schedule, with its exchange and the layout of its rows."""

    owner: Drive
    block: Block
    exchange: Exchange
    rows: RowLayout
    own_ns: int  # duration of the exchange's silence and characters, without the response delay
    may_be_too_long: bool  # True if the block may have more registers than the drive answers in one reply

    @property
    def name(self) -> str:
        """Name of the drive and of the first register."""
        return f"{self.owner.name}.{self.block.registers[0].name}"


@dataclass
class PlannedJobs:
    """The jobs that read a drive's registers in the least bus time, and the plan that they follow."""

    jobs: list[PolledJob]
    plan: Plan


class JobMaker:
    """Makes the jobs of one line. The same block at the same rate always gets the same job object."""

    def __init__(self, bus: Bus, names: RowNames) -> None:
        self._bus = bus
        self._names = names
        self._made: dict[tuple[Drive, Block, int | None], PolledJob] = {}
        # The layout counts a block's refusals, so a block has the same layout at all rates.
        self._rows: dict[tuple[Drive, Block], RowLayout] = {}
        self._skipped = 0  # skipped slots of forgotten jobs

    def plan(self, polled: PolledDrive, delay: float) -> PlannedJobs:
        """Plan the requests that poll a drive, for a response delay of `delay` s; return their jobs.

        Raises ValueError for a register of another drive.
        """
        drive = polled.drive
        for poll in polled.polls:
            check_own(drive, poll.register)
        best = plan(drive, polled.wanted, delay)
        jobs = [
            self.job(drive, one.block, None if one.every is None else round(one.every * 1e9))
            for one in best.planned
        ]
        return PlannedJobs(jobs, best)

    def job(self, drive: Drive, block: Block, period_ns: int | None) -> PolledJob:
        key = drive, block, period_ns
        if key not in self._made:
            if (drive, block) not in self._rows:
                self._rows[drive, block] = self._names.layout(drive, block)
            self._made[key] = self.make(drive, block, period_ns, rows=self._rows[drive, block])
        return self._made[key]

    def forget(self, jobs: Iterable[PolledJob]) -> None:
        """Forget these jobs, so that frequent changes of rates use limited memory.

        Jobs without a period are kept, because the core may repeat them until the port is closed.
        """
        for job in jobs:
            key = job.owner, job.block, job.period_ns
            if job.period_ns is not None and self._made.get(key) is job:
                del self._made[key]
                self._skipped += job.skipped

    def forget_drive(self, drive: Drive) -> None:
        """Forget the jobs of a drive that was removed for good."""
        for key in [key for key in self._made if key[0] is drive]:
            self._skipped += self._made.pop(key).skipped
        self._rows = {key: rows for key, rows in self._rows.items() if key[0] is not drive}

    def make(
        self, drive: Drive, block: Block, period_ns: int | None, *, rows: RowLayout | None = None
    ) -> PolledJob:
        """Return a new job that is not cached."""
        rows = rows or self._names.layout(drive, block)
        own_ns = round((silence(drive) + sending(drive, block)) * 1e9)
        return PolledJob(
            drive=drive.address,
            kind=kind(drive),
            silence_ns=round(silence(drive) * 1e9),
            interval_ns=round(drive.least_interval * 1e9),
            period_ns=period_ns,
            duration_ns=own_ns + round(drive.response_delay * 1e9),
            owner=drive,
            block=block,
            exchange=make_read(drive, block, self._bus.peer(drive), rows, period=(period_ns or 0) / 1e9),
            rows=rows,
            own_ns=own_ns,
            may_be_too_long=may_be_too_long(drive, block),
        )

    @property
    def skipped(self) -> int:
        """Number of slots that were skipped because the line was busy."""
        return self._skipped + sum(job.skipped for job in self._made.values())
