"""Which registers go into which request, in which order, and how long that takes on the wire. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any

from multidrop.core import Framing, Message
from multidrop.drive.family import Drive
from multidrop.drive.register import Carrier, Register, Table
from multidrop.planning.bus_time import characters, silence


@dataclass(frozen=True)
class Block:
    """Registers of one table that one request fetches."""

    table: Table
    start: int
    count: int
    registers: tuple[Register[Any], ...]

    def request(self, address: int) -> Message:
        if self.table.read is None:
            raise ValueError(f"a {self.table.name} cannot be read")
        if self.table.carrier in (Carrier.LONG, Carrier.NUMBER):
            return Message(address, self.table.read, self.start, data=bytes(4))
        return Message(address, self.table.read, self.start, self.count)

    def offset(self, register: Register[Any]) -> int:
        """Where the register lies in the reply's data, in words (coils: bits)."""
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
        """Whether these blocks are the best at this response delay, or it is off by this part at most."""
        return self.least * (1 - margin) <= delay <= self.most * (1 + margin)


@dataclass(frozen=True)
class Way:
    """One way to read registers of a table: of all with as many requests the one of the fewest characters."""

    characters: int  # of the requests and their replies
    blocks: tuple[Block, ...]

    @property
    def requests(self) -> int:
        return len(self.blocks)


def plan(
    drive: Drive, wanted: Iterable[tuple[Register[Any], float | None]], delay: float | None = None
) -> Plan:
    """The plan that reads these registers, each as often as is wanted, with this response delay.

    Registers of different rates never share a block: what is asked for more seldom would be read
    more often than it is wanted. Raises ValueError for a register that cannot be read.
    """
    rates: dict[float | None, list[Register[Any]]] = {}
    for register, every in wanted:
        rates.setdefault(every, []).append(register)
    delay = drive.response_delay if delay is None else delay
    found: list[Planned] = []
    least, most = 0.0, math.inf
    for every, registers in rates.items():
        for neighbours in _neighbours(drive, registers):
            ways = _ways(drive.framing, neighbours)
            way = min(ways, key=lambda way: _duration(drive, way, delay))
            found += [Planned(drive, block, every) for block in way.blocks]
            for other in ways:
                if other.requests < way.requests:
                    most = min(most, _even(drive, other, way))
                elif other.requests > way.requests:
                    least = max(least, _even(drive, way, other))
    return Plan(tuple(found), least, most)


def planned(
    drive: Drive, wanted: Iterable[tuple[Register[Any], float | None]], delay: float | None = None
) -> list[Planned]:
    """The blocks of that plan."""
    return list(plan(drive, wanted, delay).planned)


def _duration(drive: Drive, way: Way, delay: float) -> float:
    return way.requests * (silence(drive) + delay) + way.characters * drive.settings.character


def _even(drive: Drive, few: Way, many: Way) -> float:
    """The response delay in s at which few requests take as long as many."""
    saved = (few.characters - many.characters) * drive.settings.character
    return saved / (many.requests - few.requests) - silence(drive)


def alone(register: Register[Any]) -> Block:
    """The block that reads one register and nothing else."""
    return Block(register.table, register.address, register.words, (register,))


def blocks(drive: Drive, registers: Iterable[Register[Any]], delay: float | None = None) -> tuple[Block, ...]:
    """The requests that read these registers in the least time, with the drive's response delay.

    Registers of a table are read together up to the family's limit, where that is the quicker way
    also across others that can be read, and across reserved addresses where the family's document
    allows that. Raises ValueError for a register that cannot be read.
    """
    return tuple(it.block for it in plan(drive, ((register, None) for register in registers), delay).planned)


@dataclass(frozen=True)
class _Neighbours:
    """Registers of a table by rising address, and which of them one request may read."""

    table: Table
    registers: tuple[Register[Any], ...]
    joined: tuple[bool, ...]  # of each and the next one: all from the one to the other may be read
    limit: int  # that one request may read; a single register is read whole all the same

    def blocks(self, end: int) -> Iterator[tuple[int, Block]]:
        """The blocks that end before the register of this number, each with that of its first one."""
        stop = 0
        for begin in range(end - 1, -1, -1):
            start = self.registers[begin].address
            stop = max(stop, start + self.registers[begin].words)
            if begin < end - 1 and (stop - start > self.limit or not self.joined[begin]):
                return
            yield begin, Block(self.table, start, stop - start, self.registers[begin:end])


def _neighbours(drive: Drive, registers: Iterable[Register[Any]]) -> list[_Neighbours]:
    """These registers, for each table."""
    tables: dict[Table, list[Register[Any]]] = {}
    for register in dict.fromkeys(registers):
        if not register.readable:
            raise ValueError(
                f"{register.name} of {drive.name} cannot be read: it is a {register.access.value}"
            )
        tables.setdefault(register.table, []).append(register)
    found = []
    for table, wanted in tables.items():
        wanted.sort(key=lambda register: (register.address, register.words))
        readable, gaps = _readable(drive, table, wanted), drive.readable_gaps.get(table, range(0))
        joined = tuple(
            all(at in readable or at in gaps for at in range(one.address, other.address))
            for one, other in pairwise(wanted)
        )
        found.append(_Neighbours(table, tuple(wanted), joined, drive.most_registers.get(table, 1)))
    return found


def runs(drive: Drive, registers: Iterable[Register[Any]]) -> list[Block]:
    """Return every request that may read neighbours among these registers."""
    return [
        block
        for neighbours in _neighbours(drive, registers)
        for end in range(1, len(neighbours.registers) + 1)
        for _, block in neighbours.blocks(end)
    ]


@lru_cache(maxsize=256)
def _ways(framing: Framing, neighbours: _Neighbours) -> tuple[Way, ...]:
    """All ways that are the quickest at some response delay, and maybe others; the fewest requests first.

    By dynamic programming over where the last block begins.
    """
    fronts: list[list[Way]] = [[Way(0, ())]]  # for the first so many registers
    for end in range(1, len(neighbours.registers) + 1):
        fewest: dict[int, Way] = {}  # characters, by number of requests
        for begin, block in neighbours.blocks(end):
            own = characters(framing, block.table, block.count)
            for before in fronts[begin]:
                known = fewest.get(before.requests + 1)
                if known is None or before.characters + own < known.characters:
                    way = Way(before.characters + own, (*before.blocks, block))
                    fewest[way.requests] = way
        fronts.append(_worthwhile(fewest))
    return tuple(fronts[-1])


def _worthwhile(ways: dict[int, Way]) -> list[Way]:
    """Without those that need more requests and save no characters by it."""
    kept: list[Way] = []
    for requests in sorted(ways):
        if not kept or ways[requests].characters < kept[-1].characters:
            kept.append(ways[requests])
    return kept


def _readable(drive: Drive, table: Table, registers: Iterable[Register[Any]]) -> set[int]:
    """The addresses at which there is something to read."""
    return {
        address
        for register in (*registers, *drive.registers.values())
        if register.table == table and register.readable
        for address in range(register.address, register.address + register.words)
    }
