"""Peers: what is learnt of each drive on a line, kept also of drives that leave and come back."""

from __future__ import annotations

from multidrop.core import Completion, Exchange, Framing, Peer, TransactionIds
from multidrop.drive.family import Drive, check_drive
from multidrop.errors import NotAttached
from multidrop.planning.bus_time import silence
from multidrop.planning.proofs import proofs
from multidrop.transport import clock, former_peers
from multidrop.transport.line import Line
from multidrop.transport.prepared import NO_ROWS, make_exchange

GONE_S = 0.001  # between looks whether a drive that left is asked yet
LEAST_TIMEOUT = 0.02  # s: what a host and its adapter may add to a drive's own delay


class Peers:
    """The peers of the drives on one line; any thread may look while another one adds and removes drives."""

    def __init__(self, line: Line) -> None:
        self._line = line
        self.present: dict[Drive, Peer] = {}  # of the drives that are on the line now
        self._asked: dict[object, Peer] = {}  # by threads, each with a key of its own
        # By address, and what else they are; also of those that left.
        self._known: dict[tuple[int, *tuple[object, ...]], Peer] = {}

    def add(self, drive: Drive) -> None:
        """Begin to know a drive; one that comes back is known from before.

        A thread that still asks another, which left its address, is waited for: what that owes then is known.
        """
        for other, known in self._known.items():
            while other[0] == drive.address and self._is_asked(known):
                clock.sleep(GONE_S)
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
        for former in former_peers.left_at(self._names(), drive.address):
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
        """Close the line; what its drives owe is left to whoever opens the port again."""
        names = self._names()
        self._line.close()
        former_peers.leave(names, [(address, peer) for (address, *_), peer in self._known.items()])

    def _names(self) -> set[str]:
        return former_peers.names_of(self._line.identity, self._line.port)

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
            raise _not_attached(drive)
        return peer

    def carry_out(
        self, drive: Drive, made: Exchange, *, expires_ns: int = 0, into: Completion | None = None
    ) -> Completion:
        """Have the line carry it out; NotAttached where the drive has left since the exchange was made."""
        asking = object()
        try:  # a signal that raises between any two steps leaves none behind, for which `add` waited for ever
            self._asked[asking] = made.peer  # before the look: what takes the drive's place waits for it
            if self.present.get(drive) is not made.peer:
                raise _not_attached(drive)
            return self._line.carry_out(made, expires_ns=expires_ns, into=into)
        finally:
            self._asked.pop(asking, None)

    def is_asking(self, peer: Peer) -> bool:
        """Return True while an exchange with this peer is queued, under way or about to be."""
        return self._is_asked(peer) or self._line.is_asking(peer)

    def _is_asked(self, peer: Peer) -> bool:
        return peer in self._asked.copy().values()


def _not_attached(drive: Drive) -> NotAttached:
    return NotAttached(f"{drive.name} is not attached to this bus: use bus.attach(...)")
