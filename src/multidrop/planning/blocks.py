"""Combine registers into requests so that reading them takes the least time on the wire."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate
from typing import Any

from multidrop.core import Framing, Message
from multidrop.drive.family import Drive
from multidrop.drive.link import check_readable
from multidrop.drive.register import Carrier, Register, Table
from multidrop.drive.request import may_be_crossed, read_limit, read_request, stated_limit
from multidrop.drive.text import Text
from multidrop.planning.bus_time import characters, silence


@dataclass(frozen=True)
class Block:
    """A read request (block): the registers that it reads, and the request itself."""

    table: Table
    start: int
    count: int  # number of addresses that the request reads, including those between the registers
    registers: tuple[Register[Any], ...]
    request: Message

    @classmethod
    def of(cls, drive: Drive, registers: Sequence[Register[Any]]) -> Block:
        """Return one request (block) that reads these registers; they must have the same read function."""
        spans = [register.reach for register in registers]
        table, start = registers[0].table, min(span.start for span in spans)
        count = max(span.stop for span in spans) - start
        return cls(table, start, count, tuple(registers), read_request(drive, table, start, count))

    def offset(self, register: Register[Any]) -> int:
        """Return the register's offset in the reply's data, in 16-bit words (coils: in bits)."""
        return register.address - self.start


@dataclass(frozen=True)
class Planned:
    """A read request (block) that is sent every `every` seconds; None: as often as the line allows."""

    drive: Drive
    block: Block
    every: float | None = None


@dataclass(frozen=True)
class Plan:
    """The quickest requests for reading a drive's registers, if its response delay is `least` to `most` s."""

    planned: tuple[Planned, ...]
    least: float  # s; if the response delay is shorter, more and shorter requests would be quicker
    most: float  # s; if the response delay is longer, fewer and longer requests would be quicker

    def suits(self, delay: float, margin: float = 0.0) -> bool:
        """Return True if no other plan is quicker at this response delay, within a relative `margin`."""
        return self.least * (1 - margin) <= delay <= self.most * (1 + margin)


def plan(
    drive: Drive, wanted: Iterable[tuple[Register[Any], float | None]], delay: float | None = None
) -> Plan:
    """Return the quickest plan that reads these registers, each with its period in seconds.

    `delay` is the drive's measured response delay in s; with None the documented one is used. Registers
    that are read by the same function code share a request if that is quicker. The request then also reads
    the addresses between them. These may be readable registers, or reserved addresses if the family's
    document allows reading them. The family limits the length of a request; without such a limit, the Modbus
    standard does. Registers of different rates never share a request, because some would be read too often.
    Registers of one `read_together` group always share a request if they have the same rate. Blocks are in
    the order of the groups. Raises ValueError for a register that cannot be read.
    """
    rates: dict[float | None, list[Register[Any]]] = {}
    for register, every in wanted:
        rates.setdefault(every, []).append(register)
    # seconds that a request takes in addition to its characters
    overhead = silence(drive) + (drive.response_delay if delay is None else delay)
    character = drive.settings.character
    found: list[Planned] = []
    least, most = 0.0, math.inf
    for every, registers in rates.items():
        for neighbours in _neighbours(drive, registers):
            divisions = _divisions(drive.framing, neighbours)
            best = min(divisions, key=lambda one: one.requests * overhead + one.characters * character)
            blocks = (Block.of(drive, neighbours.registers[begin:end]) for begin, end in best.spans)
            found += [Planned(drive, block, every) for block in blocks]
            for other in divisions:
                if other.requests < best.requests:
                    most = min(most, _equal_delay(drive, other, best))
                elif other.requests > best.requests:
                    least = max(least, _equal_delay(drive, best, other))
    return Plan(tuple(in_declared_order(drive, found)), least, most)


def in_declared_order(drive: Drive, found: Iterable[Planned]) -> list[Planned]:
    """Return the requests sorted: first those with registers of `read_together`, in the declared order."""
    places = {name: place for place, group in enumerate(drive.read_together) for name in group}
    return sorted(
        found, key=lambda one: min(places.get(each.name, len(places)) for each in one.block.registers)
    )


