"""Peers: what is learnt of each drive on a line, kept also of drives that leave and come back."""

from __future__ import annotations

from multidrop.core import Framing, Peer, TransactionIds
from multidrop.drive.family import Drive
from multidrop.drive.own import check_drive
from multidrop.errors import NotAttached
from multidrop.planning.bus_time import silence
from multidrop.planning.proofs import proofs
from multidrop.transport.line import Line
from multidrop.transport.prepared import NO_ROWS, make_exchange

LEAST_TIMEOUT = 0.02  # s: what a host and its adapter may add to a drive's own delay


class Peers:
    """The peers of the drives on one line; any thread may look while another one adds and removes drives."""

    def __init__(self, line: Line) -> None:
        self._line = line
        self.present: dict[Drive, Peer] = {}  # of the drives that are on the line now
        self._known: dict[tuple[object, ...], Peer] = {}  # by what they are; also of those that left

    def add(self, drive: Drive) -> None:
        """Begin to know a drive; one that comes back is known from before."""
        documented = max(LEAST_TIMEOUT, drive.answering_time, 4 * drive.response_delay)
        least = min(drive.response_timeout, documented)
        asked_as = type(drive), drive.framing, drive.settings, silence(drive), least, drive.response_timeout
        key = drive.address, *asked_as
        if key not in self._known:  # else the core may still be asking for its proofs
            self._known[key] = self._new(drive, least)
        # A drive that comes back may still owe the answer to what it was asked before it left, and one of
        # another family at its address would get that.
        peer = self.present[drive] = self._known[key]
        for other, known in self._known.items():
            if other[0] == drive.address and known is not peer:
                self._line.inherit(peer, known)

    def _new(self, drive: Drive, least: float) -> Peer:
        peer = Peer(least_timeout=least, most_timeout=drive.response_timeout, interval=drive.least_interval)
        has_ids = drive.framing is Framing.TCP and self._line.ids is TransactionIds.MATCH
        found = () if has_ids else proofs(drive)
        peer.prove_by(
            [make_exchange(drive, block.request, peer, NO_ROWS, answer=answer) for block, answer in found]
        )
        return peer

    def remember(self, before: Peers) -> None:
        """Know all drives that were known before on the same line."""
        self._known.update(before._known)

    def remove(self, drive: Drive) -> None:
        """Take a drive off the line; what is known of it is kept."""
        del self.present[drive]

    def of(self, drive: Drive) -> Peer:
        """Return what is learnt of this drive's answers; NotAttached for a drive that is not on this bus."""
        peer = self.present.get(drive) if isinstance(drive, Drive) else None
        if peer is None:
            check_drive(drive)
            raise NotAttached(f"{drive.name} is not attached to this bus: use bus.attach(...)")
        return peer
