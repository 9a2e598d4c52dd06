"""Carry out exchanges with a line's drives, one at a time, before the queued exchanges of polling."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeVar

from multidrop.core import STATUSES, Completion, Exchange, Failure, Framing, Message, Permit, build_request
from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.drive.request import any_read
from multidrop.drive.text import Text
from multidrop.errors import (
    BadReply,
    DriveException,
    Expired,
    LineError,
    NoReply,
    NotAttached,
    NotMaster,
    NoValue,
    PortLost,
)
from multidrop.planning.blocks import Block, blocks, halves, least, text_blocks
from multidrop.transport import clock
from multidrop.transport.drive_reads import NO_ROWS, PreparedRead, PreparedReads, make_exchange, make_read
from multidrop.transport.drive_records import Peers
from multidrop.transport.line import Line
from multidrop.transport.network_port import mixed_up, silence_hint
from multidrop.transport.open_port import STALLED


def good_reply(drive: Drive, completion: Completion) -> Message:
    """Return the good reply of a completion. Raises NoReply, BadReply or DriveException."""
    result, reply = completion.result, completion.reply
    if result > 0 and not reply.exception:
        return reply
    if result > 0:
        raise refusal_of(drive, reply.exception)
    if result in (Failure.NO_REPLY, Failure.LATE_ANSWER_DUE, Failure.STALLED):
        raise no_reply(drive, completion)
    advice = mixed_up(_port_of(drive), completion.raw)
    raise BadReply(drive.name, STATUSES[-result] + advice, completion.raw)


def no_reply(drive: Drive, completion: Completion) -> NoReply:
    """Return the error for a silent drive, or for a drive that its gateway reports as silent."""
    if drive.framing is Framing.TCP and completion.raw:
        code = completion.raw[-1]
        where = f" behind the gateway, which says so (exception {code:02X}H)"
        return NoReply(drive.name, where, code=code)
    if drive.bus is None:
        return NoReply(drive.name)
    line = drive.bus.line
    is_stalled = line.is_stalled or completion.result == Failure.STALLED
    hint = f"; but the port is {STALLED}" if is_stalled else silence_hint(line.port)
    where = "" if drive.framing is Framing.TCP else f" at address {drive.address} with {drive.settings}"
    return NoReply(drive.name, where, hint=hint)


def check_master(drive: Drive, completion: Completion) -> None:
    """Raise NotMaster if the request was held back because another process may be the line's master."""
    if completion.result in (Failure.NOT_MASTER, Failure.OTHER_MASTER):
        is_sent = completion.sent_ns > 0
        raise NotMaster(drive.name, _port_of(drive), heard=completion.raw, is_sent=is_sent)


def refusal_of(drive: Drive, code: int, register: str | None = None) -> DriveException:
    """Return the error for an exception code; `register` is the register's name if only one was requested."""
    return DriveException(drive.name, code, drive.exception(code), register)


def no_value(drive: Drive, found: dict[str, Any]) -> NoValue:
    """Return the error for the first register without a value; the error also has the valid values."""
    known = {name: value for name, value in found.items() if value is not None}
    return NoValue(drive.name, next(name for name in found if name not in known), known)


def _port_of(drive: Drive) -> str:
    return drive.bus.line.port if drive.bus else ""


T = TypeVar("T")

READ_ATTEMPTS = 3
# the errors that a read may raise
READ_FAILURES = (NoReply, BadReply, DriveException, LineError, NotAttached, NotMaster)
WRITE_TIMEOUT = 1.0  # s; long, because a write wrongly reported as unconfirmed is worse than a wait
ILLEGAL_FUNCTION = 1  # exception code of an unsupported function; smaller blocks would fail too


