"""Stopper: stop one drive or all drives of a bus, and repeat each stop until the motor is seen at rest.

Several stops take turns step by step, so that no stop waits for another motor's ramp.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from math import inf
from numbers import Real
from typing import Any, TypeVar

from multidrop.control.call import Latches
from multidrop.control.outcome import UNSEEN, Outcome, Seen, Stopped, result_of_stop
from multidrop.control.writer import Checked, Writer
from multidrop.core import Message, Peer
from multidrop.drive.family import Drive
from multidrop.drive.verbs import CommandResult, Pulse, Read, Script, Step, Wait, Write
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
from multidrop.transport import clock
from multidrop.transport.aside_log import log_aside
from multidrop.transport.exchange import WRITE_TIMEOUT, Exchanges

LEAST_S = 30.0  # s; how long a stop is repeated by default
PAUSE_S = 0.2  # s; pause before a stop is repeated
LOOK_S = 0.002  # s; pause between checks whether a poller has reopened a lost port
AT_ONCE = 8  # after this many steps without a good reply, a stop shares the line with polling
FIRST_PART = 0.25  # part of a silent drive's timeout for which first stops of silent drives give way
SHARE = 1.5  # polling then gets the line for this many times the duration of the stop's last step
MOST_STEPS = 8  # limit of script steps when an interrupted stop is sent once more
UNSENT = (WriteForbidden, LineError, NotMaster, ValueError)
WORTH_REPEATING = (Unconfirmed, NotVerified, NoReply, BadReply, DriveException, PortLost, NotMaster)
UNANSWERED = (Unconfirmed, NoReply, BadReply)
NO_ROOM = (MemoryError, OSError)  # stops are retried: the system may soon have memory or descriptors again
REGAIN_NS = 500_000_000  # interval between a failed attempt to reopen a lost port and the next one

_log = logging.getLogger("multidrop.control")
R = TypeVar("R")
Do = Callable[["StopAttempt", Step], Any]


class StopAttempt:
    """One drive's stop, repeated until the drive confirms it and the motor is seen to stop.

    The stop is repeated for `seconds`. If `seconds` is None, no repetition starts after LEAST_S, and the last
    one may take as long as the motor's ramp. After AT_ONCE steps without a good reply, the stop leaves more
    than half of the line's time to other requests.
    """

    def __init__(
        self,
        drive: Drive,
        script: Callable[[], Script[Any]],
        begun: float,
        seconds: float | None,
        peers: Mapping[Drive, Peer],
    ) -> None:
        self.drive = drive
        self._peers = peers  # the core's records of the drives that are attached
        self.due = begun
        self.failure: Exception | None = None
        self.is_sent = False  # whether a stop was sent that the drive did not refuse
        self._begun = begun
        self._seconds = seconds
        self._make = script
        self.times_sent = 0  # number of stops sent, including those that the drive refused
        self._unanswered = 0  # number of steps without a good reply
        self._is_answered = False  # whether the drive has answered the latest write
        self.miss = (begun, begun)  # start and end in s of the latest timeout, if this stop gives way then
        self.is_over = False
        self.ended = begun  # time in s at which the attempt ended
        self.interruption: BaseException | None = None  # raised by the script; kept until all stops are over
        self.frame: Message | None = None  # the newest request of this stop
        self._times_in_doubt = 0  # number of frames that may or may not have been sent
        self._is_confirmed = False
        self._is_read = False  # whether the drive has answered a read since the last write
        self._pulses: set[tuple[str, Any]] = set()
        self._has_warned = False
        self.doubt = ""  # why the drive may be of another family
        self.checked: Checked = set()
        self._shows_more_than_zeros = True  # False if all reads since the last write returned 0
        self._begin()

    def _begin(self) -> None:
        returned: list[bool] = []
        script = self._script = _noting_return(self._make, returned)
        self._has_returned = returned
        self._resume: Callable[[], Step] = lambda: next(script)

    def note_frame(self, drive: Drive, request: Message, *outcome: object) -> None:
        """Keep the newest request for the audit record."""
        self.frame = request

    def note_broadcast(self) -> None:
        """Note that the stop was broadcast: sent, but not confirmed by the drive."""
        self.is_sent = True
        self.times_sent += 1

    def advance(self, do: Do, now: Callable[[], float]) -> bool:
        """Carry out one step; return True if the stop is over."""
        limit = self._seconds
        # a broadcast alone does not end the stop: the drive may not have received it
        is_tried = self.is_sent and self.frame is not None
        if limit is not None and is_tried and now() >= self._begun + limit:
            reason = f"the motor was not seen to stop within {limit:g} s"
            self.failure = self.failure or Unconfirmed(self.drive.name, "the stop", reason)
            return True
        try:
            step = self._next_step()
            if isinstance(step, Wait):
                self._wait(step.seconds, now())
            else:
                begun = now()
                is_answered = self._carry_out(step, do)
                # Without this, the next step could go ahead of stops that have waited longer.
                self.due = max(self.due, now())
                if not is_answered:
                    self._share_line(begun, now())
        except StopIteration:
            if self._is_confirmed or self._is_read:
                self.failure = self._unproven()
                return True
            reason = "its script ended, although the drive has confirmed no write and answered no read"
            self.failure = Unconfirmed(self.drive.name, "the stop", reason)
            return not self._goes_on(self.failure, now())
        except Exception as failure:  # a user's own script may raise anything
            self.failure = failure
            return not self._goes_on(failure, now())
        return False

    def _unproven(self) -> Unconfirmed | None:
        """Return Unconfirmed if the drive may be of another make and all reads returned 0; else None."""
        if not self.doubt or self._shows_more_than_zeros:
            return None
        reason = (
            f"it was sent, but {self.doubt}. All registers read 0, which may be a motor at rest or another "
            "maker's drive: look at the motor"
        )
        return Unconfirmed(self.drive.name, "the stop", reason)

    def _next_step(self) -> Step:
        """Resume the script; return its next step.

        If the script raises SystemExit or the like, raise Unconfirmed instead. The script's exception is kept
        until all stops are over.
        """
        try:
            return self._resume()
        except StopIteration:
            if self._has_returned:
                raise
            reason = "its script was interrupted"
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
        """After a step without a good reply, leave the line to other requests before the next step.

        After AT_ONCE such steps, delay the next step, but not beyond the time limit of the stop.
        """
        self._unanswered += 1
        if self.part_given_way():
            self.miss = (begun, now)
        limit = LEAST_S if self._seconds is None else self._seconds
        due = now + SHARE * (now - begun)
        if self._unanswered > AT_ONCE and due < self._begun + limit:
            self.due = due

    def part_given_way(self) -> float:
        """Return for which part of a timeout this stop gives way; 0 unless the drive is silent."""
        peer = self._peers.get(self.drive)
        is_deaf = not self._is_answered or self._unanswered > AT_ONCE  # some drives answer only writes
        return (1.0 if self.frame else FIRST_PART) if is_deaf and peer and peer.failures else 0.0

    def next_at(self) -> float:
        """Return the time (in s) of the next step, including the pause that the drive needs."""
        peer = self._peers.get(self.drive)
        return max(self.due, peer.ready_ns / 1e9) if peer else self.due

    def _carry_out(self, step: Step, do: Do) -> bool:
        """Carry out a step, and pass its result to the script; return False if there was no good reply."""
        script = self._script
        if isinstance(step, Pulse) and (step.register.name, step.value) in self._pulses:
            reason = "it is a pulse that was already sent once"
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
            if isinstance(step, Read):
                self._is_read = True
                self._shows_more_than_zeros |= result != 0
            self._resume = lambda: script.send(result)
        return True

    def _note(self, step: Step, failure: Exception | None) -> None:
        if not isinstance(step, Write):
            return
        self._shows_more_than_zeros = self._is_read = False
        self._is_answered = not isinstance(failure, UNANSWERED)
        if not isinstance(failure, UNSENT):
            self.times_sent += 1
            if isinstance(step, Pulse):
                self._pulses.add((step.register.name, step.value))
        self.is_sent |= not isinstance(failure, (*UNSENT, DriveException))
        self._is_confirmed |= failure is None

    def _goes_on(self, failure: Exception, now: float) -> bool:
        limit = LEAST_S if self._seconds is None else self._seconds
        if isinstance(failure, NotMaster) and not failure.heard:
            if not self.is_sent:  # no other process will stop the motor
                log_aside(_log, logging.CRITICAL, "%s", failure.of_a_stop())
            return False
        if not _is_worth_repeating(failure) or now >= self._begun + limit:
            return False
        if not self._has_warned:
            self._has_warned = True
            log_aside(_log, logging.WARNING, "the stop is repeated for %g s at least: %s", limit, failure)
        self._begin()
        self.due = now + PAUSE_S
        return True

    def once_more(self, do: Do) -> None:
        """Send the stop again without waits, because its caller was interrupted.

        Reads before the script's first write are carried out; for later reads the script gets NoReply.
        """
        self._begin()
        is_written = False
        with suppress(Exception):  # any failure, or StopIteration at the script's end
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
        """Return the failure of the whole stop; None if the motor was seen to stop."""
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
        known, seconds = self.known, self.ended - self._begun
        if known is None:
            return Stopped(self.drive.name, Seen.STOPPED, seconds, "" if self._is_read else UNSEEN)
        if isinstance(known, Unsupported) or not (self.is_sent or self.times_sent):
            seen = Seen.FAILED
        else:
            seen = Seen.SENT if self.is_sent else Seen.REFUSED
        why = str(known) if isinstance(known, (BusError, ValueError)) else f"{type(known).__name__}: {known}"
        return Stopped(self.drive.name, seen, seconds, why)

    def so_far(self) -> str:
        """Return a sentence on the stop's progress; the sentence changes only if the progress does."""
        why = f": {self.failure}" if self.failure else ""
        if self._is_confirmed:
            return f"{self.drive.name}: the stop was confirmed, but the motor is not yet seen to stand{why}"
        if self.is_sent or self.times_sent:
            return f"{self.drive.name}: the stop was sent, but is not yet confirmed{why}"
        return f"{self.drive.name}: no stop was sent yet{why}"

    def _times(self) -> str:
        least, most = self.times_sent, self.times_sent + self._times_in_doubt
        return f"{least}" if least == most else f"{least} to {most}"

    def is_in_doubt(self) -> bool:
        """Return True if it is unknown whether some of the stop's frames were sent."""
        return self._times_in_doubt > 0

    def break_off(self) -> str:
        """End the stop because its caller was interrupted; return a sentence on its progress."""
        self.is_sent |= self._times_in_doubt > 0
        if self.failure is None:
            self.failure = Unconfirmed(self.drive.name, "the stop", "its caller was interrupted")
        is_sent = self.times_sent or self._times_in_doubt
        sent = f"the stop was sent {self._times()} times" if is_sent else "no stop was sent"
        return f"{self.drive.name}: {sent}; the motor is not seen to stand"


