"""Proofs: questions to a drive whose replies cannot be taken for each other's. Pure.

After a time-out an answer may still come, at any time and for any question that is outstanding. The
reply to a question that no outstanding answer could be taken for proves that all of them have come, or
never will: a line and the path to it keep the order. Replies differ by function, by length, in
Delixi's own protocol by parameter, and else by the values that two registers are known to hold.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator
from typing import Any

from multidrop.drive.family import Drive
from multidrop.drive.register import Access, Carrier, Register
from multidrop.planning.blocks import Block, alone, runs

MOST = 4  # each costs memory for every drive

Answer = tuple[int, int]  # the least and the most that the one register of a reply holds


def proofs(drive: Drive) -> list[tuple[Block, Answer | None]]:
    """Return what to read from this drive, with the raw counts that its reply is known to hold.

    The last one is the least likely to be polled. There is none where a family can tell no two replies apart.
    """
    known = [(alone(register), counts) for register, counts in drive.known_counts().items()]
    shapes: dict[Hashable, Block] = {}
    for block in _candidates(drive):
        shapes.setdefault(_shape(block), block)
    found: list[tuple[Block, Answer | None]] = [(block, None) for block in shapes.values()]
    if known:
        found = [*known, *found[1:]]
    return [*found[: MOST - 1], found[-1]] if len(found) >= MOST else found if len(found) > 1 else []


def _candidates(drive: Drive) -> Iterator[Block]:
    """What is polled anyway comes first, and what is short."""
    readable: list[Register[Any]] = [register for register in drive.registers.values() if register.readable]
    readings = [register for register in readable if register.access is Access.READING]
    for registers in (readings, readable):
        yield from sorted(runs(drive, registers), key=lambda block: block.count)


def _shape(block: Block) -> Hashable:
    """What a reply shows of its question."""
    if block.table.carrier is Carrier.LONG:
        return block.table.read, block.start
    if block.table.carrier is Carrier.BIT:
        return block.table.read, (block.count + 7) // 8
    return block.table.read, block.count
