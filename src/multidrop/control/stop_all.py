"""Stopper: stops drives, one or all of a bus, until each is seen to stand.

Of several the stops take turns, so none waits for another's ramp.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from contextlib import suppress
from decimal import Decimal
from functools import partial
from math import inf
from numbers import Real
from typing import Any

from multidrop.control.latches import Latches
from multidrop.control.outcome import Outcome, Stopped
from multidrop.control.stop_attempt import LEAST_S, PAUSE_S, Do, StopAttempt
from multidrop.control.writer import Writer
from multidrop.drive.family import Drive
from multidrop.drive.script import Read, Script, Step, Write
from multidrop.errors import CheckAgain
from multidrop.transport import clock
from multidrop.transport.aside_log import log_aside
from multidrop.transport.exchange import WRITE_TIMEOUT, Exchanges

REGAIN_NS = 500_000_000  # between attempts of stops to open a port that was lost

_log = logging.getLogger("multidrop.control")


class StopRun:
    """Stops that were called together: all that is known of them, from their call until each is over.

    Whoever calls `carry_out` calls it again after a want of memory, and `interrupted` after anything else.
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
        self._broadcast: Callable[[], bool] | None = broadcast  # None: it was called
        self._tries = 0
        self.attempts: list[StopAttempt] = []

    def carry_out(self) -> None:
        """Carry out what is left of them, until each motor is seen to stand or its time is over."""
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
        """End what moves the drives, note the call, and make the attempts: each of these once."""
        stopper = self._stopper
        stopper.latches.begin(self, self._drives)
        if not self.attempts and self._drives:
            begun, limit = _now(), _limit(self._seconds)
            self.attempts = [
                StopAttempt(drive, partial(self._make, drive), begun, limit, partial(stopper.ready, drive))
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
        """Send each stop that is not over once more, and add to the interruption what is known of it.

        A second interruption ends this.
        """
        latest = interruption
        try:
            self._begin()
            for attempt in sorted(self._left(), key=StopAttempt.is_in_doubt):  # the one interrupted is last
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
        """Return what is known of each, by drive's name. Raises what a script raised to end the program."""
        found = {attempt.drive.name: attempt.result() for attempt in self.attempts}
        for interruption in (attempt.interruption for attempt in self.attempts):
            if interruption is not None:
                for stopped in found.values():
                    interruption.add_note(str(stopped))
                raise interruption
        return found

    def result(self) -> None:
        """Raise why the motor of one drive's stop is not seen to stand, if it is not."""
        self.found()
        for attempt in self.attempts:
            if attempt.known is not None:
                raise attempt.known


class Stopper:
    """Stops the drives of one bus.

    `is_tended`: a poller opens a lost port again, and a stop waits for that; else the stop does it itself.
    """

    def __init__(self, exchanges: Exchanges, writer: Writer, latches: Latches) -> None:
        self.is_tended = False
        self.latches = latches
        self.records = writer.records
        self.under_way: dict[StopRun, list[StopAttempt]] = {}
        self._regain_ns = 0  # not before then
        self._exchanges = exchanges
        self._writer = writer

    def so_far(self) -> dict[str, str]:
        """Return what is known of each drive's stop under way, by name; of several, the one sent most."""
        attempts = [
            each for stops in self.under_way.copy().values() for each in stops.copy() if not each.is_over
        ]
        return {each.drive.name: each.so_far() for each in sorted(attempts, key=lambda each: each.times_sent)}

    def stop(
        self, drive: Drive, verb: str, make: Callable[[], Script[Any]], seconds: float | None
    ) -> StopRun:
        """Return a stop of this drive that is repeated for `seconds` s, and sent whatever these may be."""
        return StopRun(self, verb, [drive], lambda drive: make(), seconds)

    def stop_all(
        self, drives: Sequence[Drive], broadcast: Callable[[], bool], seconds: float | None
    ) -> StopRun:
        """Return the stops of all, side by side.

        `broadcast` is called before, and returns True if it has sent a stop to all of them.
        """
        return StopRun(self, "stop", drives, lambda drive: drive.stop.script(), seconds, broadcast)

    def do(self, stop: StopAttempt, step: Step) -> Any:
        """Carry out a step. A stop's first write must not hold up those of others; a later one may wait."""
        self._regain()
        if isinstance(step, Read):  # once: where it is not answered the stop is sent again
            return self._exchanges.value(stop.drive, step.register, 1)
        assert isinstance(step, Write)
        timeout = WRITE_TIMEOUT if stop.is_sent else 0.0
        return self._writer.insist(stop.drive, step, timeout, stop.note_frame).value

    def insist(self, drive: Drive, step: Write) -> Outcome:
        """Write what stops the motor, on a port that is opened again if it was lost."""
        self._regain()
        try:
            return self._writer.insist(drive, step)
        except CheckAgain:  # no other stop waits
            return self._writer.insist(drive, step)

    def ready(self, drive: Drive) -> float:
        """Return the time before which nothing is sent to it."""
        peer = self._exchanges.peers.get(drive)
        return peer.ready_ns / 1e9 if peer else 0.0

    def _regain(self) -> None:
        line, now = self._exchanges.line, clock.now_ns()
        if not self.is_tended and line.is_lost and now >= self._regain_ns and line.may_send:
            self._regain_ns = now + REGAIN_NS
            line.regain()


def _due(stop: StopAttempt) -> float:
    """Return when its next step can be carried out: one that must wait for its drive holds up no other."""
    return max(stop.due, stop.ready())


def _now() -> float:
    return clock.now_ns() / 1e9


def _limit(seconds: float | None) -> float | None:
    """Return it as a float, which adds to a time: numpy's short ones do not, nor does a Decimal.

    What is no time keeps no stop back: it is logged, and the stop is repeated as without one.
    """
    if seconds is None:
        return None
    with suppress(Exception):  # Decimal("sNaN") does not compare, and a caller's own number may do anything
        if isinstance(seconds, (Real, Decimal)) and not isinstance(seconds, bool) and seconds >= 0:
            try:
                return float(seconds)
            except OverflowError:
                return inf
    sentence = "seconds = %.100r is no time for a stop: it is repeated for %g s at least, as without one"
    log_aside(_log, logging.WARNING, sentence, seconds, LEAST_S)
    return None


def stop_together(stops: Sequence[StopAttempt], do: Do, end: Callable[[StopAttempt], object]) -> None:
    """Carry the stops out, a step of each in turn; call `end` with each at its end, at least once."""
    waiting = [stop for stop in stops if not stop.is_over]
    while waiting:
        stop = min(waiting, key=_due)  # the one that is due for longest
        clock.sleep(max(0.0, stop.due - _now()))
        waiting.remove(stop)
        if stop.advance(do, _now):
            end(stop)
            stop.is_over = True
        else:
            waiting.append(stop)
