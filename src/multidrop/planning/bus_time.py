"""Time that exchanges take of the line, and the order of drives that keeps the bus cycle short. Pure."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from typing import TYPE_CHECKING

from multidrop.core import Framing
from multidrop.drive.family import Drive
from multidrop.drive.register import Carrier, Table

if TYPE_CHECKING:
    from multidrop.planning.blocks import Block


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


def characters(framing: Framing, table: Table, count: int) -> int:
    """Characters of the request that reads so many registers, and of its reply."""
    around, each = _FRAMES[framing]
    return around + each * ((count + 7) // 8 if table.carrier is Carrier.BIT else 2 * count)


def sending(drive: Drive, block: Block) -> float:
    """Seconds in which characters of the request and of the reply are on the wire."""
    return characters(drive.framing, block.table, block.count) * drive.settings.character


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
