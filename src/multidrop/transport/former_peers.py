"""Former peers: late replies still due when a port was closed, kept until this process reopens it.

A reply that comes after its port was closed is thrown away there, but one that comes later, on a slow path,
meets the next to open that port.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from multidrop.core import Peer, is_pseudo_terminal
from multidrop.transport import clock, port_identity

KEPT_NS = 120_000_000_000  # as late.c remembers requests


class FormerPeers(NamedTuple):
    """Peers with late replies due when their port was closed, with their addresses."""

    closed_ns: int
    peers: tuple[tuple[int, Peer], ...]


_former: dict[str, FormerPeers] = {}  # by port; each change is one step, so that no thread needs a lock


def names_of(*names: str) -> set[str]:
    """Return the identities of an open port for its names.

    The number of a pseudo-terminal that is gone is another's soon, so the time of its making counts.
    """
    found = {port_identity.of_name(name) for name in names}
    return {f"{name} of {_made_ns(name)}" if is_pseudo_terminal(name) else name for name in found}


def _made_ns(device: str) -> int:
    try:
        return Path(device).stat().st_ctime_ns
    except OSError:  # it is gone, and never comes back
        return clock.now_ns()


def leave(names: Iterable[str], peers: Iterable[tuple[int, Peer]]) -> None:
    """Remember the peers with late replies due, by address, because their port was closed."""
    now_ns = clock.now_ns()
    for name, former in [*_former.items()]:
        if now_ns - former.closed_ns > KEPT_NS:
            _former.pop(name, None)
    owing = tuple((address, peer) for address, peer in peers if peer.owes)
    if owing:
        _former.update(dict.fromkeys(names, FormerPeers(now_ns, owing)))


def left_at(names: Iterable[str], address: int) -> Iterator[Peer]:
    """Yield the peers at this address with late replies due when the port was closed."""
    for name in names:
        former = _former.get(name)
        yield from (peer for at, peer in former.peers if at == address) if former else ()
