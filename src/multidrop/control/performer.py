"""Performer: carries out the verbs of a line's drives: until a stop comes, or until the motor stands."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from math import isnan
from typing import Any

from multidrop.control.call import Call
from multidrop.control.outcome import Outcome
from multidrop.control.stop_all import Patience, Stopped, Stopping, send_once_more, stop_together
from multidrop.control.writer import Writer
from multidrop.core import Latch
from multidrop.drive.family import Drive
from multidrop.drive.script import Insist, Read, Script, Step, Wait, Write, carry_out
from multidrop.errors import (
    BadReply,
    DriveRefused,
    LineError,
    LookAgain,
    NoReply,
    NotAttached,
    Overtaken,
    Unconfirmed,
)
from multidrop.transport.clock import now_ns, sleep
from multidrop.transport.exchange import READ_ATTEMPTS, WRITE_TIMEOUT, Exchanges

STOPPED = "a stop was called"
REMOVED = "the drive was taken off the bus"
LEFT = "the bus was left"

REGAIN_NS = 500_000_000  # between attempts of stops to open a port that was lost


class _Over(Exception):
    """A script goes on after it was told that a stop came."""


class Performer:
    """A latch for each drive, and what is under way.

    `is_tended` tells that somebody opens a lost port again: a stop waits for that, or else does it itself.
    """

    def __init__(self, exchanges: Exchanges, writer: Writer, expiry: float) -> None:
        self.is_tended = False
        self._regain_ns = 0  # not before then
        self._exchanges = exchanges
        self._writer = writer
        self._expiry = expiry
        self._latches: dict[Drive, Latch] = {}
        self._is_shut = False
        self._make_condition()

    def _make_condition(self) -> None:
        self._stops = 0  # under way
        self._over = threading.Condition()  # one of them is

    def forked(self) -> None:
        """In the child nothing is under way, and nothing is sent."""
        self._make_condition()
        self.shut()

    def add(self, drive: Drive) -> None:
        latch = self._latches[drive] = Latch()
        if self._is_shut:  # looked at afterwards: who shuts them then sees this one
            latch.shut(LEFT)

    def remove(self, drive: Drive) -> None:
        """End what moves it, and wait for the stops that are under way."""
        self._latch(drive).shut(REMOVED)
        self.await_stops()
        self._latches.pop(drive, None)

    def shut(self) -> None:
        """Send nothing any more that moves a motor. Takes no lock: a signal handler may call it."""
        self._is_shut = True
        for latch in list(self._latches.values()):
            latch.shut(LEFT)

    def await_stops(self) -> None:
        """Wait until no stop is under way."""
        with self._over:
            self._over.wait_for(lambda: not self._stops)

    def _latch(self, drive: Drive) -> Latch:
        self._exchanges.peer(drive)  # raises for one that is not on this bus
        latch = self._latches.get(drive)
        if latch is None:  # it leaves just now
            raise NotAttached(f"{drive.name} is not attached to this bus: use bus.attach(...)")
        return latch

    def rise(self, drives: Sequence[Drive]) -> None:
        """End all that moves these drives: a stop is about to be written."""
        for drive in drives:
            self._latch(drive).rise(STOPPED)

    # ---- what moves ----

    def call(self, drive: Drive, verb: str = "") -> Call:
        """What is called now, for all that is to be written because of it."""
        return Call(drive, self._latch(drive).permit(), self._expiry, verb)

    def move(self, script: Script[Any], call: Call) -> Any:
        """Carry out a verb that may move the motor: a stop ends it at whatever step it is.

        Raises Overtaken then, where nothing was sent, and Unconfirmed where something was, as `perform`.
        """
        with call.noted():
            call.check(f"the {call.verb}")
            self.check_identity(call.drive, call)
            result = self.perform(script, call)
            if not call.permit.is_good:
                what = f"the {call.verb}"
                raise self._unseen(call, Overtaken(call.drive.name, what, call.permit.latch.why))
            if call.unheard:
                with call.look():
                    outcome = self._writer.heard_since(call.drive, call.unheard)
                if outcome.failure:
                    raise outcome.failure
            return result

    def check_identity(self, drive: Drive, call: Call | None = None) -> None:
        """Look whether it is of its family; the first look also logs what the drive's watchdog does."""
        identity_check = self._writer.identity_check
        if identity_check.is_known(drive):
            return
        call = call or self.call(drive)
        identity_check.make(drive, call.look)
        with call.look():
            logging.getLogger("multidrop").info("%s: %s", drive.name, self.watchdog(drive))

    def watchdog(self, drive: Drive) -> str:
        """What becomes of the motor when this client dies, as far as the drive can say."""
        register = drive.registers.get("communication_timeout")
        if register is None or not register.readable:
            return drive.watchdog
        try:
            held = self._read(drive, Read(register))
        except DriveRefused:
            return drive.watchdog
        if held == 0:
            return f"its watchdog ({register.name}) is off: the motor runs on when the client dies"
        return f"its watchdog ({register.name}) acts {register.format(held)} after the last message"

    def perform(self, script: Script[Any], call: Call) -> Any:
        """Carry out a script's steps.

        What fails to be read after something was written is Unconfirmed: NoReply would say that nothing
        was, and DriveRefused that the drive did not do it.
        """
        unseen: list[Exception] = []  # why something was not read
        overtaken: list[Overtaken] = []

        def do(step: Step) -> Any:
            try:
                self._check(step, call, overtaken)
                return self._do(step, call)
            except Exception as failure:
                if not isinstance(step, Write):
                    unseen.append(failure)
                raise

        try:
            return carry_out(script, do)
        except (NoReply, BadReply, DriveRefused, LineError, NotAttached, Overtaken, _Over) as failure:
            why: Exception = overtaken[0] if isinstance(failure, _Over) else failure
            if not call.sent or why not in unseen:
                raise why from None if why is failure else failure
            raise self._unseen(call, why) from why
        finally:
            self._writer.catch_up()

    @staticmethod
    def _check(step: Step, call: Call, overtaken: list[Overtaken]) -> None:
        """End it once a stop was called: at the next write, and if it is to move a motor at any step.

        What does no harm may still be taken back.
        """
        if isinstance(step, Insist) or not (call.verb or isinstance(step, Write)) or call.permit.is_good:
            return
        if overtaken:
            raise _Over
        what = step.register.name if isinstance(step, Write) and not call.verb else f"the {call.verb}"
        overtaken.append(Overtaken(call.drive.name, what, call.permit.latch.why))
        raise overtaken[0]

    @staticmethod
    def _unseen(call: Call, why: Exception) -> Unconfirmed:
        if isinstance(why, Overtaken):
            reason = f"it was sent, and then {why.why}"
        elif call.is_confirmed:
            reason = f"it was confirmed, but its effect could not be seen: {why}"
        else:
            reason = f"it was sent, and its effect could not be seen: {why}"
        return Unconfirmed(call.drive.name, call.sent or f"the {call.verb}", reason)

    def _do(self, step: Step, call: Call) -> Any:
        drive = call.drive
        if isinstance(step, Wait):
            with call.step(step.seconds):
                return sleep(step.seconds)
        if isinstance(step, Read):
            with call.look():
                value = self._read(drive, step)
            call.unheard = None
            return value
        if isinstance(step, Insist):
            return self.insist(drive, step).value
        return self._writer.put(drive, step, call).value

    def _read(self, drive: Drive, step: Read, attempts: int = READ_ATTEMPTS) -> Any:
        return self._exchanges.values(drive, [step.register], attempts)[step.register.name]

    # ---- what stops ----

    def stop(self, drive: Drive, make: Callable[[], Script[Any]], seconds: float | None) -> None:
        """Carry out a stop, again and again until the motor stands, for as long as `seconds` s.

        Raises Unconfirmed when it is not seen to stand then, and says what is known.
        """
        patience = _patience(seconds)
        self._latch(drive)
        with self._under_way([drive]):
            stop = Stopping(drive, make, now_ns() / 1e9, patience)
            stop_together([stop], self._do_stop, lambda: now_ns() / 1e9, sleep)
        if stop.known is not None:
            raise stop.known

    def stop_all(
        self, drives: Sequence[Drive], at_once: Callable[[], bool], seconds: float | None
    ) -> dict[str, Stopped]:
        """Carry out the stops of all side by side; by drive's name, what is known of each.

        `at_once` is called before, and says whether that has sent a stop to all of them.
        """
        patience = _patience(seconds)
        found: dict[str, Stopped] = {}
        with self._under_way(drives):
            begun = now_ns() / 1e9
            stops = [Stopping(drive, drive.stop.script, begun, patience) for drive in drives]
            try:
                sent = at_once()
            except BaseException as interruption:
                send_once_more(stops, self._do_stop, interruption)
                raise
            for stop in stops:
                stop.is_sent = sent

            def over(stop: Stopping) -> None:
                found[stop.drive.name] = stop.told(now_ns() / 1e9)

            stop_together(stops, self._do_stop, lambda: now_ns() / 1e9, sleep, over)
        return found

    @contextmanager
    def _under_way(self, drives: Sequence[Drive]) -> Iterator[None]:
        """Nothing that moves these drives begins or goes on meanwhile, and none of them leaves."""
        with self._over:
            self._stops += 1
        try:
            latches = [latch for drive in drives if (latch := self._latches.get(drive))]
            for latch in latches:  # all of them before anything else
                latch.rise(STOPPED)
            with ExitStack() as stack:
                for latch in latches:
                    stack.enter_context(latch.held(STOPPED))
                yield
        finally:
            with self._over:
                self._stops -= 1
                self._over.notify_all()
            self._writer.catch_up()

    def _do_stop(self, stop: Stopping, step: Step) -> Any:
        """The first stop must not hold up those of others; one that was sent may wait for a late answer."""
        self._regain()
        if isinstance(step, Read):  # asked once: what is not answered has the stop sent again
            return self._read(stop.drive, step, 1)
        assert isinstance(step, Write)
        return self._writer.insist(stop.drive, step, WRITE_TIMEOUT if stop.is_sent else 0.0).value

    def insist(self, drive: Drive, step: Write) -> Outcome:
        """Write what stops the motor, on a port that is opened again if it was lost."""
        self._regain()
        try:
            return self._writer.insist(drive, step)
        except LookAgain:  # nobody else waits
            return self._writer.insist(drive, step)

    def _regain(self) -> None:
        line, now = self._exchanges.line, now_ns()
        if not self.is_tended and line.is_lost and now >= self._regain_ns:
            self._regain_ns = now + REGAIN_NS
            line.regain()


def _patience(seconds: float | None) -> Patience:
    if seconds is not None and (isinstance(seconds, bool) or isnan(seconds) or seconds < 0):
        raise ValueError(f"seconds = {seconds!r} is no time that a stop may take: give 0 or more, or none")
    return Patience(seconds)
