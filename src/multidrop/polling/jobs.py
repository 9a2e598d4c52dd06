"""Jobs: blocks of registers that are polled together, and the queue of their exchanges on a port."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

from multidrop.bus import Bus
from multidrop.core import Exchange, Names, Port, RowLayout
from multidrop.drive.family import Drive
from multidrop.drive.link import check_own
from multidrop.drive.register import row_field
from multidrop.planning.blocks import Block, Plan, may_be_too_long, plan, sending
from multidrop.planning.bus_time import kind, silence
from multidrop.planning.schedule import Job, Schedule, Turn
from multidrop.plant.model import PolledDrive
from multidrop.transport.drive_reads import make_read

MOST_NAMES = 1 << 16  # number of names that uint16 codes can distinguish


class RowNames:
    """Names of drives and registers, each with the number that rows store in place of the name."""

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
                    f"a poller can have at most {MOST_NAMES} different names of {of} during its life. This "
                    f"poller would have {len(names)}: start another poller"
                )

    def layout(self, drive: Drive, block: Block) -> RowLayout:
        """Return the layout of the rows into which the core decodes a reply with this block."""
        return RowLayout(
            self.drives.number(drive.name),
            [
                row_field(register, block.offset(register), self.registers.number(register.name))
                for register in block.registers
            ],
        )


@dataclass(eq=False, kw_only=True)
class PolledJob(Job):
    """A job of the schedule (a block that is polled), with its exchange and the layout of its rows."""

    owner: Drive
    block: Block
    exchange: Exchange
    rows: RowLayout
    # duration of the exchange's silence and characters on the line, without the drive's response delay
    own_ns: int
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
        # Jobs that read a block at different rates share its layout, because the layout counts the refusals.
        self._rows: dict[tuple[Drive, Block], RowLayout] = {}
        self._skipped = 0  # number of skipped polls of jobs that were forgotten

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

    def make(
        self, drive: Drive, block: Block, period_ns: int | None, *, rows: RowLayout | None = None
    ) -> PolledJob:
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
        """Number of polls that were skipped because the line was busy."""
        return self._skipped + sum(job.skipped for job in self._made.values())


# ---- the exchanges of a port ----


AHEAD_NS = 300_000_000  # exchanges are queued this long in advance

Slot = tuple[PolledJob, int]  # a job, and the time in ns at which it was due


class PortQueue:
    """Keeps the currently open port busy with the exchanges of the schedule's jobs.

    If all drives of a line answer and are polled as fast as possible, the C core gets the bus cycle once and
    repeats it. Otherwise many exchanges at a time are put into the core's queue.
    """

    def __init__(self, schedule: Schedule[PolledJob]) -> None:
        self._schedule = schedule
        self.port: Port | None = None
        self._done = 0  # number of the port's completed exchanges, as of the last `conclude`
        # queued turns (exchanges of jobs) that the core has not carried out yet
        self._queued: deque[Turn[PolledJob]] = deque()
        self._ahead_ns = 0  # total duration of the queued turns
        self._newest: Turn[PolledJob] | None = None  # the last turn that was carried out
        self._cycle: list[PolledJob] = []  # the jobs of the bus cycle that the core repeats

    @property
    def is_repeating(self) -> bool:
        return bool(self._cycle)

    def move_to(self, port: Port) -> None:
        """Use this port, which was opened or reopened and has an empty queue."""
        self.port, self._done = port, port.done

    def conclude(self, port: Port) -> None:
        """Report to the schedule which exchanges were carried out."""
        if port is not self.port:  # the port was reopened, and the new port's queue is empty
            return
        done = port.done
        for _ in range((done - self._done) & 0xFFFF_FFFF):
            self._newest = self._queued.popleft()
            job = self._newest.job
            self._ahead_ns -= job.duration_ns
            self._schedule.back_off.conclude(job.drive)
        self._done = done

    def keep_busy(self, port: Port, now_ns: int) -> None:
        """Let the C core repeat the bus cycle if possible; otherwise queue the next exchanges."""
        cycle = self._schedule.cycle(now_ns)
        if cycle != self._cycle or port.repeating != bool(cycle):
            self.pause(port)
            self._cycle = self._schedule.cycle(now_ns)
            if self._cycle:
                port.repeat([job.exchange for job in self._cycle])
        if not self._cycle:
            self._top_up(port, now_ns)

    def pause(self, port: Port) -> None:
        """Stop repeating; queued exchanges are still carried out."""
        following = port.repeat([])
        if self._cycle:
            self._schedule.go_on(self._cycle[following])
            self._cycle = []

    def abandon(self) -> None:
        """Forget the port and end the repeated bus cycle; queued exchanges are still carried out."""
        port, self.port = self.port, None
        self._queued.clear()
        self._cycle = []
        self._ahead_ns = 0
        if port is not None:
            port.repeat([])

    def _top_up(self, port: Port, now_ns: int) -> None:
        done_ns = max(now_ns + self._ahead_ns, self._queued[-1].not_before_ns if self._queued else 0)
        room = port.room - len(self._queued)
        turns = self._schedule.take(now_ns, done_ns, now_ns + AHEAD_NS, room)
        if turns:
            port.submit([turn.job.exchange for turn in turns], [turn.not_before_ns for turn in turns])
            self._queued += turns
            self._ahead_ns += sum(turn.job.duration_ns for turn in turns)

    def measure(self) -> None:
        """Recompute the total duration of the queued turns, after the durations of jobs have changed."""
        self._ahead_ns = sum(turn.job.duration_ns for turn in self._queued)

    def slots(self) -> list[Slot]:
        return [(turn.job, turn.due_ns) for turn in self._queued if turn.due_ns is not None]

    def give_back(self) -> None:
        """Return unsent exchanges to the schedule, because the port failed.

        An exchange that the failure interrupted is retried first. This does not apply to the first exchange
        on a newly opened port: it may be the reason why the device closes each connection.
        """
        if self.port is not None:
            self.conclude(self.port)
            if self._cycle:
                self._schedule.go_on(self._cycle[self.port.repeat([])])
            elif self.port.cut_off and self._newest:
                self._queued.appendleft(self._newest)
        self._schedule.put_back(self._queued)
        self._queued.clear()
        self._newest = None
        self._cycle = []
        self._ahead_ns = 0