def _noting_return(make: Callable[[], Script[Any]], returned: list[bool]) -> Script[None]:
    """Carry out a script; then append to `returned`, to show that no signal or MemoryError ended it."""
    yield from make()
    returned.append(True)


def _is_worth_repeating(failure: Exception) -> bool:
    is_of_the_system = isinstance(failure, NO_ROOM) and not isinstance(failure, BusError)
    return is_of_the_system or isinstance(failure, WORTH_REPEATING)


class StopRun:
    """Stops one or several drives for one call, such as `stop_all`.

    The caller repeats `carry_out` after MemoryError or OSError, and calls `interrupted` after other failures.
    """

    def __init__(
        self,
        stopper: Stopper,
        verb: str,
        drives: Sequence[Drive],
        make: Callable[[Drive], Script[Any]],
        seconds: float | None,
        broadcast: Callable[[], bool] = lambda: False,
    ) -> None:
        self._stopper = stopper
        self._verb = verb
        self._drives = drives
        self._make = make
        self._seconds = seconds
        self._broadcast: Callable[[], bool] | None = broadcast  # sends a broadcast stop; None once called
        self._tries = 0
        self.attempts: list[StopAttempt] = []

    def carry_out(self) -> None:
        """Carry out the unfinished stops, until each motor is seen to stop or the time for it is over."""
        self._tries += 1
        if self._tries > 1:
            clock.sleep(PAUSE_S)
        self._begin()
        if (broadcast := self._broadcast) is not None:
            self._broadcast = None
            if broadcast():
                for attempt in self.attempts:
                    attempt.note_broadcast()
        stop_together(self.attempts, self._stopper.do, self._end)
        self._release()

    def _begin(self) -> None:
        """Cancel all calls that move these drives.

        The first time, also create a StopAttempt for each drive, and record that a stop was called.
        """
        stopper = self._stopper
        stopper.latches.begin(self, self._drives)
        if not self.attempts and self._drives:
            begun, limit = _now(), _limit(self._seconds)
            self.attempts = [
                StopAttempt(drive, partial(self._make, drive), begun, limit, stopper.peers)
                for drive in self._drives
            ]
            stopper.records.note_stops_called(self._verb, self._drives)
        stopper.under_way[self] = self.attempts

    def _end(self, attempt: StopAttempt) -> None:
        attempt.ended = _now()
        records, drive = self._stopper.records, attempt.drive
        records.note_stop_ended(self._verb, drive, attempt.result(), attempt.times_sent, attempt.frame)

    def _release(self) -> None:
        self._stopper.under_way.pop(self, None)
        self._stopper.latches.over(self)

    def interrupted(self, interruption: BaseException) -> None:
        """Send each unfinished stop again, once, and add a note on its progress to the interruption.

        A second interruption, such as Ctrl-C, ends this method; the notes are then added to that exception.
        """
        latest = interruption
        try:
            self._begin()
            # stops whose frames were certainly not sent come first
            for attempt in sorted(self._left(), key=StopAttempt.is_in_doubt):
                attempt.once_more(self._stopper.do)
        except BaseException as another:
            latest = another
            raise
        finally:
            for attempt in self._left():
                latest.add_note(attempt.break_off())
                self._end(attempt)
            self._release()

    def _left(self) -> list[StopAttempt]:
        return [attempt for attempt in self.attempts if not attempt.is_over]

    def found(self) -> dict[str, Stopped]:
        """Return the results by drive. Raises SystemExit or the like if a script raised it."""
        found = {attempt.drive.name: attempt.result() for attempt in self.attempts}
        for interruption in (attempt.interruption for attempt in self.attempts):
            if interruption is not None:
                for stopped in found.values():
                    interruption.add_note(str(stopped))
                raise interruption
        return found

    def result(self) -> CommandResult:
        """Return the result of one drive's stop. Raises the failure if the motor was not seen to stop."""
        (stopped,) = self.found().values()
        if (failure := self.attempts[0].known) is not None:
            raise failure
        return result_of_stop(stopped)


