"""Which registers go into which request, in which order, and how long that takes on the wire. Pure."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any

from multidrop.core import Framing, Message
from multidrop.drive import Drive
from multidrop.register import Carrier, Register, Table


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


def silence(drive: Drive) -> float:
    """Seconds that are kept around its exchanges: a bit more, for the other side's second stop bit.

    ASCII frames need none; but after 1.5 characters it shows whether more is to come, such as a second
    copy of the reply, which could else be taken for the next one.
    """
    settings = drive.settings
    least = 0.0 if drive.framing is Framing.RTU else 1.5 * settings.character
    return max(drive.needed_silence(), least) + settings.bit


# Characters of a read's request and reply without its data, and of each byte of that.
_FRAMES = {Framing.RTU: (8 + 5, 1), Framing.ASCII: (17 + 11, 2), Framing.DELIXI: (21 + 21, 0)}


def _characters(framing: Framing, table: Table, count: int) -> int:
    """Characters of the request that reads so many registers, and of its reply."""
    around, each = _FRAMES[framing]
    return around + each * ((count + 7) // 8 if table.carrier is Carrier.BIT else 2 * count)


def sending(drive: Drive, block: Block) -> float:
    """Seconds in which characters of the request and of the reply are on the wire."""
    return _characters(drive.framing, block.table, block.count) * drive.settings.character


def duration(drive: Drive, block: Block, delay: float | None = None) -> float:
    """Seconds of the line that a block takes: silence, request, response delay, reply.

    `delay` is the response delay, where it was measured, in place of the document's.
    """
    return silence(drive) + sending(drive, block) + (drive.response_delay if delay is None else delay)


def gap(before: Drive, after: Drive, switching: float = 0.0) -> float:
    """Seconds from one drive's reply to the other's request, on a line that is never idle.

    `switching` is what the port needs to change baud rate or format, once the silence is over.
    """
    switched = switching if before.settings != after.settings else 0.0
    return max(silence(before), silence(after)) + switched


def kind(drive: Drive) -> tuple[float, str]:
    """Drives of one kind follow each other in the least time."""
    return silence(drive), str(drive.settings)


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


def in_order(drives: Iterable[Drive], switching: float = 0.0) -> list[Drive]:
    """The bus cycle with the least silence, and of those as short one with the fewest switches.

    The longer of two neighbours' silences is kept, so drives of like silence and settings stand side
    by side. They are put into the cycle by rising silence, each kind where it costs least; where
    switching costs nothing, no order is shorter.
    """
    kinds: dict[tuple[float, str], list[Drive]] = {}
    for drive in drives:
        kinds.setdefault(kind(drive), []).append(drive)
    cycle: list[Drive] = []  # one of each kind
    for each in sorted(kinds):
        drive = kinds[each][0]
        costs = [_detour(cycle[at - 1], drive, cycle[at], switching) for at in range(len(cycle))]
        cycle.insert(costs.index(min(costs)) if costs else 0, drive)
    return [drive for first in cycle for drive in kinds[kind(first)]]


def _detour(before: Drive, drive: Drive, after: Drive, switching: float) -> tuple[int, int]:
    """What it costs to visit a drive between two others: ns, which compare well, and switches."""
    seconds = gap(before, drive, switching) + gap(drive, after, switching) - gap(before, after, switching)
    switches = sum(one.settings != other.settings for one, other in pairwise((before, drive, after)))
    return round(seconds * 1e9), switches - (before.settings != after.settings)


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
            own = _characters(framing, block.table, block.count)
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


def write_request(drive: Drive, register: Register[Any], raw: float, address: int | None = None) -> Message:
    """The request that writes a raw count to a register, to its RAM alias where it has one.

    Raises ValueError where the register cannot be written.
    """
    table = register.table
    if not register.writable or table.write is None:
        raise ValueError(
            f"{register.name} of {drive.name} cannot be written: it is a {register.access.value}"
        )
    to = drive.address if address is None else address
    at = register.address if register.ram_address is None else register.ram_address
    if table.carrier is Carrier.NUMBER:
        return Message(to, table.write, start=int(raw), data=bytes(4))
    if table.carrier is Carrier.LONG:
        return Message(to, table.write, at, data=struct.pack(">I", int(raw)))
    if table.carrier is Carrier.BIT:
        if table.write == _WRITE_COILS:
            return Message(to, table.write, at, count=1, data=bytes([int(raw)]))
        return Message(to, table.write, at, data=b"\xff\x00" if raw else b"\x00\x00")
    if register.words == 1:
        word = struct.pack(">H", int(raw) & 0xFFFF)
        count = 1 if table.write == _WRITE_WORDS else 0
        return Message(to, table.write, at, count, word)
    words = struct.pack(">f", raw) if register.is_float else struct.pack(">I", int(raw) & 0xFFFF_FFFF)
    if register.wire.name.endswith("_SWAPPED"):
        words = words[2:] + words[:2]
    return Message(to, _WRITE_WORDS, at, count=2, data=words)


_WRITE_COILS, _WRITE_WORDS = 0x0F, 0x10  # several at once
