"""Carry out plain writes, verbs and broadcasts on a line's drives, until a stop is called."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Any, cast

from multidrop.control.call import MOST_EXPIRY_S, Call, Latches, check_expiry, present_limit_ns
from multidrop.control.exit_hook import await_signal
from multidrop.control.outcome import Outcome
from multidrop.control.records import check_author
from multidrop.control.rules import check_broadcast, check_plain, is_harmless, is_stop, raw_count
from multidrop.control.stops import Stopper
from multidrop.control.writer import Writer
from multidrop.core import Framing, Message
from multidrop.drive.family import Drive
from multidrop.drive.link import check_own, check_own_text
from multidrop.drive.register import Register
from multidrop.drive.request import check_no_read
from multidrop.drive.text import Text
from multidrop.drive.verbs import CalledStop, Insist, Read, Script, State, Step, Wait, Write, carry_out
from multidrop.errors import BusError, CancelledByStop, DriveException, Unconfirmed, WriteForbidden
from multidrop.transport import clock
from multidrop.transport.exchange import READ_FAILURES, Exchanges

_log = logging.getLogger("multidrop.control")


class _Over(Exception):
    """Raised if a script catches CancelledByStop and continues."""


class Performer:
    """Carries out writes, and verbs such as `start`, on the drives of one bus.

    A write expires if it cannot be sent within `expiry` seconds of its call.
    """

    def __init__(
        self, exchanges: Exchanges, writer: Writer, stopper: Stopper, latches: Latches, expiry: float
    ) -> None:
        self._exchanges = exchanges
        self._writer = writer
        self._stopper = stopper
        self._latches = latches
        self._expiry = expiry

    def call(self, drive: Drive, verb: str = "", seen: int | None = None) -> Call:
        """Return the `Call` of a method that writes to the drive. A later stop of the drive cancels it.

        If the method was called earlier, `seen` is the number of the drive's stops at that time.
        """
        permit = self._latches.latch(drive).permit(seen)
        if self._latches.is_shut:
            await_signal()
        return Call(drive, permit, self._expiry, verb, present_limit_ns())

    def move(self, script: Script[Any], call: Call) -> Any:
        """Carry out the script of a verb that may move the motor; return the script's result.

        Raises CancelledByStop if a stop was called before the script's first write, and Unconfirmed if a stop
        was called after that write.
        """
        with call.noted():
            call.check(f"the {call.verb}")
            self._look_at_identity(call.drive, call)
            result = self.perform(script, call)
            if not call.permit.is_good:
                raise _unseen(call, call.cancelled(f"the {call.verb}"))
            if call.unverified:
                with call.look():
                    outcome = self._writer.verified(call.drive, call.unverified)
                if outcome.failure:
                    raise outcome.failure
            return result

    def write(self, drive: Drive, register: Register[Any], value: Any) -> Outcome:
        """Carry out a plain write; return its outcome.

        A write that stops the motor cancels other calls, and is sent immediately, without the checks of other
        writes.
        """
        raw = raw_count(drive, register, value)
        check_plain(drive, register, raw)
        step = Write(register, value)
        if is_harmless(register, raw):  # a stop
            self._latches.rise([drive])
            try:
                return self._writer.verified(drive, self._stopper.insist(drive, step))
            finally:
                self._writer.records.catch_up_aside()
        call = self.call(drive)
        with call.noted():
            call.check(f"{register.name} = {register.format(value)}")
            outcome = self._writer.put(drive, step, call)
            with call.look():
                return self._writer.verified(drive, outcome)

    def raw(self, drive: Drive, request: Message) -> bytes:
        """Send a request once; return the reply's data. Raises ValueError for a Modbus read."""
        check_no_read(drive, request)
        call = self.call(drive)
        with call.noted():
            return self._writer.raw(drive, request, call)

    def check_identity(self, drive: Drive, rest_s: float = 0.0) -> None:
        """Check that the drive is of its declared family, unless it was checked before.

        After the check, log what the motor does if this client dies. `rest_s` is a pause in s before each
        read.
        """
        if not self._writer.identity_check.is_known(drive):
            self._look_at_identity(drive, self.call(drive), rest_s)

    def _look_at_identity(self, drive: Drive, call: Call, rest_s: float = 0.0) -> None:
        identity_check = self._writer.identity_check
        is_first = not identity_check.is_known(drive)

        def look() -> AbstractContextManager[None]:
            clock.sleep(rest_s)
            return call.look()

        identity_check.check(drive, look if rest_s else call.look)
        if is_first and drive.has_motor:
            with call.look():
                _log.info("%s: %s", drive.name, self.watchdog(drive))

    def watchdog(self, drive: Drive) -> str:
        """Return a sentence that says what the motor does if this client dies.

        The sentence contains the drive's `communication_timeout`. If that cannot be read, return the family's
        text.
        """
        register = drive.registers.get("communication_timeout")
        if register is None or not register.readable:
            return drive.watchdog
        try:
            held = self._exchanges.value(drive, register)
        except DriveException:
            return drive.watchdog
        if held == 0:
            return f"its watchdog ({register.name}) is off: the motor runs on when the client dies"
        return f"its watchdog ({register.name}) acts {register.format(held)} after the last message"

    def perform(self, script: Script[Any], call: Call) -> Any:
        """Carry out a script's steps; return its result.

        Raises Unconfirmed if a read fails after a write. The read's own error would mislead: NoReply means
        that the write was not sent, and DriveException that the drive refused the write.
        """
        unseen: list[Exception] = []  # failures of steps other than writes
        cancelled: list[CancelledByStop] = []

        def do(step: Step) -> Any:
            try:
                _check(step, call, cancelled)
                return self._do(step, call)
            except Exception as failure:
                if not isinstance(step, Write):
                    unseen.append(failure)
                raise

        try:
            return carry_out(script, do)
        except (*READ_FAILURES, CancelledByStop, _Over) as failure:
            why: Exception = cancelled[0] if isinstance(failure, _Over) else failure
            if not call.sent or why not in unseen:
                raise why from None if why is failure else failure
            raise _unseen(call, why) from why
        finally:
            self._writer.records.catch_up()

    def _do(self, step: Step, call: Call) -> Any:
        drive = call.drive
        if isinstance(step, Wait):
            with call.step(step.seconds):
                return clock.sleep(step.seconds)
        if isinstance(step, Read):
            with call.look():
                value = self._exchanges.value(drive, step.register)
            call.unverified = None
            return value
        if isinstance(step, Insist):
            return self._stopper.insist(drive, step).value
        return self._writer.put(drive, step, call).value


