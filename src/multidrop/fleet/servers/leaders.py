"""Leaders of buckets: each at a server of its own, so that one dead server stops one path alone."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from contextlib import suppress

from multidrop.fleet.errors import FleetError
from multidrop.fleet.lines.ownership import NEEDED
from multidrop.fleet.servers import names
from multidrop.fleet.servers.buckets import ask
from multidrop.fleet.servers.cluster import Cluster, cluster_of
from multidrop.fleet.servers.connections import ServerPath
from multidrop.fleet.task_end import end_tasks

SOON_S = 0.4  # at rest it takes some milliseconds


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


async def led_clusters(path: ServerPath) -> dict[str, Cluster]:
    """Return the servers of those buckets of leases and of lines' masters whose leader answers soon.

    One whose server is cut off answers nothing, and holds the others up no longer than that.
    """
    buckets = (*names.LEASES, *names.OWNERS)
    looks = [asyncio.create_task(known_cluster(path, bucket)) for bucket in buckets]
    try:
        await asyncio.wait(looks, timeout=SOON_S)
    finally:
        found = await end_tasks(*looks)
    return {
        bucket: one
        for bucket, one in zip(buckets, found, strict=True)
        if isinstance(one, Cluster) and one.leader
    }


async def bring_leaders_home(path: ServerPath, clusters: Mapping[str, Cluster]) -> int:
    """Ask leaders elsewhere to step down in favour of their home; return how many were asked."""
    moved = 0
    for group in (names.LEASES, names.OWNERS):
        for place, bucket in enumerate(group):
            if bucket in clusters:
                home = clusters[bucket].home_of(place)
                if home in clusters[bucket].ready:
                    await hand_over(path, bucket, home)
                    moved += 1
    return moved


async def hand_over(path: ServerPath, bucket: str, server: str) -> None:
    """Ask the leader of a bucket to step down in favour of this server."""
    with suppress(FleetError):
        wanted = {"placement": {"preferred": server}}
        await ask(path, f"STREAM.LEADER.STEPDOWN.KV_{bucket}", wanted)
