"""Stopping drives: each again and again until it is answered and its motor is seen to stand.

Of several the stops take turns, so none waits for another's ramp.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from typing import Any

from multidrop.drive.family import Drive
from multidrop.drive.script import Pulse, Script, Step, Wait, Write
from multidrop.errors import (
    BadReply,
    BusError,
    DriveRefused,
    LineError,
    LookAgain,
    NoReply,
    NotDone,
    PortLost,
    Refused,
    Unconfirmed,
    Unsupported,
)

LEAST_S = 30.0  # so long a stop is repeated where its caller says nothing else
PAUSE_S = 0.2  # before it is repeated
MOST_STEPS = 8  # that are sent once more after an interruption

Do = Callable[["Stopping", Step], Any]


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


@dataclass(frozen=True)
class Patience:
    """How long a stop is repeated, and after which failures.

    Without `seconds` it is for LEAST_S at least, and what has begun by then may take its time: the ramp.
    """

    seconds: float | None = None
    worth_repeating: tuple[type[Exception], ...] = (
        Unconfirmed,
        NotDone,
        NoReply,
        BadReply,
        DriveRefused,
        PortLost,
    )


class Stopping:
    """One drive's stop under way; its `failure`, None while all is well."""

    def __init__(
        self,
        drive: Drive,
        script: Callable[[], Script[Any]],
        begun: float,
        patience: Patience,
    ) -> None:
        self.drive = drive
        self.due = begun
        self.failure: Exception | None = None
        self._begun = begun
        self._patience = patience
        self._make = script
        self.is_sent = False  # a stop has left for it
        self._sent = 0
        self._is_confirmed = False
        self._pulses: set[tuple[str, Any]] = set()
        self._has_warned = False
        self._begin()

    def _begin(self) -> None:
        script = self._script = self._make()
        self._resume: Callable[[], Step] = lambda: next(script)

    def advance(self, do: Do, now: Callable[[], float]) -> bool:
        """Carry out one step; whether the stop is over."""
        limit = self._patience.seconds
        if limit is not None and self.is_sent and now() >= self._begun + limit:
            reason = f"after {limit:g} s, all that it was given, it is not seen to have stopped"
            self.failure = self.failure or Unconfirmed(self.drive.name, "the stop", reason)
            return True
        try:
            step = self._resume()
            if isinstance(step, Wait):
                self._wait(step.seconds, now())
            else:
                self._carry_out(step, do)
        except StopIteration:
            self.failure = None
            return True
        except Exception as failure:  # the script's: it may be a user's own, and raise anything
            self.failure = failure
            return not self._goes_on(failure, now())
        return False

    def _wait(self, seconds: float, now: float) -> None:
        self.due = now + seconds
        if self._patience.seconds is not None:
            self.due = min(self.due, max(now, self._begun + self._patience.seconds))
        script = self._script
        self._resume = lambda: script.send(None)

    def _carry_out(self, step: Step, do: Do) -> None:
        script = self._script
        if isinstance(step, Pulse) and (step.register.name, step.value) in self._pulses:
            reason = "it is a pulse, and was sent once already"
            again = Unconfirmed(self.drive.name, step.register.name, reason)
            self._resume = lambda: script.throw(again)
            return
        try:
            result = do(self, step)
        except LookAgain:
            self._resume = lambda: step
        except (BusError, ValueError) as failure:
            error = failure  # outlives the except clause
            self._note(step, error)
            self._resume = lambda: script.throw(error)
        else:
            self._note(step, None)
            self._resume = lambda: script.send(result)

    def _note(self, step: Step, failure: Exception | None) -> None:
        if not isinstance(step, Write):
            return
        if not isinstance(failure, (Refused, LineError, ValueError)):
            self._sent += 1
            if isinstance(step, Pulse):
                self._pulses.add((step.register.name, step.value))
        self.is_sent |= not isinstance(failure, (Refused, LineError, DriveRefused, ValueError))
        self._is_confirmed |= failure is None

    def _goes_on(self, failure: Exception, now: float) -> bool:
        limit = LEAST_S if self._patience.seconds is None else self._patience.seconds
        if not isinstance(failure, self._patience.worth_repeating) or now >= self._begun + limit:
            return False
        if not self._has_warned:
            self._has_warned = True
            log = logging.getLogger("multidrop")
            log.warning("the stop is repeated for %g s at least: %s", limit, failure)
        self._begin()
        self.due = now + PAUSE_S
        return True

    def once_more(self, do: Do) -> None:
        """Send it again, and look at nothing: whoever waited for it was interrupted."""
        self._begin()
        with suppress(Exception):  # its end, too
            for _ in range(MOST_STEPS):
                step = self._resume()
                if not isinstance(step, Write):
                    return
                self._carry_out(step, do)

    @property
    def known(self) -> Exception | None:
        """What its failure says of the stop; None where the motor is seen to stand."""
        failure = self.failure
        if failure is None or isinstance(failure, (Unsupported, Refused)):
            return failure
        if self._is_confirmed and not isinstance(failure, Unconfirmed):
            reason = f"it was confirmed, but its effect could not be seen: {failure}"
        elif self.is_sent and not self._is_confirmed:
            reason = f"sent {self._sent} times, it was never confirmed: {failure}"
        else:
            return failure
        unknown = Unconfirmed(self.drive.name, "the stop", reason)
        unknown.__cause__ = failure
        return unknown

    def told(self, now: float) -> Stopped:
        """What is known of it, in words."""
        known, seconds = self.known, now - self._begun
        if known is None:
            return Stopped(self.drive.name, Seen.STOPPED, seconds)
        seen = Seen.SENT if self.is_sent and not isinstance(known, Unsupported) else Seen.FAILED
        why = str(known) if isinstance(known, (BusError, ValueError)) else f"{type(known).__name__}: {known}"
        return Stopped(self.drive.name, seen, seconds, why)

    def interrupted(self) -> str:
        """What is known of it when nobody waits for it any more."""
        times = f"the stop was sent {self._sent} times" if self._sent else "no stop was sent"
        return f"{self.drive.name}: {times}; the motor is not seen to stand"


def stop_together(
    stops: Sequence[Stopping],
    do: Do,
    now: Callable[[], float],
    sleep: Callable[[float], None],
    over: Callable[[Stopping], None] = lambda stop: None,
) -> None:
    """Carry the stops out, a step of each in turn; `over` is told of each at its end.

    Whoever interrupts this has each that is not over sent once more, unless that is interrupted too.
    """
    under_way = list(stops)
    try:
        while under_way:
            stop = min(under_way, key=lambda stop: stop.due)  # the one that is due for longest
            under_way.remove(stop)
            under_way.append(stop)
            sleep(max(0.0, stop.due - now()))
            if stop.advance(do, now):
                under_way.remove(stop)
                over(stop)
    except BaseException as interruption:
        send_once_more(under_way, do, interruption)
        raise


def send_once_more(stops: Iterable[Stopping], do: Do, interruption: BaseException) -> None:
    """Send these again, and note in the interruption what is known of them."""
    for stop in stops:
        try:
            stop.once_more(do)
        finally:
            interruption.add_note(stop.interrupted())