def _check(step: Step, call: Call, cancelled: list[CancelledByStop]) -> None:
    """Raise CancelledByStop if a stop was called; raise _Over if the script has caught this error before.

    A verb's script gets the error at its next step, any other script at its next write. An `Insist` step is
    always carried out, because it is harmless and undoes an earlier write.
    """
    if isinstance(step, Insist) or not (call.verb or isinstance(step, Write)) or call.permit.is_good:
        return
    if cancelled:
        raise _Over
    what = step.register.name if isinstance(step, Write) and not call.verb else f"the {call.verb}"
    cancelled.append(call.cancelled(what))
    raise cancelled[0]


def _unseen(call: Call, why: Exception) -> Unconfirmed:
    if isinstance(why, CancelledByStop):
        reason = f"it was sent, and then {why.why}"
    elif call.is_confirmed:
        reason = f"it was confirmed, but its effect could not be seen: {why}"
    else:
        reason = f"it was sent, and its effect could not be seen: {why}"
    return Unconfirmed(call.drive.name, call.sent or f"the {call.verb}", reason)


# ---- requests from the methods of drives ----


class BusLink:
    """Carries out the reads, writes and stops that the methods of a bus's drives request."""

    def __init__(self, exchanges: Exchanges, performer: Performer, stopper: Stopper) -> None:
        self._exchanges = exchanges
        self._performer = performer
        self._stopper = stopper

    def values(self, drive: Drive, registers: tuple[Any, ...]) -> dict[str, Any]:
        try:
            return self._exchanges.read(drive, registers)
        except TypeError:  # an unhashable argument cannot be a register
            for register in registers:
                if not isinstance(register, str):
                    check_own(drive, register)
            raise

    def text(self, drive: Drive, text: Text) -> str:
        check_own_text(drive, text)
        return self._exchanges.read_text(drive, text)

    def write(self, drive: Drive, register: Register[Any], value: Any) -> Outcome:
        return self._performer.write(drive, register, value)

    def read_raw(
        self,
        drive: Drive,
        function: int,
        start: int,
        count: int,
        expiry: float = MOST_EXPIRY_S,
        attempts: int = 1,
    ) -> bytes:
        check_expiry(expiry)
        return self._exchanges.ask(drive, function, start, count, expiry, attempts)

    def send_raw(self, drive: Drive, function: int, start: int, data: bytes, count: int) -> bytes:
        if not isinstance(data, bytes | bytearray):
            raise TypeError(f"data = {data!r}: it must be bytes, such as b'\\x00\\x01'")
        return self._performer.raw(drive, Message(drive.address, function, start, count, data))

    def perform(self, drive: Drive, script: Script[Any]) -> Any:
        return self._performer.perform(script, self._performer.call(drive))

    def begin_call(self, drive: Drive, verb: str, seen: int) -> Call:
        return self._performer.call(drive, verb, seen)

    def carry_out_move(self, drive: Drive, script: Script[Any], call: Call) -> Any:
        return self._performer.move(script, call)

    def begin_stop(
        self, drive: Drive, verb: str, make: Callable[[], Script[Any]], seconds: float | None
    ) -> CalledStop:
        return self._stopper.stop(drive, verb, make, seconds)


