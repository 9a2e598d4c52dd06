"""PortQueue: the exchanges that the core carries out on a port, either queued ahead or repeated.

If all drives of a line answer and are polled as fast as possible, the core repeats the bus cycle by itself.
Otherwise the queue is refilled with many exchanges at a time.
"""

from __future__ import annotations

from collections import deque

from multidrop.core import Port
from multidrop.planning.schedule import Schedule, Turn
from multidrop.polling.jobs import PolledJob

AHEAD_NS = 300_000_000  # how far in advance exchanges are queued

Slot = tuple[PolledJob, int]  # a job, and the time in ns at which it was due


class PortQueue:
    """The exchanges of a schedule's jobs on the currently open port."""

    def __init__(self, schedule: Schedule[PolledJob]) -> None:
        self._schedule = schedule
        self.port: Port | None = None
        self._done = 0  # number of the port's exchanges completed at the last `conclude`
        self._queued: deque[Turn[PolledJob]] = deque()  # turns that the core has not carried out yet
        self._ahead_ns = 0  # total duration of the queued turns
        self._newest: Turn[PolledJob] | None = None  # the last turn carried out
        self._cycle: list[PolledJob] = []  # the jobs of the bus cycle that the core repeats

    @property
    def is_repeating(self) -> bool:
        return bool(self._cycle)

    def move_to(self, port: Port) -> None:
        """Use this port, which was opened or reopened and has an empty queue."""
        self.port, self._done = port, port.done

    def conclude(self, port: Port) -> None:
        """Report to the schedule which exchanges were carried out."""
        if port is not self.port:  # the port was reopened, and its queue is empty
            return
        done = port.done
        for _ in range((done - self._done) & 0xFFFF_FFFF):
            self._newest = self._queued.popleft()
            job = self._newest.job
            self._ahead_ns -= job.duration_ns
            self._schedule.back_off.conclude(job.drive)
        self._done = done

    def keep_busy(self, port: Port, now_ns: int) -> None:
        """Let the core repeat the bus cycle if possible; otherwise queue the next exchanges."""
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
        """Forget the port and stop its repeating; queued exchanges are still carried out."""
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
        """Return the slots of the queued turns."""
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
