"""Releases: which lines may be closed now so that another gateway can claim them immediately."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Set

from multidrop.fleet.lines.rules import NEEDED
from multidrop.fleet.servers import names
from multidrop.fleet.servers.connections import ServerPath
from multidrop.fleet.servers.leaders import known_cluster

LOOK_S = 0.05  # pause between checks of the servers' states
SILENT_SERVER_S = 60.0  # a server that is silent for longer than this (in s) is ignored


class Releases:
    """Decides which lines may be closed now so that another gateway can claim them immediately.

    A line is closed before it is released. It has no master until the release is stored and the other gateway
    has claimed it. If too few buckets have a leader, a release cannot be stored, so this gateway continues to
    poll the line. It also continues while a server is silent: when a server that was cut off returns, buckets
    may lose their leaders for seconds, and during that time no gateway could claim the line. `on_change` is
    called when the servers' state has changed.
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
        # the buckets that have a leader, each with the time (s) since when one of its servers is silent, or
        # with None if all its servers answer
        self._led: dict[str, float | None] = {}

    def due(self, lines: Set[str], wait_s: float = SILENT_SERVER_S) -> set[str]:
        """Return the lines in `lines` that may be closed now; the other lines must wait.

        A bucket is ready if it has a leader and no silent server. At least two buckets must be ready,
        including the line's first bucket, whose record may have two votes. A server that is silent for longer
        than `wait_s` seconds is ignored.
        """
        self._has_lines = bool(lines)
        waited_since = self._clock() - wait_s
        ready = {bucket for bucket, since in self._led.items() if since is None or since <= waited_since}
        if len(ready) < NEEDED:
            return set()
        return {line for line in lines if names.owner_buckets(line)[0] in ready}

    async def watch(self) -> None:
        while True:
            await self.look()
            await asyncio.sleep(LOOK_S)

    async def look(self) -> None:
        """Check the servers' states once if a line waits for its release."""
        buckets = names.OWNERS if self._has_lines else ()
        found = await asyncio.gather(*(known_cluster(self._path(), bucket) for bucket in buckets))
        now, before, self._led = self._clock(), self._led, {}
        for bucket, cluster in zip(buckets, found, strict=True):
            if cluster.leader:
                since = before.get(bucket)
                self._led[bucket] = (now if since is None else since) if cluster.has_silent else None
        if self._led != before:
            self._on_change()
