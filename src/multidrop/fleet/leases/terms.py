"""Lease terms: the leases' leaders keep ahead of a server that is silent, so that it unseats none later.

A server that hears no leader asks for votes every 4 to 9 s, each time in a newer term, though nobody hears
it. When its cut heals, a leader whose term is older steps down, and the bucket waits for 4 to 9 s, by chance.
Where two of the leases' buckets wait, no line is polled. A leader that hands over makes the term newer too,
and takes an instant. So while a server is silent, the others hand the leases' buckets to each other more
often than it asks. Who may poll is decided by revisions alone, whoever leads.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Mapping
from contextlib import suppress

from multidrop.fleet.servers import names
from multidrop.fleet.servers.cluster import Cluster
from multidrop.fleet.servers.connections import ServerPath
from multidrop.fleet.servers.leaders import hand_over, known_cluster

EVERY_S = 3.0  # less than the shortest time between two requests for votes
FOR_S = 60.0  # a server that is silent for longer is not waited for
DONE_S = 1.0  # it takes 0.03 to 0.3 s
LOOK_S = 0.02


class LeaseTerms:
    """The times of the hand-overs, and since when a server is silent."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._silent_since: float | None = None
        self._handed_at: dict[str, float] = {}  # by bucket

    async def keep_ahead(self, path: ServerPath, clusters: Mapping[str, Cluster]) -> bool:
        """Hand over what is due, and return True where anything was.

        It is done one bucket after the other: through us at most one waits for an election.
        """
        led = {bucket: clusters[bucket] for bucket in names.LEASES if bucket in clusters}
        silent = {bucket: cluster for bucket, cluster in led.items() if cluster.has_silent}
        if len(led) == len(names.LEASES) and not silent:
            self._silent_since = None
        any_due = False
        for bucket, cluster in silent.items():
            if cluster.ready and self._is_due(bucket):
                any_due = True
                if not await _leads_now(path, bucket, cluster.ready[0]):
                    break
        return any_due

    def _is_due(self, bucket: str) -> bool:
        now = self._clock()
        if self._silent_since is None:
            self._silent_since = now
        if now - self._silent_since > FOR_S or now - self._handed_at.get(bucket, -EVERY_S) < EVERY_S:
            return False
        self._handed_at[bucket] = now
        return True


async def _leads_now(path: ServerPath, bucket: str, server: str) -> bool:
    """Hand a bucket over, and return True once this server leads it."""
    await hand_over(path, bucket, server)
    with suppress(TimeoutError):
        async with asyncio.timeout(DONE_S):
            while (await known_cluster(path, bucket)).leader != server:
                await asyncio.sleep(LOOK_S)
            return True
    return False
