"""Choose which registers go into which request, so that reading them takes the least time on the wire."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any, cast

from multidrop.core import Framing, Message
from multidrop.drive.family import Drive
from multidrop.drive.register import Register, Table
from multidrop.drive.request import read_request
from multidrop.planning.bus_time import characters, silence


@dataclass(frozen=True)
class Block:
    """Registers of one table, and the request that reads them from a drive together."""

    table: Table
    start: int
    count: int  # of addresses, with those between the registers
    registers: tuple[Register[Any], ...]
    request: Message

    @classmethod
    def of(cls, drive: Drive, registers: Sequence[Register[Any]]) -> Block:
        """Return the block that reads these registers of one table and what lies between them."""
        table, start = registers[0].table, min(register.reach.start for register in registers)
        count = max(register.reach.stop for register in registers) - start
        return cls(table, start, count, tuple(registers), read_request(drive, table, start, count))

    def offset(self, register: Register[Any]) -> int:
        """Return the register's place in the reply's data, in words (coils: bits)."""
        return register.address - self.start


@dataclass(frozen=True)
class Planned:
    """A drive's block that is read every so many seconds; None: as fast as the line allows."""

    drive: Drive
    block: Block
    every: float | None = None


@dataclass(frozen=True)
class Plan:
    """Blocks that read a drive's registers, and the response delays, in s, at which none are quicker."""

    planned: tuple[Planned, ...]
    least: float  # response delay; with a shorter one more requests of fewer characters would be quicker
    most: float  # with a longer one, fewer requests of more characters

    def suits(self, delay: float, margin: float = 0.0) -> bool:
        """Return True where no other plan is quicker at this response delay, give or take that part of it."""
        return self.least * (1 - margin) <= delay <= self.most * (1 + margin)


def plan(
    drive: Drive, wanted: Iterable[tuple[Register[Any], float | None]], delay: float | None = None
) -> Plan:
    """Return the quickest plan that reads each of these registers every so many seconds.

    `delay` is the drive's response delay in s, where it was measured. Registers of a table are read
    together up to the family's limit where that is quicker, also across other registers that can be read,
    and across reserved addresses where the family's document allows that. Registers of different rates
    never share a request: one would be read more often than it is wanted. Raises ValueError for a
    register that cannot be read.
    """
    rates: dict[float | None, list[Register[Any]]] = {}
    for register, every in wanted:
        rates.setdefault(every, []).append(register)
    overhead = silence(drive) + (drive.response_delay if delay is None else delay)  # of a request
    character = drive.settings.character
    found: list[Planned] = []
    least, most = 0.0, math.inf
    for every, registers in rates.items():
        for neighbours in _neighbours(drive, registers):
            ways = _ways(drive.framing, neighbours)
            way = min(ways, key=lambda way: way.requests * overhead + way.characters * character)
            blocks = (Block.of(drive, neighbours.registers[begin:end]) for begin, end in way.spans)
            found += [Planned(drive, block, every) for block in blocks]
            for other in ways:
                if other.requests < way.requests:
                    most = min(most, _even(drive, other, way))
                elif other.requests > way.requests:
                    least = max(least, _even(drive, way, other))
    return Plan(tuple(found), least, most)


def planned(
    drive: Drive, wanted: Iterable[tuple[Register[Any], float | None]], delay: float | None = None
) -> list[Planned]:
    """Return the blocks of that plan."""
    return list(plan(drive, wanted, delay).planned)


def blocks(drive: Drive, registers: Iterable[Register[Any]], delay: float | None = None) -> tuple[Block, ...]:
    """Return the blocks that read these registers once in the least time; see `plan`."""
    found = plan(drive, ((register, None) for register in registers), delay)
    return tuple(each.block for each in found.planned)


def all_blocks(drive: Drive, registers: Iterable[Register[Any]]) -> list[Block]:
    """Return every block that may read neighbours among these registers."""
    return [
        Block.of(drive, neighbours.registers[begin:end])
        for neighbours in _neighbours(drive, registers)
        for end in range(1, len(neighbours.registers) + 1)
        for begin, _ in neighbours.ending_at(end)
    ]


