"""Choose proofs: requests to a drive whose replies cannot be taken for each other's.

After a time-out a reply may still come, at any time and to any request that is outstanding. The reply
to a request that no outstanding reply could be taken for proves that all of them have come, or never
will: a line and the path to it keep the order. Replies differ by function, by length, in Delixi's own
protocol by parameter, and otherwise by the values that two registers are known to hold.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator
from typing import Any

from multidrop.drive.family import Drive
from multidrop.drive.register import Access, Carrier, Register
from multidrop.planning.blocks import Block, all_blocks

MOST_PROOFS = 4  # each costs memory for every drive

RawRange = tuple[int, int]  # the least and the most that the one register of a reply holds


def proofs(drive: Drive) -> list[tuple[Block, RawRange | None]]:
    """Return blocks to read from this drive, with the raw counts that the reply is known to hold.

    The last one is the least likely to be polled. There is none where a family can tell no two replies apart.
    """
    known = [(Block.of(drive, [register]), counts) for register, counts in drive.known_counts().items()]
    shapes: dict[Hashable, Block] = {}
    for block in _candidates(drive):
        shapes.setdefault(_shape(block), block)
    found: list[tuple[Block, RawRange | None]] = [(block, None) for block in shapes.values()]
    if known:
        found = [*known, *found[1:]]
    if len(found) >= MOST_PROOFS:
        return [*found[: MOST_PROOFS - 1], found[-1]]
    return found if len(found) > 1 else []


def _candidates(drive: Drive) -> Iterator[Block]:
    """Yield all blocks: first those that are polled anyway, and of those the short ones."""
    readable: list[Register[Any]] = [register for register in drive.registers.values() if register.readable]
    readings = [register for register in readable if register.access is Access.READING]
    for registers in (readings, readable):
        yield from sorted(all_blocks(drive, registers), key=lambda block: block.count)


def _shape(block: Block) -> Hashable:
    """Return what a reply shows of its request."""
    if block.table.carrier is Carrier.LONG:
        return block.table.read, block.start
    if block.table.carrier is Carrier.BIT:
        return block.table.read, (block.count + 7) // 8
    return block.table.read, block.count
