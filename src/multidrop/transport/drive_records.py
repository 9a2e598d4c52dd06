"""Keep the C core's record (`Peer`) of each drive on a line, even while the drive is off the line.

The record has the learnt timing, and the requests to which late replies may still come.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from multidrop.core import Completion, Exchange, Framing, Peer, TransactionIds, is_pseudo_terminal
from multidrop.drive.family import Drive
from multidrop.drive.link import check_drive
from multidrop.errors import NotAttached
from multidrop.planning.bus_time import silence
from multidrop.planning.proofs import proofs
from multidrop.transport import clock, port_identity
from multidrop.transport.drive_reads import NO_ROWS, make_exchange
from multidrop.transport.line import Line

# how long the records of a closed port's drives are kept; late.c expects late replies for the same time
KEPT_NS = 120_000_000_000


class FormerPeers(NamedTuple):
    """Records of drives whose late replies were still due when their port was closed, with addresses."""

    closed_ns: int
    peers: tuple[tuple[int, Peer], ...]


_former: dict[str, FormerPeers] = {}  # by identity of the port; every change is atomic, so no lock is needed


def identities_of(*names: str) -> set[str]:
    """Return the identity of an open port for each of its names.

    The identity of a pseudo-terminal includes its creation time, because its number is soon reused.
    """
    found = {port_identity.of_name(name) for name in names}
    return {f"{name} of {_made_ns(name)}" if is_pseudo_terminal(name) else name for name in found}


def _made_ns(device: str) -> int:
    try:
        return Path(device).stat().st_ctime_ns
    except OSError:  # the device is gone: return a unique time, so that no later device matches
        return clock.now_ns()


def remember_former_peers(names: Iterable[str], peers: Iterable[tuple[int, Peer]]) -> None:
    """When a port is closed, keep the records of drives that may still send late replies.

    The records are kept under each name of the port. `peers` are pairs of a drive's address and its record.
    """
    now_ns = clock.now_ns()
    for name, former in [*_former.items()]:
        if now_ns - former.closed_ns > KEPT_NS:
            _former.pop(name, None)
    owing = tuple((address, peer) for address, peer in peers if peer.owes)
    if owing:
        _former.update(dict.fromkeys(names, FormerPeers(now_ns, owing)))


def former_at(names: Iterable[str], address: int) -> Iterator[Peer]:
    """Yield the kept records of drives that had this address when the port was closed."""
    for name in names:
        former = _former.get(name)
        yield from (peer for at, peer in former.peers if at == address) if former else ()


GONE_S = 0.001  # s between checks whether a removed drive's exchange has ended
LEAST_TIMEOUT = 0.02  # s; time allowed at least for a reply, because computer and adapter delay it too


class Peers:
    """The C core's records of the drives on one line.

    Threads may read the records while one thread adds or removes a drive.
    """

    def __init__(self, line: Line) -> None:
        self._line = line
        self.present: dict[Drive, Peer] = {}  # records of the drives that are on the line now
        # The drive's record, for each exchange that a thread is carrying out.
        self._asked: dict[object, Peer] = {}
        # Records of present and removed drives, by the drive's address and description.
        self._known: dict[tuple[int, *tuple[object, ...]], Peer] = {}

    def add(self, drive: Drive) -> None:
        """Add a drive. A drive that was on the line before gets its earlier record, with its learnt timing.

        First wait until no exchange with an earlier drive at this address is in flight. Until then, it is
        unknown which replies of the earlier drive are late.
        """
        for other, known in self._known.items():
            while other[0] == drive.address and self._is_asked(known):
                clock.sleep(GONE_S)
        documented = max(LEAST_TIMEOUT, drive.answering_time, 4 * drive.response_delay)
        least = min(drive.response_timeout, documented)
        asked_as = type(drive), drive.framing, drive.settings, silence(drive), least, drive.response_timeout
        key = drive.address, *asked_as
        # a known record is used again and never replaced, because the C core's thread may still be reading it
        if key not in self._known:
            self._known[key] = self._new(drive, least)
        peer = self.present[drive] = self._known[key]
        # a late reply of an earlier drive at this address must not be taken for a reply of this drive
        for other, known in self._known.items():
            if other[0] == drive.address and known is not peer:
                self._line.inherit(peer, known)
        for former in former_at(self._names(), drive.address):
            self._line.inherit(peer, former)

    def _new(self, drive: Drive, least: float) -> Peer:
        peer = Peer(least_timeout=least, most_timeout=drive.response_timeout, interval=drive.least_interval)
        has_ids = drive.framing is Framing.TCP and self._line.ids is TransactionIds.MATCH
        found = () if has_ids else proofs(drive)
        peer.prove_by(
            [make_exchange(drive, block.request, peer, NO_ROWS, answer=answer) for block, answer in found]
        )
        if drive.answers_every_read:
            peer.doubt_first_reply()
        return peer

    def close(self) -> None:
        """Close the line. If it is opened again, replies to earlier requests are recognised as late."""
        names = self._names()
        self._line.close()
        remember_former_peers(names, [(address, peer) for (address, *_), peer in self._known.items()])

    def _names(self) -> set[str]:
        return identities_of(self._line.identity, self._line.port)

    def remove(self, drive: Drive) -> None:
        """Remove a drive from the line, but keep its record."""
        del self.present[drive]

    def of(self, drive: Drive) -> Peer:
        """Return the C core's record of a drive. Raises NotAttached for a drive that is not on this bus."""
        peer = self.present.get(drive) if isinstance(drive, Drive) else None
        if peer is None:
            check_drive(drive)
            raise _not_attached(drive)
        return peer

    def carry_out(
        self, drive: Drive, made: Exchange, *, expires_ns: int = 0, into: Completion | None = None
    ) -> Completion:
        """Carry out an exchange on the line. Raises NotAttached if the drive was removed meanwhile."""
        asking = object()
        # even if a signal interrupts, remove the entry from `_asked`: otherwise `add` would wait forever
        try:
            # set before the check, so that `add` of another drive at this address waits for this exchange
            self._asked[asking] = made.peer
            if self.present.get(drive) is not made.peer:
                raise _not_attached(drive)
            return self._line.carry_out(made, expires_ns=expires_ns, into=into)
        finally:
            self._asked.pop(asking, None)

    def is_asking(self, peer: Peer) -> bool:
        """Return True while an exchange with this drive is about to start, queued or in flight."""
        return self._is_asked(peer) or self._line.is_asking(peer)

    def _is_asked(self, peer: Peer) -> bool:
        return peer in self._asked.copy().values()


def _not_attached(drive: Drive) -> NotAttached:
    return NotAttached(f"{drive.name} is not attached to this bus: use bus.attach(...)")
