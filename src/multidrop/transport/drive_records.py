"""Keep for each drive the C core's record of it (`Peer`), and the exchanges that read its registers.

The record has the learnt timing, and the requests to which late replies may still come. It is kept even while
the drive is off the line.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from multidrop.core import (
    Completion,
    Exchange,
    Framing,
    Message,
    Peer,
    RowLayout,
    TransactionIds,
    is_pseudo_terminal,
)
from multidrop.drive.family import Drive, check_drive, check_own
from multidrop.drive.link import TextWanted
from multidrop.drive.number_format import FLOATS
from multidrop.drive.register import Register, row_field
from multidrop.drive.text import Text
from multidrop.errors import NotAttached
from multidrop.planning.blocks import Block, blocks, may_be_too_long
from multidrop.planning.bus_time import silence
from multidrop.planning.proofs import proofs
from multidrop.transport import clock, port_identity
from multidrop.transport.line import Line

# how long the records of a closed port's drives are kept; late.c expects late replies for the same time
KEPT_NS = 120_000_000_000


class FormerPeers(NamedTuple):
    """Records of drives whose late replies were still due when their port was closed, with addresses."""

    closed_ns: int
    peers: tuple[tuple[int, Peer], ...]


_former: dict[str, FormerPeers] = {}  # by identity of the port; every change is atomic, so no lock is needed


def identities_of(*names: str) -> set[str]:
    """Return the identity of an open port for each of its names.

    The identity of a pseudo-terminal includes its creation time, because its number is soon reused.
    """
    found = {port_identity.of_name(name) for name in names}
    return {f"{name} of {_made_ns(name)}" if is_pseudo_terminal(name) else name for name in found}


def _made_ns(device: str) -> int:
    try:
        return Path(device).stat().st_ctime_ns
    except OSError:  # the device is gone: return a unique time, so that no later device matches
        return clock.now_ns()


def remember_former_peers(names: Iterable[str], peers: Iterable[tuple[int, Peer]]) -> None:
    """When a port is closed, keep the records of those drives that may still send late replies.

    The records are kept under each name of the port. `peers` are pairs of a drive's address and its record.
    """
    now_ns = clock.now_ns()
    for name, former in [*_former.items()]:
        if now_ns - former.closed_ns > KEPT_NS:
            _former.pop(name, None)
    owing = tuple((address, peer) for address, peer in peers if peer.owes)
    if owing:
        _former.update(dict.fromkeys(names, FormerPeers(now_ns, owing)))


def former_at(names: Iterable[str], address: int) -> Iterator[Peer]:
    """Yield the kept records of drives that had this address when the port was closed."""
    for name in names:
        former = _former.get(name)
        yield from (peer for at, peer in former.peers if at == address) if former else ()


GONE_S = 0.001  # s between checks whether a removed drive's exchange has ended
LEAST_TIMEOUT = 0.02  # s; time allowed at least for a reply, because computer and adapter delay it too


class Peers:
    """The C core's records of the drives on one line.

    Threads may read the records while one thread adds or removes a drive.
    """

    def __init__(self, line: Line) -> None:
        self._line = line
        self.present: dict[Drive, Peer] = {}  # records of the drives that are on the line now
        self._asked: dict[
            object, Peer
        ] = {}  # the drive's record, for each exchange that a thread is carrying out
        # Records of present and removed drives, by the drive's address and description.
        self._known: dict[tuple[int, *tuple[object, ...]], Peer] = {}

    def add(self, drive: Drive) -> None:
        """Add a drive. A drive that was on the line before gets its earlier record, with its learnt timing.

        First wait until no exchange with an earlier drive at this address is in flight. Until then, it is
        unknown which replies of the earlier drive are late.
        """
        for other, known in self._known.items():
            while other[0] == drive.address and self._is_asked(known):
                clock.sleep(GONE_S)
        documented = max(LEAST_TIMEOUT, drive.answering_time, 4 * drive.response_delay)
        least = min(drive.response_timeout, documented)
        asked_as = type(drive), drive.framing, drive.settings, silence(drive), least, drive.response_timeout
        key = drive.address, *asked_as
        # a known record is used again and never replaced, because the C core's thread may still be reading it
        if key not in self._known:
            self._known[key] = self._new(drive, least)
        peer = self.present[drive] = self._known[key]
        # a late reply of an earlier drive at this address must not be taken for a reply of this drive
        for other, known in self._known.items():
            if other[0] == drive.address and known is not peer:
                self._line.inherit(peer, known)
        for former in former_at(self._names(), drive.address):
            self._line.inherit(peer, former)

    def _new(self, drive: Drive, least: float) -> Peer:
        peer = Peer(least_timeout=least, most_timeout=drive.response_timeout, interval=drive.least_interval)
        has_ids = drive.framing is Framing.TCP and self._line.ids is TransactionIds.MATCH
        found = () if has_ids else proofs(drive)
        peer.prove_by(
            [make_exchange(drive, block.request, peer, NO_ROWS, answer=answer) for block, answer in found]
        )
        if drive.answers_every_read:
            peer.doubt_first_reply()
        return peer

    def close(self) -> None:
        """Close the line. If it is opened again, replies to earlier requests are recognised as late."""
        names = self._names()
        self._line.close()
        remember_former_peers(names, [(address, peer) for (address, *_), peer in self._known.items()])

    def _names(self) -> set[str]:
        return identities_of(self._line.identity, self._line.port)

    def remember(self, before: Peers) -> None:
        """Take over the records of all present and removed drives of an earlier bus on the same line."""
        self._known.update(before._known)

    def remove(self, drive: Drive) -> None:
        """Remove a drive from the line, but keep its record."""
        del self.present[drive]

    def of(self, drive: Drive) -> Peer:
        """Return the C core's record of a drive. Raises NotAttached for a drive that is not on this bus."""
        peer = self.present.get(drive) if isinstance(drive, Drive) else None
        if peer is None:
            check_drive(drive)
            raise _not_attached(drive)
        return peer

    def carry_out(
        self, drive: Drive, made: Exchange, *, expires_ns: int = 0, into: Completion | None = None
    ) -> Completion:
        """Carry out an exchange on the line. Raises NotAttached if the drive was removed meanwhile."""
        asking = object()
        # even if a signal interrupts, remove the entry from `_asked`: otherwise `add` would wait forever
        try:
            # set before the check, so that `add` of another drive at this address waits for this exchange
            self._asked[asking] = made.peer
            if self.present.get(drive) is not made.peer:
                raise _not_attached(drive)
            return self._line.carry_out(made, expires_ns=expires_ns, into=into)
        finally:
            self._asked.pop(asking, None)

    def is_asking(self, peer: Peer) -> bool:
        """Return True while an exchange with this drive is about to start, queued or in flight."""
        return self._is_asked(peer) or self._line.is_asking(peer)

    def _is_asked(self, peer: Peer) -> bool:
        return peer in self._asked.copy().values()


