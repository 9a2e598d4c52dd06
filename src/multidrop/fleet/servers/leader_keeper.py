"""Leader keeper: brings the leaders of buckets home, and keeps those of leases ahead of a silent server."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

from multidrop.fleet.leases.terms import LeaseTerms
from multidrop.fleet.servers.connections import ServerPath
from multidrop.fleet.servers.leaders import bring_leaders_home, led_clusters

LOOK_S = 0.4  # between looks: leaders tell after 2 s that a server is silent, which asks for votes after 4 s


async def keep_leaders(
    path: Callable[[], ServerPath], is_ours: Callable[[], bool], clock: Callable[[], float] = time.monotonic
) -> None:
    """Keep leaders for ever, whenever that is ours to do."""
    terms = LeaseTerms(clock)
    while True:
        await asyncio.sleep(LOOK_S)
        if is_ours():
            best = path()
            clusters = await led_clusters(best)
            if not await terms.keep_ahead(best, clusters):
                await bring_leaders_home(best, clusters)
