"""Compute the time that exchanges take on the wire, and the order of drives with the shortest bus cycle."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise

from multidrop.core import Framing
from multidrop.drive.family import Drive
from multidrop.drive.register import Carrier

# Characters of a read without its data (request plus reply), and characters of each data byte.
_FRAMES = {
    Framing.RTU: (8 + 5, 1),
    Framing.ASCII: (17 + 11, 2),
    Framing.DELIXI: (21 + 21, 0),
    Framing.TCP: (8 + 5, 1),  # RTU on the wire behind the gateway
}


def silence(drive: Drive) -> float:
    """Return the seconds of silence around a drive's exchanges: those that the drive needs, plus one bit.

    ASCII frames need no silence, but get 1.5 characters. That is enough to notice further bytes, such as a
    second copy of the reply, which could otherwise be mistaken for the next reply. Modbus TCP has no silence.
    """
    settings = drive.settings
    if drive.framing is Framing.TCP:
        return 0.0
    least = 0.0 if drive.framing is Framing.RTU else 1.5 * settings.character
    return max(drive.needed_silence(), least) + settings.bit


def characters(framing: Framing, carrier: Carrier, count: int) -> int:
    """Return the number of characters of a request for `count` registers plus its reply."""
    around, each = _FRAMES[framing]
    return around + each * ((count + 7) // 8 if carrier is Carrier.BIT else 2 * count)


def gap(before: Drive, after: Drive, switching: float = 0.0) -> float:
    """Return the seconds from the reply of `before` to the request to `after`, on a line that is never idle.

    `switching` is the time in s that the port takes to change baud rate or format after the silence.
    """
    switched = switching if switches(before, after) else 0.0
    return max(silence(before), silence(after)) + switched


def switches(before: Drive, after: Drive) -> bool:
    """Return True if the port changes baud rate or format between the drives; network ports never do."""
    return before.settings != after.settings and Framing.TCP not in (before.framing, after.framing)


def kind(drive: Drive) -> tuple[float, str]:
    """Return the drive's silence and line settings; drives of one kind take the least time in succession."""
    return silence(drive), str(drive.settings)


def in_order(drives: Iterable[Drive], switching: float = 0.0) -> list[Drive]:
    """Return the drives in an order with the least silence in a bus cycle, and then the fewest switches.

    Between two drives the line keeps the longer of their silences. Therefore drives of the same kind (silence
    and settings) are put side by side. Kinds are inserted by rising silence, each at its cheapest place. If
    switching takes no time, no other order is shorter.
    """
    kinds: dict[tuple[float, str], list[Drive]] = {}
    for drive in drives:
        kinds.setdefault(kind(drive), []).append(drive)
    cycle: list[Drive] = []  # one drive of each kind
    for each in sorted(kinds):
        drive = kinds[each][0]
        costs = [_detour(cycle[at - 1], drive, cycle[at], switching) for at in range(len(cycle))]
        cycle.insert(costs.index(min(costs)) if costs else 0, drive)
    return [drive for first in cycle for drive in kinds[kind(first)]]


def _detour(before: Drive, drive: Drive, after: Drive, switching: float) -> tuple[int, int]:
    """Return the cost of inserting `drive` between two drives: time in ns, and number of settings changes."""
    seconds = gap(before, drive, switching) + gap(drive, after, switching) - gap(before, after, switching)
    more = sum(switches(one, other) for one, other in pairwise((before, drive, after)))
    return round(seconds * 1e9), more - switches(before, after)