def _not_attached(drive: Drive) -> NotAttached:
    return NotAttached(f"{drive.name} is not attached to this bus: use bus.attach(...)")


# ---- the exchanges of a drive's reads ----


MOST_EXACT = 1 << 53  # every whole number up to this limit is exact as a float


def _is_exact(register: Register[Any]) -> bool:
    """Return True if the C core, which uses floats, gives the same value as `Register.value_in`."""
    coding = register.coding
    if register.scaled_by is not None:
        return False
    if coding.number_format in FLOATS:
        return True
    multiplier, addend, divisor = coding.factors
    most = max(map(abs, coding.raw_span)) * abs(multiplier) + abs(addend)
    return most <= MOST_EXACT and divisor <= MOST_EXACT


class BlockDecoder:
    """Decoder for the reply to a read of a block, which has `registers` from address `start`."""

    def __init__(self, registers: tuple[Register[Any], ...], start: int) -> None:
        places = [(register, register.address - start) for register in registers]
        exact = [(register, at) for register, at in places if _is_exact(register)]
        # Names of the registers that the C core decodes.
        self.names = tuple(register.name for register, _ in exact)
        self.layout = RowLayout(0, [row_field(register, at, 0) for register, at in exact])
        self.count = len(exact)
        self._named = [(one.name, one.decode) for one, _ in exact if one.values is not None or one.is_bit]
        self._others = [(register, at) for register, at in places if not _is_exact(register)]
        self.is_plain = not (self._named or self._others)

    def decode(self, reply: Completion) -> dict[str, Any]:
        """Return the values by register name; None for a register without a value."""
        found: dict[str, Any] = dict(zip(self.names, reply.values_of(self.layout), strict=True))
        for name, decode in self._named:
            if found[name] is not None:
                found[name] = decode(found[name])
        if self._others:
            data = reply.data
            for register, at in self._others:
                found[register.name] = register.value_in(data, at)
        return found


@lru_cache(maxsize=256)
def _shared(registers: tuple[Register[Any], ...], start: int) -> BlockDecoder:
    return BlockDecoder(registers, start)


