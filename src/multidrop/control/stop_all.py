"""Stopper: stops drives, one or all of a bus, until each is seen to stand.

Of several the stops take turns, so none waits for another's ramp.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from decimal import Decimal
from functools import partial
from math import inf
from numbers import Real
from typing import Any

from multidrop.control.latches import Latches
from multidrop.control.outcome import Outcome, Stopped
from multidrop.control.stop_attempt import LEAST_S, NO_ROOM, PAUSE_S, Do, StopAttempt
from multidrop.control.writer import Writer
from multidrop.drive.family import Drive
from multidrop.drive.script import Read, Script, Step, Write
from multidrop.errors import CheckAgain
from multidrop.transport import clock
from multidrop.transport.aside_log import log_aside
from multidrop.transport.exchange import WRITE_TIMEOUT, Exchanges

REGAIN_NS = 500_000_000  # between attempts of stops to open a port that was lost
BEGINNINGS = 150  # of a stop for which the system has no room

_log = logging.getLogger("multidrop.control")


class Stopper:
    """Stops the drives of one bus.

    `is_tended`: a poller opens a lost port again, and a stop waits for that; else the stop does it itself.
    """

    def __init__(self, exchanges: Exchanges, writer: Writer, latches: Latches) -> None:
        self.is_tended = False
        self._regain_ns = 0  # not before then
        self._exchanges = exchanges
        self._writer = writer
        self._latches = latches
        self._stops: set[StopAttempt] = set()  # under way

    def so_far(self) -> dict[str, str]:
        """Return what is known of each drive's stop under way, by name; of several, the one sent most."""
        stops = sorted(self._stops.copy(), key=lambda stop: stop.times_sent)
        return {stop.drive.name: stop.so_far() for stop in stops}

    def stop(self, drive: Drive, make: Callable[[], Script[Any]], seconds: float | None) -> None:
        """Carry out a stop, again and again until the motor stands, for as long as `seconds` s.

        It is sent whatever `seconds` may be. Raises Unconfirmed when it is not seen to stand then, and says
        what is known.
        """

        def attempt() -> list[StopAttempt]:
            return [StopAttempt(drive, make, _now(), _limit(seconds))]

        (stop,) = self._carry_out([drive], attempt, lambda: False, lambda stop: None)
        _log.info("%s", stop.result(_now()))
        if stop.known is not None:
            raise stop.known

    def stop_all(
        self, drives: Sequence[Drive], broadcast: Callable[[], bool], seconds: float | None
    ) -> dict[str, Stopped]:
        """Carry out the stops of all side by side; by drive's name, what is known of each.

        `broadcast` is called before, and returns True where it has sent a stop to all of them.
        """
        found: dict[str, Stopped] = {}

        def attempts() -> list[StopAttempt]:
            begun, limit = _now(), _limit(seconds)
            return [
                StopAttempt(drive, drive.stop.script, begun, limit, partial(self._ready, drive))
                for drive in drives
            ]

        def end(stop: StopAttempt) -> None:
            found[stop.drive.name] = stop.result(_now())

        self._carry_out(drives, attempts, broadcast, end)
        for stopped in found.values():  # not before: a logger's handler may hang
            _log.info("%s", stopped)
        return found

    def _carry_out(
        self,
        drives: Sequence[Drive],
        attempts: Callable[[], list[StopAttempt]],
        broadcast: Callable[[], bool],
        end: Callable[[StopAttempt], object],
    ) -> list[StopAttempt]:
        """Make the attempts and carry them out; call `end` with each at its end, and return them.

        Where the system has no room for them yet, it may have it soon. What interrupts their making comes
        too late for nobody: each is sent once.
        """
        stops: list[StopAttempt] = []
        under_way: list[StopAttempt] = []
        for left in reversed(range(BEGINNINGS)):
            try:
                with self._under_way(drives):
                    under_way = attempts()
                    stops = [*under_way]
                    self._carry_out_known(stops, under_way, broadcast, end)
                break
            except NO_ROOM:
                if stops or not left:
                    raise
                clock.sleep(PAUSE_S)
            except (KeyboardInterrupt, SystemExit) as interruption:
                if under_way or not stops:  # none has begun
                    with self._under_way(drives):
                        send_once_more(attempts(), self._do, interruption)
                raise
        return stops

    def _carry_out_known(
        self,
        stops: Sequence[StopAttempt],
        under_way: list[StopAttempt],
        broadcast: Callable[[], bool],
        end: Callable[[StopAttempt], object],
    ) -> None:
        """Carry these out, all of which are `under_way`, and take each from there.

        At an interruption each stop that is not over is sent once more, unless a second one comes.
        """
        try:
            self._stops.update(stops)
            if broadcast():
                for stop in stops:
                    stop.note_broadcast()
            stop_together(under_way, self._do, partial(self._over, end))
        except BaseException as interruption:
            not_over = [*under_way]
            under_way.clear()
            send_once_more(not_over, self._do, interruption)
            raise
        finally:
            self._stops.difference_update(stops)

    def _over(self, end: Callable[[StopAttempt], object], stop: StopAttempt) -> None:
        self._stops.discard(stop)
        end(stop)

    @contextmanager
    def _under_way(self, drives: Sequence[Drive]) -> Iterator[None]:
        try:
            with self._latches.stopping(drives):
                yield
        finally:
            self._writer.records.catch_up()

    def _do(self, stop: StopAttempt, step: Step) -> Any:
        """Carry out a step. A stop's first write must not hold up those of others; a later one may wait."""
        self._regain()
        if isinstance(step, Read):  # once: where it is not answered the stop is sent again
            return self._exchanges.value(stop.drive, step.register, 1)
        assert isinstance(step, Write)
        return self._writer.insist(stop.drive, step, WRITE_TIMEOUT if stop.is_sent else 0.0).value

    def insist(self, drive: Drive, step: Write) -> Outcome:
        """Write what stops the motor, on a port that is opened again if it was lost."""
        self._regain()
        try:
            return self._writer.insist(drive, step)
        except CheckAgain:  # no other stop waits
            return self._writer.insist(drive, step)

    def _ready(self, drive: Drive) -> float:
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


def stop_together(under_way: list[StopAttempt], do: Do, end: Callable[[StopAttempt], object]) -> None:
    """Carry the stops out, a step of each in turn.

    Each is taken from the list at its end, and `end` is called with it.
    """
    while under_way:
        stop = min(under_way, key=_due)  # the one that is due for longest
        under_way[:] = [*(other for other in under_way if other is not stop), stop]  # never without it
        clock.sleep(max(0.0, stop.due - _now()))
        if stop.advance(do, _now):
            under_way.remove(stop)
            end(stop)


def send_once_more(stops: Sequence[StopAttempt], do: Do, interruption: BaseException) -> None:
    """Send these again, and note in the interruption, or in another one meanwhile, what is known of them."""
    latest = interruption
    try:
        for stop in stops:
            stop.once_more(do)
    except BaseException as another:
        latest = another
        raise
    finally:
        for stop in stops:
            latest.add_note(stop.interrupted())
