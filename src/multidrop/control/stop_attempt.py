"""StopAttempt: one drive's stop, repeated until it is confirmed and the motor is seen to stand."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from multidrop.control.outcome import Seen, Stopped
from multidrop.core import Message
from multidrop.drive.family import Drive
from multidrop.drive.script import Pulse, Read, Script, Step, Wait, Write
from multidrop.errors import (
    BadReply,
    BusError,
    CheckAgain,
    DriveException,
    LineError,
    NoReply,
    NotMaster,
    NotVerified,
    PortLost,
    Unconfirmed,
    Unsupported,
    WriteForbidden,
)
from multidrop.transport.aside_log import log_aside

LEAST_S = 30.0  # for which a stop is repeated where its caller gives no time
PAUSE_S = 0.2  # before it is repeated
AT_ONCE = 8  # steps without a good answer, after which the line is shared with polling
SHARE = 1.5  # time left to polling after such a step, in units of the step's own time
MOST_STEPS = 8  # that are sent once more after an interruption
UNSENT = (WriteForbidden, LineError, NotMaster, ValueError)
WORTH_REPEATING = (Unconfirmed, NotVerified, NoReply, BadReply, DriveException, PortLost, NotMaster)
UNANSWERED = (Unconfirmed, NoReply, BadReply)
NO_ROOM = (MemoryError, OSError)  # what the system may have again soon, such as memory and descriptors

_log = logging.getLogger("multidrop.control")

Do = Callable[["StopAttempt", Step], Any]


class StopAttempt:
    """One drive's stop under way; its `failure`, None while all is well.

    It is repeated for `seconds`; without that for LEAST_S at least, and an attempt that has begun by then
    may take its time, which is the ramp's. After AT_ONCE steps without a good answer it leaves more than
    half of its line's time to others. `ready` returns the time before which nothing is sent to it.
    """

    def __init__(
        self,
        drive: Drive,
        script: Callable[[], Script[Any]],
        begun: float,
        seconds: float | None,
        ready: Callable[[], float] = lambda: 0.0,
    ) -> None:
        self.drive = drive
        self.ready = ready
        self.due = begun
        self.failure: Exception | None = None
        self.is_sent = False  # a stop has left for it
        self._begun = begun
        self._seconds = seconds
        self._make = script
        self.times_sent = 0  # those that the drive refused too
        self._unanswered = 0  # steps without a good answer
        self.is_over = False
        self.ended = begun  # when it was over
        self.interruption: BaseException | None = None  # raised by the script, to end the program
        self.frame: Message | None = None  # the latest that was sent
        self._times_in_doubt = 0  # those that an interruption, or the system, may have kept back
        self._is_confirmed = False
        self._pulses: set[tuple[str, Any]] = set()
        self._has_warned = False
        self._begin()

    def _begin(self) -> None:
        returned: list[bool] = []
        script = self._script = _noting_return(self._make, returned)
        self._has_returned = returned
        self._resume: Callable[[], Step] = lambda: next(script)

    def note_frame(self, drive: Drive, request: Message, *outcome: object) -> None:
        """Note the newest frame of it, for its record."""
        self.frame = request

    def note_broadcast(self) -> None:
        """Note that the stop was broadcast: it was sent, and nobody confirms it."""
        self.is_sent = True
        self.times_sent += 1

    def advance(self, do: Do, now: Callable[[], float]) -> bool:
        """Carry out one step; True when the stop is over."""
        limit = self._seconds
        if limit is not None and self.is_sent and now() >= self._begun + limit:
            reason = f"after {limit:g} s, all that it was given, it is not seen to have stopped"
            self.failure = self.failure or Unconfirmed(self.drive.name, "the stop", reason)
            return True
        try:
            step = self._next_step()
            if isinstance(step, Wait):
                self._wait(step.seconds, now())
            else:
                begun = now()
                is_answered = self._carry_out(step, do)
                self.due = max(self.due, now())  # behind all that have waited meanwhile
                if not is_answered:
                    self._share_line(begun, now())
        except StopIteration:
            self.failure = None
            return True
        except Exception as failure:  # the script's: it may be a user's own, and raise anything
            self.failure = failure
            return not self._goes_on(failure, now())
        return False

    def _next_step(self) -> Step:
        """Go on with the script. What it raises to end the program is kept until all stops are over."""
        try:
            return self._resume()
        except StopIteration:
            if self._has_returned:
                raise
            reason = "it was broken off"
        except Exception:
            raise
        except BaseException as interruption:
            self.interruption = interruption
            reason = f"its script raised {type(interruption).__name__}"
        raise Unconfirmed(self.drive.name, "the stop", reason)

    def _wait(self, seconds: float, now: float) -> None:
        self.due = now + seconds
        if self._seconds is not None:
            self.due = min(self.due, max(now, self._begun + self._seconds))
        script = self._script
        self._resume = lambda: script.send(None)

    def _share_line(self, begun: float, now: float) -> None:
        """Delay the next step after one without a good answer, unless that ends the stop's own time."""
        self._unanswered += 1
        limit = LEAST_S if self._seconds is None else self._seconds
        due = now + SHARE * (now - begun)
        if self._unanswered > AT_ONCE and due < self._begun + limit:
            self.due = due

    def _carry_out(self, step: Step, do: Do) -> bool:
        """Carry out a step, and resume the script with its result; False if no good answer came."""
        script = self._script
        if isinstance(step, Pulse) and (step.register.name, step.value) in self._pulses:
            reason = "it is a pulse, and was sent once already"
            self._raise_in_script(Unconfirmed(self.drive.name, step.register.name, reason))
            return True
        try:
            result = do(self, step)
        except CheckAgain:
            self._resume = lambda: step
        except (BusError, ValueError) as failure:
            self._note(step, failure)
            self._raise_in_script(failure)
            return not isinstance(failure, UNANSWERED)
        except BaseException:
            self._times_in_doubt += isinstance(step, Write)
            raise
        else:
            self._note(step, None)
            self._resume = lambda: script.send(result)
        return True

    def _note(self, step: Step, failure: Exception | None) -> None:
        if not isinstance(step, Write):
            return
        if not isinstance(failure, UNSENT):
            self.times_sent += 1
            if isinstance(step, Pulse):
                self._pulses.add((step.register.name, step.value))
        self.is_sent |= not isinstance(failure, (*UNSENT, DriveException))
        self._is_confirmed |= failure is None

    def _goes_on(self, failure: Exception, now: float) -> bool:
        limit = LEAST_S if self._seconds is None else self._seconds
        if isinstance(failure, NotMaster) and not failure.heard:
            self._tell_unsent(failure)
            return False
        if not _is_worth_repeating(failure) or now >= self._begun + limit:
            return False
        if not self._has_warned:
            self._has_warned = True
            log_aside(_log, logging.WARNING, "the stop is repeated for %g s at least: %s", limit, failure)
        self._begin()
        self.due = now + PAUSE_S
        return True

    def _tell_unsent(self, failure: NotMaster) -> None:
        """Log it at once, as critical: no other process stops this motor by itself."""
        if not self.is_sent:
            log_aside(_log, logging.CRITICAL, "%s", failure.of_a_stop())

    def once_more(self, do: Do) -> None:
        """Send the stop again, and wait for nothing: its caller was interrupted.

        What is looked at before it is sent is read; a look after it fails, as one that nobody answers.
        """
        self._begin()
        is_written = False
        with suppress(Exception):  # its end, too
            for _ in range(MOST_STEPS):
                step = self._next_step()
                if isinstance(step, Wait):
                    return
                if isinstance(step, Read) and is_written:
                    self._raise_in_script(NoReply(self.drive.name))
                else:
                    is_written |= isinstance(step, Write)
                    self._carry_out(step, do)

    def _raise_in_script(self, failure: Exception) -> None:
        script = self._script
        self._resume = lambda: script.throw(failure)

    @property
    def known(self) -> Exception | None:
        """The failure of the whole stop; None where the motor is seen to stand."""
        failure = self.failure
        if failure is None or isinstance(failure, (Unsupported, WriteForbidden)):
            return failure
        if self._is_confirmed and not isinstance(failure, Unconfirmed):
            reason = f"it was confirmed, but its effect could not be seen: {failure}"
        elif self.is_sent and not self._is_confirmed:
            reason = f"sent {self._times()} times, it was never confirmed: {failure}"
        else:
            return failure
        unknown = Unconfirmed(self.drive.name, "the stop", reason)
        unknown.__cause__ = failure
        return unknown

    def result(self) -> Stopped:
        """Return what is known of it at its end."""
        known, seconds = self.known, self.ended - self._begun
        if known is None:
            return Stopped(self.drive.name, Seen.STOPPED, seconds)
        if isinstance(known, Unsupported) or not (self.is_sent or self.times_sent):
            seen = Seen.FAILED
        else:
            seen = Seen.SENT if self.is_sent else Seen.REFUSED
        why = str(known) if isinstance(known, (BusError, ValueError)) else f"{type(known).__name__}: {known}"
        return Stopped(self.drive.name, seen, seconds, why)

    def so_far(self) -> str:
        """Return the progress of a stop under way; the text stays the same until something changes."""
        why = f": {self.failure}" if self.failure else ""
        if self._is_confirmed:
            return f"{self.drive.name}: the stop was confirmed, and the motor is not seen to stand yet{why}"
        if self.is_sent or self.times_sent:
            return f"{self.drive.name}: the stop was sent, and is not confirmed yet{why}"
        return f"{self.drive.name}: no stop was sent yet{why}"

    def _times(self) -> str:
        least, most = self.times_sent, self.times_sent + self._times_in_doubt
        return f"{least}" if least == most else f"{least} to {most}"

    def is_in_doubt(self) -> bool:
        """Return True if nobody knows of some of its frames whether they were sent."""
        return self._times_in_doubt > 0

    def break_off(self) -> str:
        """Note that its caller no longer waits, and return what is known of it."""
        self.is_sent |= self._times_in_doubt > 0
        if self.failure is None:
            self.failure = Unconfirmed(self.drive.name, "the stop", "its caller was interrupted")
        is_sent = self.times_sent or self._times_in_doubt
        sent = f"the stop was sent {self._times()} times" if is_sent else "no stop was sent"
        return f"{self.drive.name}: {sent}; the motor is not seen to stand"


def _noting_return(make: Callable[[], Script[Any]], returned: list[bool]) -> Script[None]:
    """Carry out a script, and note that it returned: a signal or a want of memory may end it too."""
    yield from make()
    returned.append(True)


def _is_worth_repeating(failure: Exception) -> bool:
    is_the_system_s = isinstance(failure, NO_ROOM) and not isinstance(failure, BusError)
    return is_the_system_s or isinstance(failure, WORTH_REPEATING)
