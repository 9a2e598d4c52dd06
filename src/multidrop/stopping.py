"""Stopping many drives in the shortest time: their stops take turns, so none waits for another's ramp."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import Enum
from typing import Any

from multidrop.drive import Drive, Script, Step, Wait, Write
from multidrop.errors import BusError, DriveRefused, LineError, Refused, Unsupported


class Seen(Enum):
    STOPPED = "stopped"  # seen to stand
    SENT = "sent but unknown"
    FAILED = "failed"  # no stop was sent


@dataclass(frozen=True)
class Stopped:
    """What is known of one drive's stop, how many seconds it took, and why it is not seen to stand."""

    drive: str
    seen: Seen
    seconds: float
    why: str = ""

    def __str__(self) -> str:
        why = f": {self.why}" if self.why else ""
        return f"{self.drive}: {self.seen.value} after {self.seconds:.1f} s{why}"


class _Task:
    """One drive's stop under way."""

    def __init__(self, drive: Drive, due: float, sent: bool) -> None:
        self.drive = drive
        self.due = due
        self.sent = sent  # a stop has left for it
        self.script: Script[None] = drive.stop.script()
        self._resume: Callable[[], Step] = lambda: next(self.script)

    def advance(self, carry_out: Callable[[Drive, Step], Any], now: Callable[[], float]) -> None:
        """Carry out one step; raises StopIteration at the end, or why it failed."""
        step = self._resume()
        if isinstance(step, Wait):
            self.due = now() + step.seconds
            self._resume = lambda: self.script.send(None)
            return
        try:
            result = carry_out(self.drive, step)
        except (BusError, ValueError) as failure:
            error = failure  # outlives the except clause
            self._note(step, error)
            self._resume = lambda: self.script.throw(error)
        else:
            self._note(step, None)
            self._resume = lambda: self.script.send(result)

    def _note(self, step: Step, failure: Exception | None) -> None:
        never_left = (Refused, LineError, DriveRefused)
        if isinstance(step, Write) and not isinstance(failure, never_left):
            self.sent = True


def stop_together(
    drives: Iterable[Drive],
    carry_out: Callable[[Drive, Step], Any],
    now: Callable[[], float],
    sleep: Callable[[float], None],
    sent_already: bool,
) -> dict[str, Stopped]:
    """Carry out the stops of all drives, a step of each in turn; what is known of each, by its name."""
    begun = now()
    tasks = [_Task(drive, begun, sent_already) for drive in drives]
    found = {}
    while tasks:
        task = min(tasks, key=lambda it: it.due)  # of several that are due, the one that waited longest
        tasks.remove(task)
        sleep(max(0.0, task.due - now()))
        try:
            task.advance(carry_out, now)
        except StopIteration:
            found[task.drive.name] = Stopped(task.drive.name, Seen.STOPPED, now() - begun)
        except (BusError, ValueError) as failure:
            seen = Seen.SENT if task.sent and not isinstance(failure, Unsupported) else Seen.FAILED
            found[task.drive.name] = Stopped(task.drive.name, seen, now() - begun, str(failure))
        else:
            tasks.append(task)
    return found
