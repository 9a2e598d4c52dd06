"""Which registers go into which request, in which order, and how long that takes on the wire. Pure."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from multidrop.core import Framing, Message, build_request, reply_length
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


def silence(drive: Drive) -> float:
    """Seconds that are kept around its exchanges: a bit more, for the other side's second stop bit.

    ASCII frames need none; but after 1.5 characters it shows whether more is to come, such as a second
    copy of the reply, which could else be taken for the next one.
    """
    settings = drive.settings
    least = 0.0 if drive.framing is Framing.RTU else 1.5 * settings.character
    return max(drive.needed_silence(), least) + settings.bit


def sending(drive: Drive, block: Block) -> float:
    """Seconds in which characters of the request and of the reply are on the wire."""
    request = block.request(drive.address)
    characters = len(build_request(drive.framing, request)) + reply_length(drive.framing, request)
    return characters * drive.settings.character


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


def planned(
    drive: Drive, wanted: Iterable[tuple[Register[Any], float | None]], delay: float | None = None
) -> list[Planned]:
    """The blocks that read these registers, each as often as is wanted, with this response delay.

    Registers of different rates never share a block: what is asked for more seldom would be read
    more often than it is wanted.
    """
    rates: dict[float | None, list[Register[Any]]] = {}
    for register, every in wanted:
        rates.setdefault(every, []).append(register)
    return [
        Planned(drive, block, every)
        for every, registers in rates.items()
        for block in blocks(drive, registers, delay)
    ]


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
    return _block(register.table, [register])


def blocks(drive: Drive, registers: Iterable[Register[Any]], delay: float | None = None) -> tuple[Block, ...]:
    """The requests that read these registers in the least time, with the drive's response delay.

    Registers of a table are read together up to the family's limit, where that is the quicker way
    also across others that can be read, and across reserved addresses where the family's document
    allows that. Raises ValueError for a register that cannot be read.
    """
    tables: dict[Table, list[Register[Any]]] = {}
    for register in dict.fromkeys(registers):
        if not register.readable:
            raise ValueError(
                f"{register.name} of {drive.name} cannot be read: it is a {register.access.value}"
            )
        tables.setdefault(register.table, []).append(register)
    return tuple(
        block for table, wanted in tables.items() for block in _cheapest(drive, table, wanted, delay)
    )


def _cheapest(drive: Drive, table: Table, registers: list[Register[Any]], delay: float | None) -> list[Block]:
    """Least total duration by dynamic programming over where the last block begins."""
    registers = sorted(registers, key=lambda register: (register.address, register.words))
    readable = _readable(drive, table, registers)
    best: list[tuple[float, list[Block]]] = [(0.0, [])]
    for end in range(1, len(registers) + 1):
        choices = []
        for begin in range(end - 1, -1, -1):
            block = _block(table, registers[begin:end])
            if not _allowed(drive, block, readable):
                break
            cost, before = best[begin]
            choices.append((cost + duration(drive, block, delay), [*before, block]))
        best.append(min(choices, key=lambda choice: choice[0]))
    return best[-1][1]


def _block(table: Table, registers: list[Register[Any]]) -> Block:
    start = registers[0].address
    end = max(register.address + register.words for register in registers)
    return Block(table, start, end - start, tuple(registers))


def _readable(drive: Drive, table: Table, registers: Iterable[Register[Any]]) -> set[int]:
    """The addresses at which there is something to read."""
    return {
        address
        for register in (*registers, *drive.registers.values())
        if register.table == table and register.readable
        for address in range(register.address, register.address + register.words)
    }


def _allowed(drive: Drive, block: Block, readable: set[int]) -> bool:
    if len(block.registers) == 1:
        return True  # a register is read whole, whatever the limit
    if block.count > drive.most_registers.get(block.table, 1):
        return False
    gaps = drive.readable_gaps.get(block.table, range(0))
    return all(it in readable or it in gaps for it in range(block.start, block.start + block.count))


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
