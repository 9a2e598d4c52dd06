"""Create the exchanges for a drive's requests, and cache the exchanges that read its registers."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from multidrop.core import Completion, Exchange, Message, Peer, RowLayout
from multidrop.drive.family import Drive
from multidrop.drive.link import TextWanted, check_own
from multidrop.drive.number_format import FLOATS
from multidrop.drive.register import Register, row_field
from multidrop.drive.text import Text
from multidrop.planning.blocks import Block, blocks, may_be_too_long
from multidrop.planning.bus_time import silence

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

    def special(self, drive: Drive, details: dict[str, Any]) -> Exchange:
        """Return another exchange that reads the block; `details` are arguments of Exchange."""
        return make_read(drive, self.block, self.exchange.peer, values=self.exchange.values, **details)


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