# ---- registers that may share a request ----


@dataclass(frozen=True)
class _Neighbours:
    """Registers of a table by rising address, and which of them one request may read."""

    table: Table
    registers: tuple[Register[Any], ...]
    joined: tuple[bool, ...]  # of each and the next one: all from the one to the other may be read
    limit: int  # that one request may read; a single register is read whole all the same

    def ending_at(self, end: int) -> Iterator[tuple[int, int]]:
        """Yield (begin, count) of each request that may read registers[begin:end]."""
        stop = 0
        for begin in range(end - 1, -1, -1):
            start = self.registers[begin].reach.start
            stop = max(stop, self.registers[begin].reach.stop)
            if begin < end - 1 and (stop - start > self.limit or not self.joined[begin]):
                return
            yield begin, stop - start


def _neighbours(drive: Drive, registers: Iterable[Register[Any]]) -> list[_Neighbours]:
    """Return these registers by table."""
    tables: dict[Table, list[Register[Any]]] = {}
    for register in dict.fromkeys(registers):
        if not register.readable:
            raise ValueError(
                f"{register.name} of {drive.name} cannot be read: it is a {register.access.value}"
            )
        tables.setdefault(register.table, []).append(register)
    found = []
    for table, wanted in tables.items():
        wanted.sort(key=lambda register: (register.reach.start, register.reach.stop))
        readable = _readable(cast(Any, type(drive)), table)
        gaps = drive.readable_gaps.get(table, range(0))
        joined = tuple(
            all(at in readable or at in gaps for at in range(one.reach.stop, other.reach.start))
            for one, other in pairwise(wanted)
        )
        found.append(_Neighbours(table, tuple(wanted), joined, drive.most_registers.get(table, 1)))
    return found


@lru_cache(maxsize=256)
def _readable(family: type[Drive], table: Table) -> frozenset[int]:
    """Return the addresses at which the family has something to read."""
    return frozenset(
        address
        for register in family.registers.values()
        if register.table == table and register.readable
        for address in range(register.address, register.address + register.words)
    )


# ---- ways to cut neighbours into requests ----


@dataclass(frozen=True)
class _Way:
    """The cut of neighbours into so many requests that takes the fewest characters."""

    characters: int  # of the requests and their replies
    spans: tuple[tuple[int, int], ...]  # (begin, end) of each request's registers

    @property
    def requests(self) -> int:
        return len(self.spans)


@lru_cache(maxsize=256)
def _ways(framing: Framing, neighbours: _Neighbours) -> tuple[_Way, ...]:
    """Return each way that is the quickest at some response delay, maybe others too; fewest requests first.

    By dynamic programming over where the last request begins.
    """
    fronts: list[list[_Way]] = [[_Way(0, ())]]  # for the first so many registers
    for end in range(1, len(neighbours.registers) + 1):
        fewest: dict[int, _Way] = {}  # characters, by number of requests
        for begin, count in neighbours.ending_at(end):
            own = characters(framing, neighbours.table, count)
            for before in fronts[begin]:
                known = fewest.get(before.requests + 1)
                if known is None or before.characters + own < known.characters:
                    way = _Way(before.characters + own, (*before.spans, (begin, end)))
                    fewest[way.requests] = way
        fronts.append(_worthwhile(fewest))
    return tuple(fronts[-1])


def _worthwhile(ways: dict[int, _Way]) -> list[_Way]:
    """Leave out ways that need more requests and save no characters by it."""
    kept: list[_Way] = []
    for requests in sorted(ways):
        if not kept or ways[requests].characters < kept[-1].characters:
            kept.append(ways[requests])
    return kept


def _even(drive: Drive, few: _Way, many: _Way) -> float:
    """Return the response delay in s at which few requests take as long as many."""
    saved = (few.characters - many.characters) * drive.settings.character
    return saved / (many.requests - few.requests) - silence(drive)
