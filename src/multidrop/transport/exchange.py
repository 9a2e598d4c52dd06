"""Exchanges with the drives on a line, one at a time and ahead of any polling: what is read from them."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from multidrop import core
from multidrop.core import STATUSES, Completion, Exchange, Failure, Message, Peer, Permit, raw_value
from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.errors import BadReply, DriveRefused, NoReply, NotAttached
from multidrop.planning.blocks import Block, alone, blocks
from multidrop.planning.bus_time import silence
from multidrop.planning.proofs import proofs
from multidrop.transport.clock import now_ns, sleep
from multidrop.transport.line import Line

READ_ATTEMPTS = 3
LEAST_TIMEOUT = 0.02  # s: what a host and its adapter may add to a drive's own delay
WRITE_TIMEOUT = 1.0  # s: a write that is wrongly told to be unconfirmed costs more than the wait
MOST_PREPARED = 256  # sets of registers, and blocks, of one drive; those that were not read for longest go
NO_ROWS = core.RowLayout(0, [])  # of a command: a poll's summary counts the values of its rows alone


def exchange(
    drive: Drive,
    request: Message,
    peer: Peer,
    block: core.RowLayout | None = None,
    *,
    period: float = 0.0,
    insists: bool = False,
    timeout: float = 0.0,
    answer: tuple[int, int] | None = None,
    echo_probe: Exchange | None = None,
    permit: Permit | None = None,
) -> Exchange:
    """What the core needs to carry out a request to this drive."""
    settings = drive.settings
    return Exchange(
        drive.framing,
        request,
        peer,
        baudrate=settings.baudrate,
        format=settings.format,
        character=settings.character,
        silence=silence(drive),
        turnaround=drive.turnaround_delay,
        period=period,
        insists=insists,
        timeout=timeout,
        answer=answer,
        block=block,
        echo_probe=echo_probe,
        permit=permit,
    )


def reading(
    drive: Drive,
    block: Block,
    peer: Peer,
    rows: core.RowLayout = NO_ROWS,
    *,
    period: float = 0.0,
    insists: bool = False,
    timeout: float = 0.0,
) -> Exchange:
    """What reads a block from this drive, whose reply is not taken from an adapter's echo."""
    echo_probe = None
    if drive.telling and drive.telling not in block.registers:
        echo_probe = exchange(drive, alone(drive.telling).request(drive.address), peer, NO_ROWS)
    request = block.request(drive.address)
    return exchange(
        drive, request, peer, rows, period=period, insists=insists, timeout=timeout, echo_probe=echo_probe
    )


class Prepared:
    """What reads a drive's registers: made once, as long as all that it was made for is as it was."""

    def __init__(self, drive: Drive, peer: Peer, made_for: tuple[object, ...]) -> None:
        self.made_for = made_for

        @lru_cache(MOST_PREPARED)
        def best(registers: tuple[Register[Any], ...]) -> tuple[Block, ...]:
            return blocks(drive, registers)

        @lru_cache(MOST_PREPARED)
        def read(block: Block) -> Exchange:
            return reading(drive, block, peer)

        self.blocks = best
        self.exchange = read