def planned(
    drive: Drive, wanted: Iterable[tuple[Register[Any], float | None]], delay: float | None = None
) -> list[Planned]:
    """Return the requests of the quickest plan, each with its period; see `plan`."""
    return list(plan(drive, wanted, delay).planned)


def blocks(drive: Drive, registers: Iterable[Register[Any]]) -> tuple[Block, ...]:
    """Return the requests that read these registers once in the least time; see `plan`."""
    found = planned(drive, ((register, None) for register in registers))
    return tuple(each.block for each in found)


def first_block(drive: Drive) -> Block | None:
    """Return a request for the drive's first reading, else for its first readable register, else None."""
    readable = [*drive.readings(), *(each for each in drive.registers.values() if each.readable)]
    return blocks(drive, readable[:1])[0] if readable else None


def all_requests(
    drive: Drive, registers: Iterable[Register[Any]]
) -> Iterator[tuple[int, tuple[Register[Any], ...], int, int]]:
    """Yield every allowed request that reads at least one of the registers.

    Each request is a tuple (count, registers, begin, end): `count` is its number of addresses, `registers`
    are all registers of the read space in order of address, and the request reads `registers[begin:end]`.
    """
    for neighbours in _neighbours(drive, registers):
        for end in range(1, len(neighbours.registers) + 1):
            for begin, count in neighbours.ending_at(end):
                yield count, neighbours.registers, begin, end


def text_blocks(drive: Drive, text: Text) -> tuple[Block, ...]:
    """Return the requests that read a text register, in order. Each is within the family's limit."""
    limit, end = read_limit(drive, text.table), text.address + text.length
    counts = ((start, min(limit, end - start)) for start in range(text.address, end, limit))
    return tuple(
        Block(text.table, start, count, (), read_request(drive, text.table, start, count))
        for start, count in counts
    )


def sending(drive: Drive, block: Block) -> float:
    """Return the seconds that the characters of this request and its reply take on the wire."""
    return characters(drive.framing, block.table.carrier, block.count) * drive.settings.character


# ---- registers that may share a request ----


@dataclass(frozen=True)
class _Neighbours:
    """Registers that are read by the same function, by address, with the rules for requests that read them.

    Registers may overlap: several may be bits of one 16-bit word.
    """

    carrier: Carrier
    registers: tuple[Register[Any], ...]
    spans: tuple[tuple[int, int], ...]  # each register's first address, and the address after its last one
    # for each register: True if one request may read it together with the next register
    joined: tuple[bool, ...]
    # for each register: True if one request must read it together with the next register
    tied: tuple[bool, ...]
    limit: int  # limit of addresses in a request; a register with more addresses is still read whole

    def ending_at(self, end: int) -> Iterator[tuple[int, int]]:
        """Yield (begin, count) of each allowed request for registers[begin:end]; `count` is in addresses."""
        if end < len(self.registers) and self.tied[end - 1]:
            return
        farthest = max(self.limit, max(stop - start for start, stop in self.spans))
        behind = longest = 0
        for begin in range(end - 1, -1, -1):
            start, stop = self.spans[begin]
            behind, longest = max(behind, stop), max(longest, stop - start)
            count = behind - start
            if begin < end - 1 and (count > farthest or not self.joined[begin]):
                return
            if count <= max(self.limit, longest) and not (begin and self.tied[begin - 1]):
                yield begin, count


def _neighbours(drive: Drive, registers: Iterable[Register[Any]]) -> list[_Neighbours]:
    """Group these registers by read function, each group sorted by address."""
    spaces: dict[object, list[tuple[range, Register[Any]]]] = {}
    for register in dict.fromkeys(registers):
        check_readable(drive, register)
        spaces.setdefault(register.table.read_space, []).append((register.reach, register))
    return [_side_by_side(drive, wanted) for wanted in spaces.values()]


