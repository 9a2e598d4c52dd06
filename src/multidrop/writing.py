"""Writing to a drive: by all rules, once, counted and noted; and what is then known of its effect."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from multidrop.acquaintance import Acquaintance
from multidrop.audit import AuditLog
from multidrop.core import Completion, Message, Result, build_request
from multidrop.drive import Drive, Insist, Step, Wait, Write, carry_out
from multidrop.errors import (
    BadReply,
    BusError,
    DriveRefused,
    Expired,
    LineError,
    NoReply,
    Unconfirmed,
)
from multidrop.exchanges import READ_ATTEMPTS, Exchanges
from multidrop.ledger import LEAST_INTERVAL, Cell, Ledger
from multidrop.line import now_ns, sleep, utc_minus_monotonic_ns
from multidrop.outcome import Effect, Outcome
from multidrop.plan import write_request
from multidrop.register import Kept, Register
from multidrop.rules import conditions, is_harmless, raw_count, refused, wears


def utc_ns() -> int:
    return int(now_ns() + utc_minus_monotonic_ns())


class Writer:
    """All that is written to the drives on a line goes through here."""

    def __init__(self, exchanges: Exchanges, ledger: Ledger, audit: AuditLog | None, expiry: float) -> None:
        self.acquaintance = Acquaintance(exchanges)
        self.audit = audit
        self._exchanges = exchanges
        self._ledger = ledger
        self._expiry = expiry

    def put(self, drive: Drive, step: Write) -> Outcome:
        """Write once by all rules but that for plain writes; what became of it."""
        register, value = step.register, step.value
        raw = raw_count(drive, register, value)
        asked = register.decode(raw)
        if isinstance(step, Insist) or is_harmless(register, raw):
            self.acquaintance.glance(drive)
        else:
            self.acquaintance.make(drive)
        carry_out(conditions(drive, register, asked), lambda step: self._look(drive, step))
        kept = wears(drive, register)
        if kept is not Kept.RAM:
            if register.readable and self._read(drive, register) == asked:
                return Outcome(drive.name, register, asked, Effect.DONE, held=asked)
            self._enter(drive, register, kept)
        return self._sent(drive, step, write_request(drive, register, raw), asked)

    def _sent(self, drive: Drive, step: Write, request: Message, asked: Any) -> Outcome:
        register = step.register
        what = f"{register.name} = {register.format(asked)}"
        insists = isinstance(step, Insist)
        seconds = 0.0 if insists else self._expiry
        with self._noted(drive, request, what):
            completion = self._exchanges.carry_out(drive, request, seconds, insists=insists)
            if completion.result == Result.EXPIRED:
                raise Expired(drive.name, what, seconds)
            outcome = self._outcome(drive, register, asked, completion)
            if (
                outcome.effect is Effect.UNCONFIRMED
                and build_request(drive.framing, request) in completion.raw
            ):
                self.acquaintance.tell_echo(drive)
        why = "" if outcome.failure is None else str(outcome.failure)
        self.log(drive, request, what, outcome.effect, why, outcome.held)
        return outcome

    def _outcome(self, drive: Drive, register: Register[Any], asked: Any, completion: Completion) -> Outcome:
        """What is known: by the reply, and by what the drive then holds."""
        what = f"{register.name} = {register.format(asked)}"
        lost: BusError | None = None
        try:
            self._exchanges.reply(drive, completion)
        except DriveRefused as failure:
            return Outcome(drive.name, register, asked, Effect.REFUSED, failure=failure)
        except (NoReply, BadReply) as failure:
            lost = failure
        held, unread = self._held(drive, register)
        if held is not None and (held == asked or lost is None):
            effect = Effect.DONE if held == asked else Effect.TAKEN_AS
            return Outcome(drive.name, register, asked, effect, held=held)
        if lost is None and unread is None:
            return Outcome(drive.name, register, asked, Effect.DONE)
        reason = _why(lost) if lost else f"it was confirmed, but not read back: {unread}"
        unknown = Unconfirmed(drive.name, what, reason)
        unknown.__cause__ = lost or unread
        return Outcome(drive.name, register, asked, Effect.UNCONFIRMED, held=held, failure=unknown)

    def _held(self, drive: Drive, register: Register[Any]) -> tuple[Any, BusError | None]:
        """What the drive holds, None where that cannot be read, and why it was not."""
        if not register.readable:
            return None, None
        try:
            return self._read(drive, register), None
        except (NoReply, BadReply, DriveRefused) as failure:
            return None, failure

    def _enter(self, drive: Drive, register: Register[Any], kept: Kept) -> None:
        """Count a write in the ledger; Refused when it may not be."""
        line = self._exchanges.line
        model = drive.model or type(drive).__name__
        cell = Cell(line.identity, drive.address, model, register.name, line.port)
        least = LEAST_INTERVAL if kept is Kept.EEPROM else 0.0
        why = self._ledger.at(line.identity).enter(cell, utc_ns() / 1e9, least)
        if why:
            way = "write it less often, or take a setpoint that is kept in RAM"
            if kept is Kept.UNKNOWN:
                way = f'if you know that this drive keeps it in RAM, declare ram = ["{register.name}"]'
            raise refused(drive, register, f"{why}; {way}")

    def _read(self, drive: Drive, register: Register[Any]) -> Any:
        return self._exchanges.values(drive, [register], READ_ATTEMPTS)[register.name]

    def _look(self, drive: Drive, step: Step) -> Any:
        """A step of what the rules depend on."""
        if isinstance(step, Wait):
            return sleep(step.seconds)
        return self._read(drive, step.register)

    def log(
        self, drive: Drive, request: Message, what: str, effect: Effect, why: str = "", held: Any = None
    ) -> None:
        """Note a write in the audit log; that it cannot be kept must not stop a stop."""
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
        try:
            self.audit.add(utc_ns(), record | {key: it for key, it in more.items() if it not in (None, "")})
        except OSError as failure:
            logging.getLogger("multidrop").warning("the audit log cannot be written: %s", failure)

    @contextmanager
    def _noted(self, drive: Drive, request: Message, what: str) -> Iterator[None]:
        """Note the write too when its outcome never comes: the port failed, or somebody pressed Ctrl-C."""
        try:
            yield
        except Expired:  # it was not sent
            raise
        except BaseException as failure:
            self.log(drive, request, what, Effect.UNCONFIRMED, str(failure) or type(failure).__name__)
            if isinstance(failure, LineError) and failure.is_sent:
                raise Unconfirmed(drive.name, what, failure.reason) from failure
            raise

    def close(self) -> None:
        if self.audit is not None:
            self.audit.close()
            self.audit = None

    def raw(self, drive: Drive, request: Message) -> bytes:
        """Send any request once, past every rule; the data of the reply."""
        what = f"raw request {build_request(drive.framing, request).hex(' ').upper()}"
        with self._noted(drive, request, what):
            completion = self._exchanges.carry_out(drive, request)
        try:
            reply = self._exchanges.reply(drive, completion)
        except (NoReply, BadReply) as failure:
            self.log(drive, request, what, Effect.UNCONFIRMED, str(failure))
            raise Unconfirmed(drive.name, what, _why(failure)) from failure
        except DriveRefused as failure:
            self.log(drive, request, what, Effect.REFUSED, str(failure))
            raise
        self.log(drive, request, what, Effect.DONE)
        return reply.data

    def broadcast(self, drive: Drive, register: Register[Any], raw: float) -> None:
        """Write to all drives at once, by the table of one of them."""
        request = write_request(drive, register, raw, address=0)
        what = f"{register.name} = {register.format(register.decode(raw))}"
        with self._noted(drive, request, what):
            self._exchanges.carry_out(drive, request)
        self.log(drive, request, what, Effect.UNCONFIRMED, "nobody answers a broadcast")


def _why(failure: BusError) -> str:
    return failure.reason if isinstance(failure, BadReply) else "no reply"