class Exchanges:
    """What passes between a line and its drives, and what is learnt of each drive from it."""

    def __init__(self, line: Line) -> None:
        self.line = line
        self._peers: dict[Drive, Peer] = {}
        self._known: dict[tuple[object, ...], Peer] = {}  # by what they are, also of those that left
        self._heard: dict[Drive, object] = {}  # the open port on which it answered last
        self._prepared: dict[Drive, Prepared] = {}

    def add(self, drive: Drive) -> None:
        documented = max(LEAST_TIMEOUT, drive.answering_time, 4 * drive.response_delay)
        least = min(drive.response_timeout, documented)
        asked_as = type(drive), drive.framing, drive.settings, silence(drive), least, drive.response_timeout
        key = drive.address, *asked_as
        if key not in self._known:  # the core may be asking a proof of one that has left
            made = self._known[key] = Peer(least_timeout=least, most_timeout=drive.response_timeout)
            made.prove_by(
                [
                    exchange(drive, block.request(drive.address), made, NO_ROWS, answer=answer)
                    for block, answer in proofs(drive)
                ]
            )
        # One that comes back may still owe the answer to what it was asked before it left, and one of
        # another family at its address would get that.
        peer = self._peers[drive] = self._known[key]
        for other, known in self._known.items():
            if other[0] == drive.address and known is not peer:
                self.line.inherit(peer, known)

    def remove(self, drive: Drive) -> None:
        del self._peers[drive]
        self._heard.pop(drive, None)
        self._prepared.pop(drive, None)

    @property
    def peers(self) -> dict[Drive, Peer]:
        """All that are on the line now; drives may come and go meanwhile, on any thread."""
        return dict(self._peers)

    def peer(self, drive: Drive) -> Peer:
        """What is known of how this drive answers; ValueError for a drive that is not on this bus."""
        peer = self._peers.get(drive)
        if peer is None:
            raise NotAttached(f"{drive.name} is not attached to this bus: use bus.attach(...)")
        return peer

    def is_heard(self, drive: Drive) -> bool:
        """Whether it has answered since the port was opened."""
        return self._heard.get(drive, self) is self.line.queue

    def values(
        self,
        drive: Drive,
        registers: list[Register[Any]],
        attempts: int,
        *,
        insists: bool = False,
        timeout: float = 0.0,
    ) -> dict[str, Any]:
        """Registers' values by name, each block asked for so many times until it is answered.

        One that insists waits for no earlier answer, which may then pass for its own; and for its own, where
        answers are known to be late, for as long as `timeout` seconds.
        """
        raw: dict[str, Any] = {}
        for block in self._prepare(drive).blocks(tuple(registers)):
            reply = self._ask(drive, block, attempts, insists, timeout)
            for register in block.registers:
                raw[register.name] = register.decode(
                    raw_value(reply.data, block.offset(register), register.number_format)
                )
        return {register.name: raw[register.name] for register in registers}

    def _prepare(self, drive: Drive) -> Prepared:
        """What is prepared for this drive, if nothing has changed since; else what will be from now on."""
        peer = self.peer(drive)
        made_for = (
            peer,
            self.line.queue,
            drive.address,
            drive.framing,
            drive.settings,
            drive.agreed_silence,
            drive.response_delay,
        )
        prepared = self._prepared.get(drive)
        if prepared is None or prepared.made_for != made_for:
            prepared = self._prepared[drive] = Prepared(drive, peer, made_for)
        return prepared

    def values_as(self, other: Drive, drive: Drive, register: Register[Any]) -> dict[str, Any]:
        """What a drive says to the question of another family, asked once, without waiting for anything."""
        (block,) = blocks(other, [register])
        made = reading(other, block, self.peer(drive), insists=True)
        reply = self._read(drive, self._carry_out(made))
        return {
            register.name: register.decode(
                raw_value(reply.data, block.offset(register), register.number_format)
            )
        }

    def _ask(self, drive: Drive, block: Block, attempts: int, insists: bool, timeout: float) -> Message:
        if insists:
            made = reading(drive, block, self.peer(drive), insists=True, timeout=timeout)
        else:
            made = self._prepare(drive).exchange(block)
        for _ in range(attempts - 1):
            try:
                return self._read(drive, self._carry_out(made))
            except (NoReply, BadReply):
                continue
            except DriveRefused as refusal:
                if refusal.code not in drive.damaged:
                    raise
        return self._read(drive, self._carry_out(made))

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
        """Write once, ahead of any polling; first an answer that may still come late is waited for.

        After `expires_ns` (0: never), and without a good permit, it is not sent. Its answer is waited for
        for `timeout` seconds at least. One that insists waits for no earlier answer, and for its own, where
        answers are known to be late, for as long as `timeout`. Raises NoReply, and nothing was sent,
        where answers may still come late and the drive is silent.
        """
        made = exchange(
            drive,
            request,
            self.peer(drive),
            NO_ROWS,
            insists=insists,
            timeout=timeout,
            permit=permit,
        )
        completion = self._carry_out(made, expires_ns)
        if completion.result == Failure.LATE_ANSWER_DUE:
            raise NoReply(drive.name)
        return completion

    def _carry_out(self, made: Exchange, expires_ns: int = 0) -> Completion:
        """Wait once until no late answer comes in any order; the core then asks for the proof of it."""
        late_until_ns = made.peer.late_until_ns
        completion = self.line.carry_out(made, expires_ns=expires_ns)
        if completion.result != Failure.LATE_ANSWER_DUE:
            return completion
        sleep(max(0, late_until_ns - now_ns()) / 1e9)
        return self.line.carry_out(made, expires_ns=expires_ns)

    def reply(self, drive: Drive, completion: Completion) -> Message:
        """The good reply; raises NoReply, BadReply or DriveRefused."""
        if completion.result in (Failure.NO_REPLY, Failure.LATE_ANSWER_DUE):
            raise NoReply(drive.name)
        if completion.result <= 0:
            raise BadReply(drive.name, STATUSES[-completion.result], completion.raw)
        if completion.reply.exception:
            code = completion.reply.exception
            raise DriveRefused(drive.name, code, drive.exception(code))
        return completion.reply

    def _read(self, drive: Drive, completion: Completion) -> Message:
        """The reply to a read: that the drive is there, an exception says too."""
        if completion.result > 0:
            self._heard[drive] = self.line.queue
        return self.reply(drive, completion)
