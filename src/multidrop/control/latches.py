"""Latches: a drive's stop cancels calls that may move its motor, and blocks new calls until the stop ends."""

from __future__ import annotations

import threading
import time
from collections.abc import Collection, Iterable, Sequence

from multidrop.core import Latch
from multidrop.drive.family import Drive
from multidrop.errors import NotAttached
from multidrop.transport.exchange import Exchanges

STOPPED = "a stop was called"
REMOVED = "the drive was taken off the bus"
LEFT = "the bus was left"
POLL_S = 0.005  # s between checks for the end of stops


class Latches:
    """The unfinished stops of a bus, and a latch for each of its drives.

    A latch counts the stops of its drive, so that each stop cancels the calls that were made before it.
    """

    def __init__(self, exchanges: Exchanges) -> None:
        self._exchanges = exchanges
        self._latches: dict[Drive, Latch] = {}
        self.is_shut = False
        self._forget_stops()

    def _forget_stops(self) -> None:
        # by unfinished stop: the identifier of the stop's thread, and the stop's drives
        self._stops: dict[object, tuple[int, frozenset[Drive]]] = {}

    def forked(self) -> None:
        """Shut all latches in a forked child, and forget the parent's stops."""
        self._forget_stops()
        self.shut()

    def add(self, drive: Drive) -> Latch:
        latch = self._latches[drive] = Latch()
        if self.is_shut:  # checked after adding the latch: a later `shut` sees the latch
            latch.shut(LEFT)
        return latch

    def end(self, drives: Iterable[Drive]) -> None:
        """Cancel all calls that move these drives, and refuse new ones, before the drives are removed."""
        for drive in drives:
            self.latch(drive).shut(REMOVED)

    def remove(self, drive: Drive) -> None:
        """Cancel this drive's calls, wait for its unfinished stops, and remove its latch."""
        self.end([drive])
        self.await_stops([drive])
        self._latches.pop(drive, None)

    def shut(self) -> None:
        """Cancel all calls for good. Takes no lock, because a signal handler may call it."""
        self.is_shut = True
        for latch in list(self._latches.values()):
            latch.shut(LEFT)

    def await_stops(self, drives: Collection[Drive] | None = None) -> None:
        """Wait until these drives (by default all) have no unfinished stop of another thread."""
        own, asked = threading.get_ident(), None if drives is None else frozenset(drives)
        while any(
            thread != own and (asked is None or not asked.isdisjoint(stopped))
            for thread, stopped in self._stops.copy().values()
        ):
            time.sleep(POLL_S)  # no Condition: an exception of a signal handler could leave its lock locked

    def latch(self, drive: Drive) -> Latch:
        """Return a drive's latch. Raises NotAttached if the drive is not on this bus."""
        self._exchanges.peer(drive)  # raises NotAttached
        latch = self._latches.get(drive)
        if latch is None:  # the drive is being removed
            raise NotAttached(f"{drive.name} is not attached to this bus: use bus.attach(...)")
        return latch

    def rise(self, drives: Sequence[Drive]) -> None:
        """Cancel all calls that move these drives. Called right before a stop is written."""
        for drive in drives:
            self.latch(drive).rise(STOPPED)

    def begin(self, stop: object, drives: Sequence[Drive]) -> None:
        """Start a stop: until `over(stop)`, cancel and refuse moves of these drives, and keep them attached.

        `begin` may be called repeatedly. Neither `begin` nor `over` takes a lock. Each of their steps is
        atomic, so an exception that a signal handler raises leaves no step half done.
        """
        self._stops[stop] = threading.get_ident(), frozenset(drives)
        for drive in drives:
            if latch := self._latches.get(drive):
                latch.hold(stop, STOPPED)

    def over(self, stop: object) -> None:
        """End a stop, and accept calls of its drives again.

        Repeated calls, and calls without `begin`, are harmless.
        """
        for latch in [*self._latches.values()]:
            latch.let_go(stop)
        self._stops.pop(stop, None)