def decoder_of(block: Block) -> BlockDecoder:
    """Return the block's decoder, which all drives with the same registers share."""
    return _shared(block.registers, block.start)


MOST_PREPARED = 256  # limit of a drive's cached read plans, and of its cached blocks
# the rows of an exchange that is not polled: none, so the summary of polling does not count its values
NO_ROWS = RowLayout(0, [])


def make_exchange(
    drive: Drive, request: Message, peer: Peer, rows: RowLayout | None = None, **details: Any
) -> Exchange:
    """Return an exchange that sends this request to this drive. `details` are arguments of Exchange."""
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
        block=rows,
        **details,
    )


def make_read(drive: Drive, block: Block, peer: Peer, rows: RowLayout = NO_ROWS, **details: Any) -> Exchange:
    """Return an exchange that reads a block.

    If the drive has an echo probe (a register whose reply is never a copy of its request), the C core can
    read it first to find out whether the adapter echoes. A block with that register needs no probe.
    """
    probe, register = None, drive.echo_probe
    if register and register not in block.registers:
        probe = make_exchange(drive, Block.of(drive, [register]).request, peer, NO_ROWS)
    return make_exchange(drive, block.request, peer, rows, echo_probe=probe, **details)


class PreparedRead:
    """A block of one drive's registers, with the exchange that reads it and the decoder of its reply."""

    def __init__(self, drive: Drive, block: Block, peer: Peer) -> None:
        decoder = decoder_of(block)
        self.block = block
        self.exchange = make_read(drive, block, peer, values=decoder.layout)
        self.may_be_too_long = may_be_too_long(drive, block)
        self.decode = decoder.decode
        self.names = decoder.names
        self.whole = decoder.count if decoder.is_plain else None  # number of values in a complete reply
        self.spare: list[Completion] = []  # completions that later reads reuse

    def insisting(self, drive: Drive, timeout: float) -> Exchange:
        """Return an exchange that reads the block without waiting for late replies; `timeout` is in s."""
        peer, values = self.exchange.peer, self.exchange.values
        return make_read(drive, self.block, peer, values=values, insists=True, timeout=timeout)


class ReadPlan:
    """The requests that read one list of registers.

    `reads` has the last request first, because the caller takes requests from its end. `wanted` has the
    registers or their names, as the caller gave them. If one request returns all values in the order of
    `wanted`, it is `only`; otherwise `only` is None.
    """

    __slots__ = ("names", "only", "reads", "wanted")

    def __init__(
        self,
        wanted: tuple[object, ...],
        registers: tuple[Register[Any], ...],
        reads: tuple[PreparedRead, ...],
    ) -> None:
        self.wanted = wanted
        self.reads = reads
        self.names = tuple(register.name for register in registers)
        self.only = reads[0] if len(reads) == 1 and reads[0].names == self.names else None


NOTHING = ReadPlan((), (), ())


class PreparedReads:
    """The cached reads of one drive, for one port and one set of line settings."""

    def __init__(self, drive: Drive, peer: Peer, made_for: tuple[object, ...]) -> None:
        self.made_for = made_for

        @lru_cache(MOST_PREPARED)
        def prepare(block: Block) -> PreparedRead:
            return PreparedRead(drive, block, peer)

        @lru_cache(MOST_PREPARED)
        def of(wanted: tuple[Any, ...]) -> ReadPlan:
            if any(isinstance(one, Text) or one in drive.texts for one in wanted):
                raise TextWanted
            registers = tuple(drive.register(one) if isinstance(one, str) else one for one in wanted)
            for register in registers:
                check_own(drive, register)
            return ReadPlan(wanted, registers, tuple(map(prepare, reversed(blocks(drive, registers)))))

        self.of = of
        self.newest = NOTHING  # the last plan, used again without a search if the same tuple is read
        self.prepare = prepare
        # for each block that the drive does not answer as a whole: the smaller blocks to read instead
        self.parts: dict[Block, tuple[Block, ...]] = {}
        # blocks that the drive has answered although they might be too long for it
        self.answered: set[Block] = set()

    def ask_first(self, block: Block) -> None:
        """Read this block, which the drive has refused, first when a read is split into several requests.

        If the drive refuses it again, the whole read fails, and the other requests would waste bus time.
        """
        for whole, parts in [*self.parts.items()]:
            if block in parts:
                self.parts[whole] = (block, *(part for part in parts if part != block))
                self.ask_first(whole)