# ---- broadcasts ----


class Broadcaster:
    """Writes to all drives of a bus with one broadcast, if that is harmless to each drive.

    A register address means different things to different families: one family's stop may be another's start.
    So all drives must be of one family, and must have the same settings and framing.
    """

    def __init__(self, writer: Writer, performer: Performer, latches: Latches) -> None:
        self._writer = writer
        self._performer = performer
        self._latches = latches

    def write(
        self, drives: Sequence[Drive], register: Register[Any] | str, value: Any
    ) -> dict[str, State | BusError]:
        """Broadcast a write; return each drive's state afterwards, or the error of reading it.

        Raises WriteForbidden if the write must not be broadcast.
        """
        if isinstance(register, str):
            if not drives:
                raise ValueError("no drive is attached to this bus")
            register = drives[0].register(register)
        if drives and drives[0].framing is Framing.TCP:
            raise WriteForbidden(
                f"{register.name} cannot be broadcast: Modbus TCP has no broadcast. Write to one drive after "
                "another",
                register=register.name,
                rule="Modbus TCP has no broadcast",
            )
        if not _are_alike(drives):
            raise WriteForbidden(
                f"{register.name} cannot be broadcast: the drives on this line differ in family or "
                "settings, so an address may be different registers. Write to one drive after another",
                register=register.name,
                rule="the drives on the line differ",
            )
        first = drives[0]
        raw = raw_count(first, register, value)
        if raw not in register.broadcast:
            raise WriteForbidden(
                f"{register.name} = {value} cannot be broadcast to {first.title} drives: the manual does not "
                "allow it, or it may move a motor"
            )
        for drive in drives:
            check_broadcast(drive, register, raw)
        if is_harmless(register, raw):
            for drive in drives:
                self._performer.check_identity(drive)
            self._latches.rise(drives)
            call = None
        else:
            call = self._checked_call(drives, f"{register.name} = {register.format(register.decode(raw))}")
        if register.name == first.setpoint_name:
            for drive in drives:
                drive.commanded = None
        try:
            self._writer.broadcast(first, register, raw, call)
        finally:
            self._writer.records.catch_up()
        return {drive.name: self._state(drive) for drive in drives}

    def _checked_call(self, drives: Sequence[Drive], what: str) -> Call:
        """Check that each drive may be written; return the first drive's `Call` for the broadcast."""
        check_author()
        calls = [self._performer.call(drive) for drive in drives]
        for call in calls:
            self._writer.identity_check.check(call.drive, call.look)
        for call in calls:
            call.check(what)
        return calls[0].restarted()

    def _state(self, drive: Drive) -> State | BusError:
        try:
            return cast(State, self._performer.perform(drive.state.script(), self._performer.call(drive)))
        except BusError as failure:
            return failure

    def stop(self, drives: Sequence[Drive]) -> bool:
        """Broadcast a stop if `identify` has confirmed each drive and their family has a broadcast stop.

        Return True if the stop may have been sent.
        """
        known = all(self._writer.identity_check.is_known(drive) for drive in drives)
        control = drives[0].registers.get("control") if drives else None
        if len(drives) < 2 or not _are_alike(drives) or not known or drives[0].framing is Framing.TCP:
            return False
        if control is None or not control.broadcast or not is_stop(drives[0], control, control.broadcast[0]):
            return False
        try:
            self._writer.broadcast(drives[0], control, control.broadcast[0])
        except Exception as failure:  # not raised: the caller also sends each drive its own stop
            return isinstance(failure, Unconfirmed)
        return True


def _are_alike(drives: Sequence[Drive]) -> bool:
    return len({(type(drive), drive.settings, drive.framing) for drive in drives}) == 1
