"""Latches: end what may move a motor once its stop was called, and hold others back while stops run."""

from __future__ import annotations

import threading
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager

from multidrop.core import Latch
from multidrop.drive.family import Drive
from multidrop.errors import NotAttached
from multidrop.transport.exchange import Exchanges

STOPPED = "a stop was called"
REMOVED = "the drive was taken off the bus"
LEFT = "the bus was left"


class Latches:
    """A latch for each drive of a bus, and the stops under way."""

    def __init__(self, exchanges: Exchanges) -> None:
        self._exchanges = exchanges
        self._latches: dict[Drive, Latch] = {}
        self._is_shut = False
        self._make_condition()

    def _make_condition(self) -> None:
        self._stops: dict[object, frozenset[Drive]] = {}  # under way, with the drives of each
        self._over = threading.Condition()  # one of them is

    def forked(self) -> None:
        """Send nothing in the child, where nothing is under way."""
        self._make_condition()
        self.shut()

    def add(self, drive: Drive) -> None:
        latch = self._latches[drive] = Latch()
        if self._is_shut:  # looked at afterwards: a thread that shuts them later sees this latch
            latch.shut(LEFT)

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
        self._is_shut = True
        for latch in list(self._latches.values()):
            latch.shut(LEFT)

    def await_stops(self, drives: Collection[Drive] | None = None) -> None:
        """Wait until no stop is under way, of these drives or of any."""

        def is_over() -> bool:
            under_way = self._stops.copy().values()
            return not under_way if drives is None else all(map(frozenset(drives).isdisjoint, under_way))

        with self._over:
            self._over.wait_for(is_over)

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

    @contextmanager
    def stopping(self, drives: Sequence[Drive]) -> Iterator[None]:
        """Within this context nothing that moves these drives begins or goes on, and none of them leaves."""
        stop = object()
        try:  # a signal that raises between any two steps leaves none behind, for which a bus waited for ever
            self._stops[stop] = frozenset(drives)
            with ExitStack() as stack:
                for drive in drives:
                    if latch := self._latches.get(drive):
                        stack.enter_context(latch.held(STOPPED))
                yield
        finally:
            self._stops.pop(stop, None)
            with self._over:
                self._over.notify_all()
