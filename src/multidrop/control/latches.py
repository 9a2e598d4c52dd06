"""Latches: end what may move a motor once its stop was called, and hold others back while stops run."""

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
LOOK_S = 0.005  # between looks whether stops are over


class Latches:
    """A latch for each drive of a bus, and the stops under way."""

    def __init__(self, exchanges: Exchanges) -> None:
        self._exchanges = exchanges
        self._latches: dict[Drive, Latch] = {}
        self.is_shut = False
        self._forget_stops()

    def _forget_stops(self) -> None:
        # Under way, each with its thread's number and its drives.
        self._stops: dict[object, tuple[int, frozenset[Drive]]] = {}

    def forked(self) -> None:
        """Send nothing in the child, where nothing is under way."""
        self._forget_stops()
        self.shut()

    def add(self, drive: Drive) -> Latch:
        latch = self._latches[drive] = Latch()
        if self.is_shut:  # looked at afterwards: a thread that shuts them later sees this latch
            latch.shut(LEFT)
        return latch

    def end(self, drives: Iterable[Drive]) -> None:
        """End what moves these drives, which are about to leave: from now on nothing of it begins."""
        for drive in drives:
            self.latch(drive).shut(REMOVED)

    def remove(self, drive: Drive) -> None:
        """End what moves this drive, and wait for its stops that are under way."""
        self.end([drive])
        self.await_stops([drive])
        self._latches.pop(drive, None)

    def shut(self) -> None:
        """Send nothing any more that moves a motor. Takes no lock: a signal handler may call it."""
        self.is_shut = True
        for latch in list(self._latches.values()):
            latch.shut(LEFT)

    def await_stops(self, drives: Collection[Drive] | None = None) -> None:
        """Wait until no stop is under way, of these drives or of any; a thread waits for none of its own."""
        own, asked = threading.get_ident(), None if drives is None else frozenset(drives)
        while any(
            thread != own and (asked is None or not asked.isdisjoint(stopped))
            for thread, stopped in self._stops.copy().values()
        ):
            time.sleep(LOOK_S)  # no condition, whose lock a signal's exception could leave locked

    def latch(self, drive: Drive) -> Latch:
        """Return a drive's latch; NotAttached for one that is not on this bus."""
        self._exchanges.peer(drive)  # raises it too
        latch = self._latches.get(drive)
        if latch is None:  # it leaves just now
            raise NotAttached(f"{drive.name} is not attached to this bus: use bus.attach(...)")
        return latch

    def rise(self, drives: Sequence[Drive]) -> None:
        """End all that moves these drives: a stop is about to be written."""
        for drive in drives:
            self.latch(drive).rise(STOPPED)

    def begin(self, stop: object, drives: Sequence[Drive]) -> None:
        """Until `over` nothing that moves these drives begins or goes on, and none of them leaves.

        It may be called again. Neither this nor `over` takes a lock, and each step of them is one that a
        signal's exception comes before or after.
        """
        self._stops[stop] = threading.get_ident(), frozenset(drives)
        for drive in drives:
            if latch := self._latches.get(drive):
                latch.hold(stop, STOPPED)

    def over(self, stop: object) -> None:
        """Let the drives go. It may be called again, and without a beginning."""
        for latch in [*self._latches.values()]:
            latch.let_go(stop)
        self._stops.pop(stop, None)
