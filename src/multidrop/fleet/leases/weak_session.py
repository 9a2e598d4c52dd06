"""Weak session: one that lost a path to others is given up, for the next server that dies would end it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from multidrop.fleet.leases.lease import Lease
from multidrop.fleet.leases.observer import Observer
from multidrop.fleet.leases.rules import SECOND
from multidrop.fleet.servers.connections import ServerPath
from multidrop.fleet.servers.leaders import have_leaders

LOOK_S = 1.0
WEAK_NS = 10 * SECOND  # for which it goes on first, from when its gateway has settled


class WeakSession:
    """Watches our own session; `is_too_weak` while it is to be given up."""

    def __init__(self, lease: Lease, observer: Observer, path: Callable[[], ServerPath]) -> None:
        self.is_too_weak = False
        self._lease = lease
        self._observer = observer
        self._path = path

    async def watch(self, settled_at: Callable[[], int]) -> None:
        """Look at it for ever.

        Its lines are others' for a moment, so one gateway at a time gives up, once all paths answer and lines
        can be claimed.
        """
        while True:
            await asyncio.sleep(LOOK_S)
            lease = self._lease
            if not (lease.is_weak and lease.is_valid) or lease.clock() < settled_at() + WEAK_NS:
                continue
            if self._observer.weak()[:1] == [lease.name]:
                self.is_too_weak = await have_leaders(self._path()) and await lease.could_be_whole()
