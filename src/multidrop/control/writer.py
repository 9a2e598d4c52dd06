"""Writing to a drive: by all rules, once, counted and noted; and what is then known of its effect."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import replace
from typing import Any

from multidrop.control.audit_log import AuditLog
from multidrop.control.call import Call
from multidrop.control.eeprom_ledger import LEAST_INTERVAL, Ledger, LedgerCell
from multidrop.control.identity import IdentityCheck
from multidrop.control.outcome import Effect, Outcome
from multidrop.control.rules import conditions, raw_count, refused, wears
from multidrop.core import Completion, Failure, Message, build_request, utc_minus_monotonic_ns
from multidrop.drive.family import Drive
from multidrop.drive.register import Kept, Register
from multidrop.drive.request import write_request
from multidrop.drive.script import Step, Wait, Write, carry_out
from multidrop.errors import (
    BadReply,
    BusError,
    DriveRefused,
    Expired,
    LineError,
    NoReply,
    NotAttached,
    Overtaken,
    Unconfirmed,
)
from multidrop.transport.clock import now_ns, sleep
from multidrop.transport.exchange import READ_ATTEMPTS, Exchanges


def utc_ns() -> int:
    return int(now_ns() + utc_minus_monotonic_ns())


class Writer:
    """All that is written to the drives on a line goes through here."""

    def __init__(self, exchanges: Exchanges, ledger: Ledger, audit: AuditLog | None) -> None:
        self.identity_check = IdentityCheck(exchanges)
        self.audit = audit
        self._exchanges = exchanges
        self._ledger = ledger
        self._uncounted: deque[LedgerCell] = deque()  # of what was insisted on
        self._unlogged: deque[tuple[int, dict[str, Any]]] = deque()

    def put(self, drive: Drive, step: Write, call: Call) -> Outcome:
        """Write once by all rules but that for plain writes; what became of it.

        Raises Overtaken and Expired, by its call.
        """
        register, value = step.register, step.value
        raw = raw_count(drive, register, value)
        asked = register.decode(raw)
        self.identity_check.make(drive, call.look)
        carry_out(conditions(drive, register, asked), lambda step: self._look(drive, step, call))
        kept = wears(drive, register)
        if kept is not Kept.RAM:
            if register.readable:
                with call.look():
                    held = self._read(drive, register)
                if held == asked:
                    return Outcome(drive.name, register, asked, Effect.DONE, held=asked)
            call.check(_what(register, asked))  # what is not sent is not counted
            self._enter(drive, register, kept)
        return self._sent(drive, register, raw, call)

    def insist(self, drive: Drive, step: Write, timeout: float = 0.0) -> Outcome:
        """Write what stops the motor, or does no harm at any time: the port alone keeps it back.

        Neither a rule nor the ledger is asked. It is noted in the log, and counted where it may wear an
        EEPROM, afterwards, by `catch_up`: a disk may hang. Only what proves another family is Refused.
        Where answers are known to be late, its own is waited for for as long as `timeout` seconds.
        """
        register = step.register
        raw = raw_count(drive, register, step.value)
        self.identity_check.glance(drive)
        kept = wears(drive, register)
        try:
            return self._sent(drive, register, raw, None, timeout)
        finally:
            if kept is not Kept.RAM:
                self._uncounted.append(self._cell(drive, register))

    def heard_since(self, drive: Drive, outcome: Outcome) -> Outcome:
        """Return what is known of a write that is the latest thing heard of the drive, once more is read."""
        if outcome.effect is not Effect.DONE or outcome.held is not None:
            return outcome
        why = self.identity_check.why_doubtful(drive)
        if not why:
            return outcome
        unknown = Unconfirmed(drive.name, _what(outcome.register, outcome.asked), why)
        return replace(outcome, effect=Effect.UNCONFIRMED, failure=unknown)

    def catch_up(self) -> None:
        """Log and count what was insisted on; that it cannot be is a warning."""
        with suppress(IndexError):  # another thread may be at it
            while True:
                self._write(*self._unlogged.popleft())
        with suppress(IndexError):
            while True:
                self._count(self._uncounted.popleft())

    def _count(self, cell: LedgerCell) -> None:
        try:
            self._ledger.at(cell.port).note(cell, utc_ns() / 1e9)
        except OSError as failure:
            logging.getLogger("multidrop").warning("a stop was not counted: %s", failure)

    def _sent(
        self, drive: Drive, register: Register[Any], raw: float, call: Call | None, timeout: float = 0.0
    ) -> Outcome:
        """Send it once: for its call, or else insisting."""
        request, asked = write_request(drive, register, raw), register.decode(raw)
        what = _what(register, asked)
        log = self.log if call else self._log_later
        with self._noted(drive, request, what, log):
            completion = self._carried_out(drive, request, what, call, timeout)
            outcome = self._outcome(drive, register, asked, completion, call)
            if (
                outcome.effect is Effect.UNCONFIRMED
                and build_request(drive.framing, request) in completion.raw
            ):
                self.identity_check.tell_echo(drive, insists=call is None)
        if call:
            call.is_confirmed = outcome.effect is not Effect.UNCONFIRMED
            call.unheard = outcome
        why = "" if outcome.failure is None else str(outcome.failure)
        log(drive, request, what, outcome.effect, why, outcome.held)
        return outcome

    def _carried_out(
        self, drive: Drive, request: Message, what: str, call: Call | None, timeout: float = 0.0
    ) -> Completion:
        if call is None:
            return self._exchanges.carry_out(drive, request, insists=True, timeout=timeout)
        before, call.sent, call.is_confirmed = (call.sent, call.is_confirmed), what, False
        completion = self._exchanges.carry_out(drive, request, call.expires_ns, permit=call.permit)
        if completion.result == Failure.EXPIRED:
            call.sent, call.is_confirmed = before
            raise call.unsent(what)
        return completion

    def _outcome(
        self,
        drive: Drive,
        register: Register[Any],
        asked: Any,
        completion: Completion,
        call: Call | None,
    ) -> Outcome:
        """What is known: by the reply, and by what the drive then holds."""
        what = _what(register, asked)
        lost: BusError | None = None
        held, unread = None, None
        try:
            self._exchanges.reply(drive, completion)
        except DriveRefused as failure:
            return Outcome(drive.name, register, asked, Effect.REFUSED, failure=failure)
        except (NoReply, BadReply) as failure:
            lost = failure
        if lost is None or call is not None:  # a stop whose reply is lost is sent again at once
            held, unread = self._held(drive, register, call)
        if held is not None and (held == asked or lost is None):
            effect = Effect.DONE if held == asked else Effect.TAKEN_AS
            return Outcome(drive.name, register, asked, effect, held=held)
        if lost is None and unread is None:
            return Outcome(drive.name, register, asked, Effect.DONE)
        reason = _why(lost) if lost else f"it was confirmed, but not read back: {unread}"
        unknown = Unconfirmed(drive.name, what, reason)
        unknown.__cause__ = lost or unread
        return Outcome(drive.name, register, asked, Effect.UNCONFIRMED, held=held, failure=unknown)

    def _held(self, drive: Drive, register: Register[Any], call: Call | None) -> tuple[Any, Exception | None]:
        """What the drive holds, None where that cannot be read, and why it was not."""
        if not register.readable:
            return None, None
        try:
            with call.look() if call else nullcontext():
                return self._read(drive, register), None
        except (NoReply, BadReply, DriveRefused, LineError, NotAttached) as failure:
            return None, failure

    def _enter(self, drive: Drive, register: Register[Any], kept: Kept) -> None:
        """Count a write in the ledger; Refused when it may not be."""
        cell = self._cell(drive, register)
        least = LEAST_INTERVAL if kept is Kept.EEPROM else 0.0
        why = self._ledger.at(self._exchanges.line.identity).enter(cell, utc_ns() / 1e9, least)
        if why:
            way = "write it less often, or take a setpoint that is kept in RAM"
            if kept is Kept.UNKNOWN:
                way = f'if you know that this drive keeps it in RAM, declare ram = ["{register.name}"]'
            raise refused(drive, register, f"{why}; {way}")

    def _cell(self, drive: Drive, register: Register[Any]) -> LedgerCell:
        line = self._exchanges.line
        model = drive.model or type(drive).__name__
        return LedgerCell(line.identity, drive.address, model, register.name, line.port)

    def _read(self, drive: Drive, register: Register[Any]) -> Any:
        return self._exchanges.values(drive, [register], READ_ATTEMPTS)[register.name]

    def _look(self, drive: Drive, step: Step, call: Call) -> Any:
        """A step of what the rules depend on."""
        if isinstance(step, Wait):
            with call.step(step.seconds):
                return sleep(step.seconds)
        with call.look():
            return self._read(drive, step.register)

    def log(
        self, drive: Drive, request: Message, what: str, effect: Effect, why: str = "", held: Any = None
    ) -> None:
        """Note a write in the audit log; that it cannot be kept is a warning."""
        self._log_later(drive, request, what, effect, why, held)
        self.catch_up()

    def _log_later(
        self, drive: Drive, request: Message, what: str, effect: Effect, why: str = "", held: Any = None
    ) -> None:
        if self.audit is None:
            return
        frame = build_request(drive.framing, request)
        record = {
            "port": self._exchanges.line.port,
            "drive": drive.name if request.address else "all",
            "model": drive.model,
            "address": request.address,
            "write": what,
            "sent": frame.decode().strip() if frame.startswith(b":") else frame.hex(" ").upper(),
            "outcome": effect.value,
        }
        more = {"held": None if held is None else float(held), "why": why}
        record |= {key: text for key, text in more.items() if text not in (None, "")}
        self._unlogged.append((utc_ns(), record))

    def _write(self, at_ns: int, record: dict[str, Any]) -> None:
        audit = self.audit
        if audit is None:
            return
        try:
            audit.add(at_ns, record)
        except (OSError, ValueError) as failure:  # it may be closed meanwhile
            logging.getLogger("multidrop").warning("the audit log cannot be written: %s", failure)

    @contextmanager
    def _noted(self, drive: Drive, request: Message, what: str, log: Callable[..., None]) -> Iterator[None]:
        """Note the write too when its outcome never comes: the port failed, or somebody pressed Ctrl-C."""
        try:
            yield
        except (Expired, Overtaken, NotAttached, NoReply):  # it was not sent
            raise
        except BaseException as failure:
            log(drive, request, what, Effect.UNCONFIRMED, str(failure) or type(failure).__name__)
            if isinstance(failure, LineError) and failure.is_sent:
                raise Unconfirmed(drive.name, what, failure.reason) from failure
            raise

    def close(self) -> None:
        self.catch_up()
        if self.audit is not None:
            self.audit.close()
            self.audit = None

    def raw(self, drive: Drive, request: Message, call: Call) -> bytes:
        """Send any request once, past every rule but its call's; the data of the reply."""
        what = f"raw request {build_request(drive.framing, request).hex(' ').upper()}"
        with self._noted(drive, request, what, self.log):
            completion = self._carried_out(drive, request, what, call)
        try:
            reply = self._exchanges.reply(drive, completion)
        except (NoReply, BadReply) as failure:
            self.log(drive, request, what, Effect.UNCONFIRMED, str(failure))
            raise Unconfirmed(drive.name, what, _why(failure)) from failure
        except DriveRefused as failure:
            self.log(drive, request, what, Effect.REFUSED, str(failure))
            raise
        if completion.raw == build_request(drive.framing, request):
            with call.look():
                why_not = self.identity_check.why_doubtful(drive)
            if why_not:
                self.log(drive, request, what, Effect.UNCONFIRMED, why_not)
                raise Unconfirmed(drive.name, what, why_not)
        self.log(drive, request, what, Effect.DONE)
        return reply.data

    def broadcast(self, drive: Drive, register: Register[Any], raw: float) -> None:
        """Write to all drives at once, by the table of one of them."""
        request = write_request(drive, register, raw, address=0)
        what = f"{register.name} = {register.format(register.decode(raw))}"
        with self._noted(drive, request, what, self._log_later):
            self._exchanges.carry_out(drive, request, insists=True, timeout=0.0)
        self._log_later(drive, request, what, Effect.UNCONFIRMED, "nobody answers a broadcast")


def _what(register: Register[Any], value: Any) -> str:
    return f"{register.name} = {register.format(value)}"


def _why(failure: BusError) -> str:
    return failure.reason if isinstance(failure, BadReply) else "no reply"
