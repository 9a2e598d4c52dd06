"""Choose proofs: reads whose reply proves that no late reply of the drive can still come.

After a timeout a reply may still come, at any time and to any outstanding request. But a late reply can never
be mistaken for the reply to a proof. Once the reply to a proof has come, no earlier reply can still come,
because a line, and the path to it, deliver replies in order.

The replies to a drive's proofs differ in function, in length, or (in Delixi's own protocol) in parameter. If
a family allows no such difference, the proofs read two registers that are known to hold different values.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from functools import lru_cache
from typing import Any

from multidrop.core import Framing
from multidrop.drive.family import Drive
from multidrop.drive.register import COIL, DISCRETE, HOLDING, INPUT, Access, Carrier, Register
from multidrop.drive.request import read_request
from multidrop.planning.blocks import Block, all_requests

MOST_PROOFS = 4  # limit of a drive's proofs, because each one uses memory

# If a device's own registers allow too few different replies, its proofs also read these tables. Even an
# exception reply has the function code of its table.
OTHER_TABLES = (INPUT, COIL, HOLDING, DISCRETE)
# Number of different proofs that a drive needs. While a late reply to the first proof may still come, the
# second one is sent. The third one is only sent when a silent drive answers again.
ENOUGH = 3

RawRange = tuple[int, int]  # lowest and highest raw count that a register can have


def proofs(drive: Drive) -> list[tuple[Block, RawRange | None]]:
    """Return the drive's proofs: read requests whose reply shows that no late reply can still come.

    Each request (block) comes with the range of raw counts that its reply must have, or with None. The last
    request is the least likely to be polled. If a Modbus device has fewer than ENOUGH requests, requests to
    its other tables are added.
    """
    known = [(Block.of(drive, [register]), counts) for register, counts in drive.known_counts().items()]
    family: Any = type(drive)
    found: list[tuple[Block, RawRange | None]] = [
        (Block.of(drive, registers), None) for registers in _with_distinct_replies(family)
    ]
    if known:
        found = [*known, *found[1:]]
    if probe := drive.echo_probe:  # a read whose reply always differs from an echo of the request
        found = [(Block.of(drive, [probe]), None), *found]
    if len(found) < ENOUGH and not known and drive.framing is not Framing.DELIXI:
        found += [(block, None) for block in _of_other_tables(drive, [block for block, _ in found])]
    if len(found) >= MOST_PROOFS:
        return [*found[: MOST_PROOFS - 1], found[-1]]
    return found if len(found) > 1 else []


@lru_cache(maxsize=256)
def _with_distinct_replies(family: Any) -> tuple[tuple[Register[Any], ...], ...]:
    """Return requests whose replies differ in form, such as in length; each is a tuple of registers.

    Requests for readings come first, because readings are polled anyway. Shorter requests come before longer
    ones. If there are many requests, only the first MOST_PROOFS and the last one are returned.
    """
    readable: list[Register[Any]] = [register for register in family.registers.values() if register.readable]
    readings = [register for register in readable if register.access is Access.READING]
    shapes: dict[Hashable, tuple[Register[Any], ...]] = {}
    for registers in (readings, readable):
        for count, ordered, begin, end in sorted(all_requests(family, registers), key=lambda one: one[0]):
            shape = _shape(ordered[begin], count)
            if shape not in shapes:
                shapes[shape] = ordered[begin:end]
    found = list(shapes.values())
    return tuple(found if len(found) <= MOST_PROOFS else [*found[:MOST_PROOFS], found[-1]])


def _of_other_tables(drive: Drive, found: Sequence[Block]) -> list[Block]:
    """Return a read request for each table in OTHER_TABLES with a function code that `found` lacks."""
    start = found[0].start if found else 0
    functions = {block.table.read for block in found}
    return [
        Block(table, start, 1, (), read_request(drive, table, start, 1))
        for table in OTHER_TABLES
        if table.read not in functions
    ]


def _shape(first: Register[Any], count: int) -> Hashable:
    """Return what a reply reveals about its request, such as the function code and number of registers."""
    if first.table.carrier is Carrier.LONG:
        return first.table.read, first.address
    if first.table.carrier is Carrier.BIT:
        return first.table.read, (count + 7) // 8
    return first.table.read, count
