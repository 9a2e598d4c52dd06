"""Leaders of buckets: each at a server of its own, so that one dead server stops one path alone."""

from __future__ import annotations

import asyncio
from contextlib import suppress

from multidrop.fleet import names
from multidrop.fleet.buckets import ask
from multidrop.fleet.cluster import Cluster, cluster_of
from multidrop.fleet.errors import FleetError
from multidrop.fleet.ownership import NEEDED
from multidrop.fleet.servers import ServerPath


async def cluster_at(path: ServerPath, bucket: str) -> Cluster | None:
    """Return the servers of a bucket, None for one server alone. Raises FleetError where none answers."""
    return cluster_of(await ask(path, f"STREAM.INFO.KV_{bucket}"))


async def known_cluster(path: ServerPath, bucket: str) -> Cluster:
    """Return the servers of a bucket, of which one alone leads; nobody leads where none answers."""
    with suppress(FleetError):
        return await cluster_at(path, bucket) or Cluster(path.server_name)
    return Cluster()


async def has_leader(path: ServerPath, bucket: str) -> bool:
    """Say whether a bucket has a leader that answers: else no record of it can be written."""
    return bool((await known_cluster(path, bucket)).leader)


async def have_leaders(path: ServerPath) -> bool:
    """Say whether enough buckets of lines' masters have a leader that answers for lines to be claimed."""
    led = await asyncio.gather(*(has_leader(path, bucket) for bucket in names.OWNERS))
    return sum(led) >= NEEDED


async def bring_leaders_home(path: ServerPath) -> int:
    """Ask leaders elsewhere to step down in favour of their home; return how many were asked."""
    moved = 0
    for group in (names.LEASES, names.OWNERS):
        for place, bucket in enumerate(group):
            with suppress(FleetError):
                cluster = await cluster_at(path, bucket)
                if cluster is None or not cluster.leader:
                    continue
                home = cluster.home_of(place)
                if home in cluster.ready:
                    wanted = {"placement": {"preferred": home}}
                    await ask(path, f"STREAM.LEADER.STEPDOWN.KV_{bucket}", wanted)
                    moved += 1
    return moved
