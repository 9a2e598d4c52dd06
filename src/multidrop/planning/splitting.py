"""Split a block that a drive does not answer as a whole, so that no register is lost because of another."""

from __future__ import annotations

from typing import Any

from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.drive.request import stated_limit
from multidrop.planning.blocks import Block


def halves(drive: Drive, block: Block) -> tuple[Block, ...]:
    """Return two blocks that read these registers between them; none where one would still read them all.

    Registers at the same addresses stay together, and so do those of a group in `read_together`. Splitting
    again and again ends: of n registers there are at most 2 n - 1 blocks, the whole included.
    """
    units = _units(drive, block)
    if len(units) < 2:
        return ()
    middle = len(units) // 2
    parts = units[:middle], units[middle:]
    return tuple(Block.of(drive, [register for unit in part for register in unit]) for part in parts)


def _units(drive: Drive, block: Block) -> list[list[Register[Any]]]:
    """Return the registers that no request can tell apart, by rising address."""
    groups = {name: place for place, group in enumerate(drive.read_together) for name in group}
    found: dict[object, list[Register[Any]]] = {}
    for register in block.registers:
        span = register.reach
        found.setdefault(groups.get(register.name, (span.start, span.stop)), []).append(register)
    return list(found.values())


def may_be_too_long(drive: Drive, block: Block) -> bool:
    """Return True where a drive may be silent because so much was asked: its class states no limit."""
    return stated_limit(drive, block.table) is None and len(_units(drive, block)) > 1


def least(drive: Drive, block: Block) -> Block:
    """Return the block that reads the first of these registers, and what cannot be told apart from it."""
    return Block.of(drive, _units(drive, block)[0])