class Exchanges:
    """Exchanges with the drives on one line, and the timing learnt from each drive's replies."""

    def __init__(self, line: Line) -> None:
        self.line = line
        self.peers = Peers(line)
        self._answered_on: dict[Drive, object] = {}  # the port object on which each drive last answered
        self._prepared: dict[Drive, PreparedReads] = {}

    def remove(self, drive: Drive) -> None:
        """Remove a drive: later exchanges with it raise NotAttached."""
        self.peers.remove(drive)
        self._answered_on.pop(drive, None)
        self._prepared.pop(drive, None)

    def has_answered(self, drive: Drive) -> bool:
        """Return True if the drive has answered a read since the port was opened."""
        return self._answered_on.get(drive, self) is self.line.queue

    # ---- reading ----

    def read(self, drive: Drive, registers: Sequence[Register[Any] | Text | str]) -> dict[str, Any]:
        """Return the registers' values by name, as `values` does. Reopen a lost port and read again.

        Some gateways close the connection after each reply, so the second attempt reads block by block.
        Raises PortLost if the drive has not answered since the port was opened, or if the port is lost twice
        in a row at the same block.
        """
        try:
            return self.values(drive, registers, READ_ATTEMPTS)
        except PortLost:
            if self.line.queue is not None and not self.has_answered(drive):
                raise
        known = [drive.register(one) if isinstance(one, str) else one for one in registers]
        wanted = [one for one in known if isinstance(one, Register)]
        found: dict[str, Any] = {}
        for block in blocks(drive, wanted):
            try:
                found |= self._again(partial(self.values, drive, block.registers, READ_ATTEMPTS))
            except NoValue as lack:
                found |= {register.name: lack.values.get(register.name) for register in block.registers}
        found = {register.name: found[register.name] for register in wanted}
        if None in found.values():
            raise no_value(drive, found)
        return found

    def read_text(self, drive: Drive, text: Text) -> str:
        """Return a text, as `text` does. If the port is lost, reopen it as `read` does."""
        try:
            return self.text(drive, text)
        except PortLost:
            if self.line.queue is not None and not self.has_answered(drive):
                raise
        reads = (self._again(partial(self._read_block, drive, block)) for block in text_blocks(drive, text))
        return text.decode(b"".join(reads))

    def _again(self, read: Callable[[], T]) -> T:
        """Reopen a lost port and call `read`; if the port is then lost again, repeat both steps once.

        Use this only for a user's own reads, not for a script's: after the port is reopened, a script's
        writes need another identity check.
        """
        self._regain()
        try:
            return read()
        except PortLost:
            self._regain()
            return read()

    def _regain(self) -> None:
        if not self.line.why_closing:
            self.line.regain()

    def values(
        self,
        drive: Drive,
        registers: Sequence[Register[Any] | Text | str],
        attempts: int = READ_ATTEMPTS,
        **details: Any,
    ) -> dict[str, Any]:
        """Return the values of the registers (Register objects or names), by name.

        One request reads a block of adjacent registers. Each block is tried up to `attempts` times. If the
        drive does not answer a whole block, its parts are read instead, also by later calls until the port is
        reopened.

        `details` are arguments of Exchange. With `insists`, each request is sent immediately, even if a late
        reply could be mistaken for its reply. On a slow connection, such a request waits up to `timeout`
        seconds for its reply.

        Raises NoValue if a register holds no valid value, and TextWanted if one of `registers` is a text.
        """
        prepared = self._prepare(drive)
        plan = prepared.newest
        if plan.wanted is not registers:
            plan = prepared.newest = prepared.of(tuple(registers))
        found: dict[str, Any] = {}
        wanted = [*plan.reads]
        while wanted:
            read = wanted.pop()
            parts = prepared.parts.get(read.block) if prepared.parts else None
            if parts is None:
                exchange = read.special(drive, details) if details else read.exchange
                try:
                    into = read.spare.pop()
                except IndexError:
                    into = None
                try:  # a successful read makes as few calls as possible, to be fast: see Completion
                    reply = self.peers.carry_out(drive, exchange, into=into)
                    if reply.count < 0:
                        reply = self._good(drive, exchange, attempts, self._settled(drive, exchange, reply))
                    if reply.count == read.whole:  # fast path, without a call of `decode`
                        values = dict(zip(read.names, reply.numbers.tolist()))  # noqa: B905
                    else:
                        values = read.decode(reply)
                    read.spare.append(reply)
                    self._answered_on[drive] = self.line.queue
                    if read.may_be_too_long:
                        prepared.answered.add(read.block)
                    if read is plan.only and reply.count == read.whole:
                        return values
                    found |= values
                    continue
                except PortLost as failure:
                    self._check_held_back(drive, failure)
                    raise
                except (DriveException, NoReply, BadReply) as failure:
                    parts = self._parts(drive, prepared, read, failure)
            wanted += [prepared.prepare(part) for part in reversed(parts)]
        if None in found.values():
            raise no_value(drive, {name: found[name] for name in plan.names})
        return {name: found[name] for name in plan.names}

    def _parts(
        self, drive: Drive, prepared: PreparedReads, read: PreparedRead, failure: Exception
    ) -> tuple[Block, ...]:
        """Return smaller blocks to read instead of a failed block; raise the failure if they cannot help."""
        block = read.block
        if isinstance(failure, DriveException):
            helps = failure.code != ILLEGAL_FUNCTION and not drive.is_temporary(failure.code)
        else:
            helps = read.may_be_too_long and block not in prepared.answered and self._is_there(drive, block)
        if helps and (parts := halves(drive, block)):
            prepared.parts[block] = parts
            return parts
        if isinstance(failure, DriveException) and len(block.registers) == 1:
            prepared.ask_first(block)
            raise refusal_of(drive, failure.code, block.registers[0].name) from None
        raise failure

    def _is_there(self, drive: Drive, block: Block) -> bool:
        """Return True if the drive answers a request for the block's first register."""
        try:
            self._ask(drive, self._prepare(drive).prepare(least(drive, block)).exchange, 1)
        except (NoReply, BadReply):
            return False
        except DriveException:
            pass
        return True

    def value(
        self,
        drive: Drive,
        register: Register[Any] | Text,
        attempts: int = READ_ATTEMPTS,
        **details: Any,
    ) -> Any:
        if isinstance(register, Text):
            return self.text(drive, register, attempts, **details)
        return self.values(drive, [register], attempts, **details)[register.name]

    def text(self, drive: Drive, text: Text, attempts: int = READ_ATTEMPTS, **details: Any) -> str:
        """Return a text. If it is longer than the family's limit for one read, several requests read it."""
        reads = (self._read_block(drive, block, attempts, **details) for block in text_blocks(drive, text))
        return text.decode(b"".join(reads))

    def _read_block(self, drive: Drive, block: Block, attempts: int = READ_ATTEMPTS, **details: Any) -> bytes:
        read = make_read(drive, block, self.peers.of(drive), **details)
        return self._ask(drive, read, attempts).data

    def _prepare(self, drive: Drive) -> PreparedReads:
        """Return the drive's cached reads, or new ones if the port, the settings or the drive has changed."""
        peer = self.peers.present.get(drive) or self.peers.of(drive)
        asked_as = (drive.address, drive.framing, drive.settings, drive.agreed_silence, drive.response_delay)
        made_for = (peer, self.line.queue, *asked_as)
        prepared = self._prepared.get(drive)
        if prepared is None or prepared.made_for != made_for:
            prepared = self._prepared[drive] = PreparedReads(drive, peer, made_for)
        return prepared

    def value_as(self, other: Drive, drive: Drive, register: Register[Any] | Text) -> Any:
        """Read a register from this drive as if it were `other`, a drive of another family; return the value.

        Each request is sent only once. It is sent even if a late reply could be mistaken for its reply.
        """
        if isinstance(register, Text):
            peer, blocks_of = self.peers.of(drive), text_blocks(other, register)
            asked = [make_read(other, block, peer, insists=True) for block in blocks_of]
            return register.decode(b"".join(self._ask(drive, read, 1).data for read in asked))
        (block,) = blocks(other, [register])
        read = PreparedRead(other, block, self.peers.of(drive))
        found = read.decode(self._ask(drive, read.special(other, {"insists": True}), 1))
        if None in found.values():
            raise no_value(drive, found)
        return found[register.name]

    def ask(
        self, drive: Drive, function: int, start: int, count: int, expiry: float, attempts: int = 1
    ) -> bytes:
        """Read `count` words or bits from address `start` by any read function; return the reply's data.

        The request is sent up to `attempts` times. Raises Expired if the first request cannot be sent within
        `expiry` seconds.
        """
        request = any_read(drive, function, start, count)
        expires_ns = clock.boottime_ns() + round(expiry * 1e9)
        asked = make_exchange(drive, request, self.peers.of(drive), NO_ROWS)
        completion = self._carry_out(drive, asked, expires_ns)
        is_late = completion.result == Failure.LATE_ANSWER_DUE and clock.boottime_ns() >= expires_ns
        if is_late or completion.result == Failure.EXPIRED:
            raise Expired(drive.name, f"a read of {count} from {start} by function {function:02X}H", expiry)
        if attempts > 1:
            completion = self._good(drive, asked, attempts, completion)
        self._note_answer(drive, completion)
        if completion.raw == build_request(drive.framing, request) and not self.line.has_echo:
            raise BadReply(
                drive.name, "the reply is a copy of the request, so it may be an echo", completion.raw
            )
        return good_reply(drive, completion).data

    def _note_answer(self, drive: Drive, completion: Completion) -> None:
        if completion.result > 0:  # true also for an exception, which shows that the drive answers
            self._answered_on[drive] = self.line.queue

    def _ask(self, drive: Drive, exchange: Exchange, attempts: int) -> Completion:
        reply = self._good(drive, exchange, attempts, self._carry_out(drive, exchange))
        self._note_answer(drive, reply)
        return reply

    def _good(self, drive: Drive, exchange: Exchange, attempts: int, completion: Completion) -> Completion:
        """Return the good reply to a read whose first attempt ended with `completion`; retry a failed read.

        If all attempts fail: raises BadReply if bytes were received in any attempt, else NoReply.
        """
        came: BadReply | None = None
        while completion.count < 0:
            attempts -= 1
            self._note_answer(drive, completion)
            try:
                good_reply(drive, completion)  # always raises, because the completion has no good reply
            except (NoReply, BadReply, DriveException) as failure:
                if isinstance(failure, BadReply):
                    came = failure
                is_final = isinstance(failure, DriveException) and failure.code not in drive.damaged
                if came and isinstance(failure, NoReply) and not attempts:
                    raise came from None
                if not attempts or is_final:
                    raise
            completion = self._carry_out(drive, exchange)
        return completion

    # ---- writing ----

    def carry_out(
        self,
        drive: Drive,
        request: Message,
        expires_ns: int = 0,
        *,
        insists: bool = False,
        timeout: float = WRITE_TIMEOUT,
        permit: Permit | None = None,
    ) -> Completion:
        """Send a write once, before queued polling, as soon as no late reply can be mistaken for its reply.

        The write is not sent after `expires_ns` (CLOCK_BOOTTIME; 0: no limit), or after a stop has revoked
        `permit`. Once it is sent, the call waits at least `timeout` seconds for the reply.

        With `insists`, the write is sent without waiting for late replies. On a slow connection, the call
        then waits up to `timeout` seconds for the write's reply.

        Raises NoReply, and sends nothing, if late replies are due and the drive is silent.
        """
        made = make_exchange(
            drive, request, self.peers.of(drive), NO_ROWS, insists=insists, timeout=timeout, permit=permit
        )
        completion = self._carry_out(drive, made, expires_ns)
        if completion.result == Failure.LATE_ANSWER_DUE:
            raise no_reply(drive, completion)
        return completion

    def _carry_out(self, drive: Drive, made: Exchange, expires_ns: int = 0) -> Completion:
        """Carry out the exchange, after late replies if necessary (see `_settled`); return its completion.

        Raises NotMaster if another process may be the line's master.
        """
        try:
            completion = self.peers.carry_out(drive, made, expires_ns=expires_ns)
        except PortLost as failure:
            self._check_held_back(drive, failure)
            raise
        return completion if completion.count >= 0 else self._settled(drive, made, completion, expires_ns)

    def _check_held_back(self, drive: Drive, failure: PortLost) -> None:
        """Raise NotMaster if the request was not sent because this process is not the line's master."""
        if not failure.is_sent and not self.line.may_send:
            raise NotMaster(drive.name, self.line.port) from None

    def _settled(
        self, drive: Drive, made: Exchange, completion: Completion, expires_ns: int = 0
    ) -> Completion:
        """If late replies prevented the exchange, wait for these replies, then carry out the exchange again.

        The wait ends when the exchange expires. After the wait, the C core first sends a proof: a read whose
        reply shows that no earlier reply can still come. Raises NotMaster if another process may be the
        line's master.
        """
        if completion.result == Failure.LATE_ANSWER_DUE:
            wait_ns = completion.late_until_ns - clock.now_ns()
            wait_ns = min(wait_ns, expires_ns + 1 - clock.boottime_ns()) if expires_ns else wait_ns
            port = self.line.queue
            clock.sleep(max(0, wait_ns) / 1e9)
            if made.permit is not None and self.line.queue is not port:
                # a write needs another check of the drive's family on the reopened port
                raise PortLost(
                    self.line.port, "the port was reopened while the write waited for late replies"
                )
            completion = self.peers.carry_out(drive, made, expires_ns=expires_ns)
        check_master(drive, completion)
        return completion
