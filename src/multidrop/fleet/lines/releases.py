"""Releases: which lines may be let go for another gateway now: those that it can claim at once.

A line is closed before it is given away, and is nobody's until that is stored and the other one has claimed
it. While too few buckets have a leader nothing is stored, so it is better polled where it is. So it is while
a server is silent: one that is cut off asks for votes in newer terms, and once it is heard again leaders may
lose their office for seconds, between giving away and claiming.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Set

from multidrop.fleet.lines.ownership import NEEDED
from multidrop.fleet.servers import names
from multidrop.fleet.servers.connections import ServerPath
from multidrop.fleet.servers.leaders import known_cluster

LOOK_S = 0.05  # between looks while lines are to be released
WAIT_S = 60.0  # for a silent server; one that is silent for longer is not waited for


class Releases:
    """The lines that should be others', and how the servers of all buckets were a moment ago.

    `on_change` is called when more or fewer of them may be let go.
    """

    def __init__(
        self,
        path: Callable[[], ServerPath],
        on_change: Callable[[], object],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._path = path
        self._on_change = on_change
        self._clock = clock
        self._has_lines = False
        self._led: dict[str, float | None] = {}  # buckets with a leader; since when a server of it is silent

    def due(self, lines: Set[str], wait_s: float = WAIT_S) -> set[str]:
        """Return those of these lines that may be let go now; the others are waited for.

        Two records must be free to be written then, and the first one: it may have two votes. `wait_s` says
        for how long a silent server holds lines up.
        """
        self._has_lines = bool(lines)
        waited_since = self._clock() - wait_s
        ready = {bucket for bucket, since in self._led.items() if since is None or since <= waited_since}
        if len(ready) < NEEDED:
            return set()
        return {line for line in lines if names.owner_buckets(line)[0] in ready}

    async def watch(self) -> None:
        """Look at the buckets while lines are to be released, for ever."""
        while True:
            await self.look()
            await asyncio.sleep(LOOK_S)

    async def look(self) -> None:
        """Ask for the servers once; nothing is asked where no line is to be released."""
        buckets = names.OWNERS if self._has_lines else ()
        found = await asyncio.gather(*(known_cluster(self._path(), bucket) for bucket in buckets))
        now, before, self._led = self._clock(), self._led, {}
        for bucket, cluster in zip(buckets, found, strict=True):
            if cluster.leader:
                since = before.get(bucket)
                self._led[bucket] = (now if since is None else since) if cluster.has_silent else None
        if self._led != before:
            self._on_change()
