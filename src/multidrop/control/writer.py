"""Writer: check a write, send it once, record it, and find out its effect."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import replace
from typing import Any

from multidrop.control.call import Call
from multidrop.control.identity import EchoCheck, IdentityCheck
from multidrop.control.outcome import Effect, Outcome
from multidrop.control.records import WriteRecords, check_author
from multidrop.control.rules import check_known, conditions, raw_count, wears
from multidrop.core import Completion, Failure, Message, build_request
from multidrop.drive.family import Drive
from multidrop.drive.register import Kept, Register
from multidrop.drive.request import write_request
from multidrop.drive.verbs import Step, Wait, Write, carry_out
from multidrop.errors import (
    BadReply,
    BusError,
    CancelledByStop,
    DriveException,
    Expired,
    LineError,
    NoReply,
    NotAttached,
    NotMaster,
    NoValue,
    Unconfirmed,
)
from multidrop.transport import clock
from multidrop.transport.exchange import READ_FAILURES, Exchanges, good_reply

ACKNOWLEDGED = 5  # exception code: the device accepted the request, but needs more time

# (register name, raw count) of each write that `check_before_stop` has allowed for one stop
Checked = set[tuple[str, float]]


class Writer:
    """Sends all writes to the drives on a line."""

    def __init__(self, exchanges: Exchanges, records: WriteRecords) -> None:
        self.records = records
        self._exchanges = exchanges
        self._echo = EchoCheck(exchanges)
        self.identity_check = IdentityCheck(exchanges, self._echo)

    # ---- writing ----

    def put(self, drive: Drive, step: Write, call: Call) -> Outcome:
        """Check a write, send it once, and return its outcome.

        Verbs call this too, so it does not check whether the write may move the motor.
        Raises CancelledByStop or Expired if the write was not sent.
        """
        check_author()
        register, value = step.register, step.value
        raw = raw_count(drive, register, value)
        asked = register.decode(raw)
        check_known(drive, register, raw)
        self.identity_check.check(drive, call.look)
        carry_out(conditions(drive, register, asked), lambda step: self._look(drive, step, call))
        kept = wears(drive, register)
        if kept is not Kept.RAM:
            if register.readable:
                held = None
                with call.look(), suppress(NoValue):
                    held = self._exchanges.value(drive, register)
                if held == asked:
                    if register.name == drive.setpoint_name:
                        drive.commanded = asked
                    return Outcome(drive.name, register, asked, Effect.DONE, held=asked)
            # checked before counting: an unsent write must not be counted
            call.check(_in_words(register, asked))
        request, what = write_request(drive, register, raw), _in_words(register, asked)
        self.records.note_called(drive, request, what)
        try:
            if kept is not Kept.RAM:
                self.records.count(drive, register, kept)
            # checked again, because counting the write in the ledger may have taken long
            self.identity_check.check(drive, call.look)
        except BaseException as failure:
            self.records.note_unsent(drive, request, what, failure)
            raise
        return self._send(drive, register, raw, call, 0.0, self.records.log)

    def insist(
        self,
        drive: Drive,
        step: Write,
        checked: Checked,
        timeout: float = 0.0,
        log: Callable[..., None] | None = None,
    ) -> Outcome:
        """Write a stop, or a raw count that is harmless at any time, without checking rules or the budget.

        Raises WriteForbidden only on proof that the drive is of another family. A write in `checked` is not
        checked again, even if the port was reopened: some servers close the connection after each reply, so
        a repeated check would close it again before the write. On a line with late replies, waits up to
        `timeout` seconds for the write's own reply. `log` records the write; by default, the record is queued
        until `catch_up`.
        """
        register = step.register
        raw = raw_count(drive, register, step.value)
        if (register.name, raw) not in checked:
            was_lost = self._exchanges.line.is_lost
            self.identity_check.check_before_stop(drive, register, raw)
            if not was_lost:
                checked.add((register.name, raw))
        kept = wears(drive, register)
        try:
            return self._send(drive, register, raw, None, timeout, log or self.records.log_later)
        finally:
            if kept is not Kept.RAM:
                self.records.count_later(drive, register)

    def verified(self, drive: Drive, outcome: Outcome) -> Outcome:
        """Return the outcome, changed to UNCONFIRMED if the write's reply may be the adapter's echo.

        To find that out, another register is read, unless the outcome is already certain.
        """
        if outcome.effect is not Effect.DONE or outcome.held is not None:
            return outcome
        why = self._echo.why_doubtful(drive)
        if not why:
            return outcome
        if outcome.register.name == drive.setpoint_name:
            drive.commanded = None
        unknown = Unconfirmed(drive.name, _in_words(outcome.register, outcome.asked), why)
        return replace(outcome, effect=Effect.UNCONFIRMED, failure=unknown)

    def raw(self, drive: Drive, request: Message, call: Call) -> bytes:
        """Send any request once; return the data of the reply.

        No rule applies except that the call must be neither cancelled nor expired.
        """
        check_author()
        frame = build_request(drive.framing, request)
        what = f"raw request {frame.hex(' ').upper()}"
        log = self.records.log
        self.records.note_called(drive, request, what)
        with self._logged(drive, request, what, log, call):
            completion = self._carry_out(drive, request, what, call)
        try:
            reply = good_reply(drive, completion)
        except (NoReply, BadReply) as failure:
            log(drive, request, what, Effect.UNCONFIRMED, str(failure))
            raise Unconfirmed(drive.name, what, _reason(failure)) from failure
        except DriveException as failure:
            log(drive, request, what, Effect.REFUSED, str(failure))
            raise
        if completion.raw == frame:
            with call.look():
                doubt = self._echo.why_doubtful(drive)
            if doubt:
                log(drive, request, what, Effect.UNCONFIRMED, doubt)
                raise Unconfirmed(drive.name, what, doubt)
        log(drive, request, what, Effect.DONE)
        return reply.data

    def broadcast(self, drive: Drive, register: Register[Any], raw: float, call: Call | None = None) -> None:
        """Broadcast a write of one of this drive's registers. A stop has no `Call` object."""
        request = write_request(drive, register, raw, address=0)
        what = _in_words(register, register.decode(raw))
        if call:
            self.records.note_called(drive, request, what)
        expires_ns, permit = (call.expires_ns, call.permit) if call else (0, None)
        with self._logged(drive, request, what, self.records.log_later, call):
            completion = self._exchanges.carry_out(
                drive, request, expires_ns, insists=call is None, timeout=0.0, permit=permit
            )
            if call and completion.result == Failure.EXPIRED:
                raise call.unsent(what)
        self.records.log_later(drive, request, what, Effect.UNCONFIRMED, "a broadcast has no reply")

    # ---- sending, and the outcome ----

    def _send(
        self,
        drive: Drive,
        register: Register[Any],
        raw: float,
        call: Call | None,
        timeout: float,
        log: Callable[..., None],
    ) -> Outcome:
        """Send a write once; return its outcome. A stop has no `Call` object."""
        request, asked = write_request(drive, register, raw), register.decode(raw)
        frame, what = build_request(drive.framing, request), _in_words(register, asked)
        is_setpoint = register.name == drive.setpoint_name
        take_back = drive.begin_setpoint() if is_setpoint else lambda: None
        done = Outcome(drive.name, register, asked, Effect.DONE)
        with self._logged(drive, request, what, log, call):
            try:
                completion = self._carry_out(drive, request, what, call, timeout)
            except Exception as failure:
                if _is_unsent(failure):
                    take_back()
                # a server may close the connection right after its reply to a stop
                is_copy = call is None and isinstance(failure, LineError) and failure.received == frame
                if not (is_copy and self._echo.probe(drive, insists=True)):
                    raise
                outcome = done
            else:
                outcome = self._outcome(drive, register, asked, completion, call)
                is_copy = outcome.effect is Effect.UNCONFIRMED and frame in completion.raw
                is_answered = is_copy and self._echo.probe(drive, insists=call is None)
                if call is None and is_answered and completion.result == Failure.MAYBE_ECHO:
                    outcome = done
        is_unconfirmed = outcome.effect is Effect.UNCONFIRMED
        if outcome.effect is Effect.REFUSED:
            take_back()
        elif is_setpoint:
            drive.commanded = outcome.value if outcome.effect is Effect.DONE else None
        if call:
            call.is_confirmed = not is_unconfirmed
            call.unverified = outcome
        why = "" if outcome.failure is None else str(outcome.failure)
        log(drive, request, what, outcome.effect, why, outcome.held)
        return outcome

    def _carry_out(
        self, drive: Drive, request: Message, what: str, call: Call | None, timeout: float = 0.0
    ) -> Completion:
        if call is None:
            return self._exchanges.carry_out(drive, request, insists=True, timeout=timeout)
        expires_ns, late_ns = call.expires_ns, call.late_ns
        before, call.sent, call.is_confirmed = (call.sent, call.is_confirmed), what, False
        try:
            with call.look():
                completion = self._exchanges.carry_out(drive, request, expires_ns, permit=call.permit)
        except NotMaster as failure:
            if not failure.is_sent:
                call.sent, call.is_confirmed = before
            raise
        if completion.result == Failure.EXPIRED:
            call.sent, call.is_confirmed = before
            raise call.unsent(what)
        call.excuse(late_ns)
        return completion

    def _outcome(
        self, drive: Drive, register: Register[Any], asked: Any, completion: Completion, call: Call | None
    ) -> Outcome:
        """Return the outcome of a write, from its reply and the value read back."""
        lost: BusError | None = None
        held, unread = None, None
        try:
            good_reply(drive, completion)
        except DriveException as failure:
            if call is None or not _is_under_way(failure):
                return Outcome(drive.name, register, asked, Effect.REFUSED, failure=failure)
            lost = failure
        except (NoReply, BadReply) as failure:
            lost = failure
        # a stop (`call` is None) without a reply is repeated, not read back
        if lost is None or call is not None:
            held, unread = self._held(drive, register, call)
        if held is not None and (held == asked or lost is None):
            effect = Effect.DONE if held == asked else Effect.TAKEN_AS
            return Outcome(drive.name, register, asked, effect, held=held)
        if lost is None and unread is None:
            return Outcome(drive.name, register, asked, Effect.DONE)
        reason = _reason(lost) if lost else f"it was confirmed, but not read back: {unread}"
        unknown = Unconfirmed(drive.name, _in_words(register, asked), reason)
        unknown.__cause__ = lost or unread
        return Outcome(drive.name, register, asked, Effect.UNCONFIRMED, held=held, failure=unknown)

    def _held(self, drive: Drive, register: Register[Any], call: Call | None) -> tuple[Any, Exception | None]:
        """Return the value read back and None, or None and the error of the read."""
        if not register.readable:
            return None, None
        try:
            with call.look() if call else nullcontext():
                return self._exchanges.value(drive, register, is_stop_read=call is None), None
        except READ_FAILURES as failure:
            return None, failure

    def _look(self, drive: Drive, step: Step, call: Call) -> Any:
        """Carry out one step of a script that only waits and reads; return the value that it reads."""
        if isinstance(step, Wait):
            with call.step(step.seconds):
                return clock.sleep(step.seconds)
        with call.look():
            return self._exchanges.value(drive, step.register)

    @contextmanager
    def _logged(
        self, drive: Drive, request: Message, what: str, log: Callable[..., None], call: Call | None
    ) -> Iterator[None]:
        """If the block fails, record the write as unconfirmed, or as not sent if that is certain."""
        try:
            yield
        except BaseException as failure:
            if _is_unsent(failure):
                if call:
                    self.records.note_unsent(drive, request, what, failure)
                raise
            log(drive, request, what, Effect.UNCONFIRMED, str(failure) or type(failure).__name__)
            if isinstance(failure, (LineError, NotMaster)):
                raise Unconfirmed(drive.name, what, failure.reason) from failure
            raise


def _in_words(register: Register[Any], value: Any) -> str:
    return f"{register.name} = {register.format(value)}"


def _is_unsent(failure: BaseException) -> bool:
    if isinstance(failure, (LineError, NotMaster)):
        return not failure.is_sent
    return isinstance(failure, (Expired, CancelledByStop, NotAttached, NoReply))


def _is_under_way(failure: DriveException) -> bool:
    """Return True for exception 05: accepted, but not done yet (application protocol V1.1b3, section 7)."""
    return failure.code == ACKNOWLEDGED and failure.meaning == Drive.exceptions[ACKNOWLEDGED]


def _reason(failure: BusError) -> str:
    if isinstance(failure, DriveException):
        return f"its reply is code {failure.code:02X}H, {failure.meaning}"
    return failure.reason if isinstance(failure, BadReply) else "no reply"