class Stopper:
    """Stops the drives of one bus.

    While `is_reopening` is set, a poller is opening a lost port, and stops do not open it themselves.
    """

    def __init__(self, exchanges: Exchanges, writer: Writer, latches: Latches) -> None:
        self.is_reopening = False
        self.latches = latches
        self.records = writer.records
        self.under_way: dict[StopRun, list[StopAttempt]] = {}
        self._regain_ns = 0  # earliest time of the next attempt to reopen the port
        self.peers = exchanges.peers.present
        self._exchanges = exchanges
        self._writer = writer

    def so_far(self) -> dict[str, str]:
        """Return the progress of the unfinished stops, by drive.

        For a drive with several stops, return the progress of the stop that was sent most often.
        """
        attempts = [
            each for stops in self.under_way.copy().values() for each in stops.copy() if not each.is_over
        ]
        return {each.drive.name: each.so_far() for each in sorted(attempts, key=lambda each: each.times_sent)}

    def stop(
        self, drive: Drive, verb: str, make: Callable[[], Script[Any]], seconds: float | None
    ) -> StopRun:
        """Return a new stop of this drive, not started yet, that will be repeated for `seconds`."""
        return StopRun(self, verb, [drive], lambda drive: make(), seconds)

    def stop_all(
        self, drives: Sequence[Drive], broadcast: Callable[[], bool], seconds: float | None
    ) -> StopRun:
        """Return new stops of all these drives, not started yet.

        `broadcast` is called before them, and returns True if it may have sent a stop to all the drives.
        """
        return StopRun(self, "stop", drives, lambda drive: drive.stop.script(), seconds, broadcast)

    def do(self, stop: StopAttempt, step: Step) -> Any:
        """Carry out a step of a stop. The first write never waits for a late reply; later writes may."""
        return self._on_open_port(lambda: self._carry_out(stop, step))

    def _carry_out(self, stop: StopAttempt, step: Step) -> Any:
        if isinstance(step, Read):  # a read has one attempt: without a reply, the stop is sent again instead
            return self._exchanges.value(stop.drive, step.register, 1, is_stop_read=True)
        assert isinstance(step, Write)
        timeout = WRITE_TIMEOUT if stop.frame else 0.0  # 0 also shows the core that it is the first stop
        try:
            return self._writer.insist(stop.drive, step, stop.checked, timeout, stop.note_frame).value
        finally:
            stop.doubt = self._writer.identity_check.doubt(stop.drive)

    def insist(self, drive: Drive, step: Write) -> Outcome:
        """Send a stop, or another write that is harmless at any time; first reopen a lost port."""
        checked: Checked = set()
        write = partial(self._writer.insist, drive, step, checked)
        try:
            return self._on_open_port(write)
        # No other drives wait for their stops here, so the check is repeated at once.
        except CheckAgain:
            return self._on_open_port(write)

    def _on_open_port(self, act: Callable[[], R]) -> R:
        """Reopen a lost port and carry out `act`. If the port is lost then, do both once more.

        Some servers close the connection after each reply. A write that may have been sent raises
        Unconfirmed, and is not repeated here.
        """
        self._regain()
        try:
            return act()
        except PortLost:
            self._regain()
            return act()

    def _regain(self) -> None:
        given_up_ns = clock.now_ns() + round(PAUSE_S * 1e9)
        while self.is_reopening and clock.now_ns() < given_up_ns:  # usually takes a few milliseconds
            clock.sleep(LOOK_S)
        line, now = self._exchanges.line, clock.now_ns()
        if not self.is_reopening and line.is_lost and now >= self._regain_ns and line.may_send:
            self._regain_ns = now + REGAIN_NS
            try:
                line.regain()
            except PortLost:
                # the interval starts now, because a network may have delayed this attempt for seconds
                self._regain_ns = clock.now_ns() + REGAIN_NS
                raise
            self._regain_ns = 0


