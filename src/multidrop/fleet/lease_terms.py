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
from collections.abc import Callable
from contextlib import suppress

from multidrop.fleet import names
from multidrop.fleet.buckets import ask
from multidrop.fleet.cluster import Cluster
from multidrop.fleet.errors import FleetError
from multidrop.fleet.leaders import known_cluster
from multidrop.fleet.servers import ServerPath
from multidrop.fleet.task_end import end_tasks

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

    async def keep_ahead(self, path: ServerPath) -> None:
        """Hand over what is due, one bucket after the other: through us at most one waits for an election."""
        looks = [asyncio.create_task(_named(path, bucket)) for bucket in names.LEASES]
        has_silent, found = False, 0
        try:
            for look in asyncio.as_completed(looks):
                bucket, cluster = await look
                found += bool(cluster.leader)
                if cluster.leader and cluster.has_silent:
                    has_silent, ready = True, cluster.ready
                    if ready and self._is_due(bucket) and not await _hand_over(path, bucket, ready[0]):
                        return
        finally:
            await end_tasks(*looks)
        if found == len(looks) and not has_silent:
            self._silent_since = None

    def _is_due(self, bucket: str) -> bool:
        now = self._clock()
        if self._silent_since is None:
            self._silent_since = now
        if now - self._silent_since > FOR_S or now - self._handed_at.get(bucket, -EVERY_S) < EVERY_S:
            return False
        self._handed_at[bucket] = now
        return True


async def _named(path: ServerPath, bucket: str) -> tuple[str, Cluster]:
    return bucket, await known_cluster(path, bucket)


async def _hand_over(path: ServerPath, bucket: str, server: str) -> bool:
    """Hand a bucket over, and return True once this server leads it."""
    wanted = {"placement": {"preferred": server}}
    with suppress(FleetError):
        await ask(path, f"STREAM.LEADER.STEPDOWN.KV_{bucket}", wanted)
    with suppress(TimeoutError):
        async with asyncio.timeout(DONE_S):
            while (await known_cluster(path, bucket)).leader != server:
                await asyncio.sleep(LOOK_S)
            return True
    return False