def _side_by_side(drive: Drive, wanted: list[tuple[range, Register[Any]]]) -> _Neighbours:
    wanted.sort(key=lambda each: (each[0].start, each[0].stop))
    table = wanted[0][1].table
    behind = accumulate((span.stop for span, _ in wanted), max)
    joined = [
        other.start <= stop or may_be_crossed(drive, table, range(stop, other.start))
        for stop, (other, _) in zip(behind, wanted[1:], strict=False)
    ]
    places = {register.name: place for place, (_, register) in enumerate(wanted)}
    tied = [False] * len(joined)
    for group in drive.read_together:
        inside = [places[name] for name in group if name in places]
        for first, last in [(min(inside), max(inside))] if inside else []:
            tied[first:last] = [True] * (last - first)
    return _Neighbours(
        table.carrier,
        tuple(register for _, register in wanted),
        tuple((span.start, span.stop) for span, _ in wanted),
        tuple(joined),
        tuple(tied),
        read_limit(drive, table),
    )


# ---- dividing neighbours into requests ----


@dataclass(frozen=True)
class _Division:
    """One way to divide registers into requests, with the fewest characters for that many requests."""

    characters: int  # characters of all requests and their replies
    spans: tuple[tuple[int, int], ...]  # begin and end of each request, which reads registers[begin:end]

    @property
    def requests(self) -> int:
        return len(self.spans)


@lru_cache(maxsize=256)
def _divisions(framing: Framing, neighbours: _Neighbours) -> tuple[_Division, ...]:
    """Return the ways to divide these registers into requests that may be the quickest.

    They are sorted by number of requests. Few requests are quickest if the drive's response delay is long;
    few characters, if it is short. The algorithm is dynamic programming over the first register of the last
    request.
    """
    # item n: ways to divide the first n registers into requests
    fronts: list[list[_Division]] = [[_Division(0, ())]]
    for end in range(1, len(neighbours.registers) + 1):
        fewest: dict[int, _Division] = {}  # ways with the fewest characters, by number of requests
        for begin, count in neighbours.ending_at(end):
            own = characters(framing, neighbours.carrier, count)
            for before in fronts[begin]:
                known = fewest.get(before.requests + 1)
                if known is None or before.characters + own < known.characters:
                    longer = _Division(before.characters + own, (*before.spans, (begin, end)))
                    fewest[longer.requests] = longer
        fronts.append(_worthwhile(fewest))
    return tuple(fronts[-1])


def _worthwhile(divisions: dict[int, _Division]) -> list[_Division]:
    """Drop the ways that need more requests than another way, and at least as many characters."""
    kept: list[_Division] = []
    for requests in sorted(divisions):
        if not kept or divisions[requests].characters < kept[-1].characters:
            kept.append(divisions[requests])
    return kept


def _equal_delay(drive: Drive, few: _Division, many: _Division) -> float:
    """Return the response delay in s at which few and many requests take equally long."""
    saved = (few.characters - many.characters) * drive.settings.character
    return saved / (many.requests - few.requests) - silence(drive)


def halves(drive: Drive, block: Block) -> tuple[Block, ...]:
    """Return two smaller requests (blocks) that together read the same registers; () if there are none.

    Registers at the same address stay in one block, and so do those of a group in `read_together`. Splitting
    a block of n registers repeatedly gives at most 2 n - 1 blocks, including the block itself.
    """
    units = _units(drive, block)
    if len(units) < 2:
        return ()
    middle = len(units) // 2
    parts = units[:middle], units[middle:]
    return tuple(Block.of(drive, [register for unit in part for register in unit]) for part in parts)


def _units(drive: Drive, block: Block) -> list[list[Register[Any]]]:
    """Return the smallest groups into which a request can be split, sorted by address."""
    groups = {name: place for place, group in enumerate(drive.read_together) for name in group}
    found: dict[object, list[Register[Any]]] = {}
    for register in block.registers:
        span = register.reach
        found.setdefault(groups.get(register.name, (span.start, span.stop)), []).append(register)
    return list(found.values())


def may_be_too_long(drive: Drive, block: Block) -> bool:
    """Return True if the request is possibly too long for the drive: its class states no limit."""
    return stated_limit(drive, block.table) is None and len(_units(drive, block)) > 1


def least(drive: Drive, block: Block) -> Block:
    """Return a short request: for the block's first register, and for those that must be read with it."""
    return Block.of(drive, _units(drive, block)[0])