def _next(stops: Sequence[StopAttempt], now: float) -> StopAttempt:
    """Return the stop that is due first.

    After a timeout, and for as long as it took, first stops of drives that answer precede all, and then their
    reads, which would otherwise wait for the timeouts of all silent drives. The first stop of a silent drive
    gives way to reads for FIRST_PART of that time only: the drive may be back, with a running motor.
    """
    due = [stop for stop in stops if stop.next_at() <= now]
    begun, ended = max(stop.miss for stop in stops)
    due = [stop for stop in due if now >= ended + stop.part_given_way() * (ended - begun)] or due
    if now < ended + (ended - begun):
        due = [stop for stop in due if not (stop.frame or stop.part_given_way())] or due
    return min(due or stops, key=lambda stop: stop.next_at())


def _now() -> float:
    return clock.now_ns() / 1e9


def _limit(seconds: float | None) -> float | None:
    """Return a stop's time limit as a float; None, with a warning, if it is invalid.

    None does not limit the stop, so an invalid limit does not prevent it.
    """
    if seconds is None:
        return None
    if isinstance(seconds, Real) and not isinstance(seconds, bool):
        try:
            limit = float(seconds)
        except OverflowError:
            limit = inf if seconds > 0 else -inf
        if limit >= 0:
            return limit
    sentence = (
        "seconds = %.100r is not a time for a stop: the stop is repeated for at least %g s, as without this "
        "argument"
    )
    log_aside(_log, logging.WARNING, sentence, seconds, LEAST_S)
    return None


def stop_together(stops: Sequence[StopAttempt], do: Do, end: Callable[[StopAttempt], object]) -> None:
    """Carry out the steps of all stops as they become due; call `end(stop)` after the last step of a stop.

    An interruption by a signal may cause a second call of `end` for the same stop.
    """
    waiting = [stop for stop in stops if not stop.is_over]
    while waiting:
        stop = _next(waiting, _now())
        clock.sleep(max(0.0, stop.due - _now()))
        waiting.remove(stop)
        if stop.advance(do, _now):
            end(stop)
            stop.is_over = True
        else:
            waiting.append(stop)
