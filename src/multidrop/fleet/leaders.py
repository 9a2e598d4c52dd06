"""Leaders of buckets: each at a server of its own, so that one dead server stops one path alone."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from contextlib import suppress
from typing import Any

from multidrop.fleet import names
from multidrop.fleet.buckets import ask
from multidrop.fleet.errors import FleetError, Unsure
from multidrop.fleet.servers import ServerPath


def home_of(place: int, cluster: Mapping[str, Any]) -> str:
    """Return the server that should lead the bucket at this place: they take turns, in order of name."""
    servers = sorted([cluster.get("leader", ""), *(peer["name"] for peer in cluster.get("replicas", []))])
    return str(servers[place % len(servers)])


def is_ready(server: str, cluster: Mapping[str, Any]) -> bool:
    """Say whether a follower could lead now."""
    peers = {peer["name"]: peer for peer in cluster.get("replicas", [])}
    return bool(server in peers and peers[server].get("current") and not peers[server].get("offline"))


async def has_leader(path: ServerPath, bucket: str) -> bool:
    """Say whether a bucket has a leader that answers: else no record of it can be written."""
    try:
        info = await ask(path, f"STREAM.INFO.KV_{bucket}")
    except FleetError:
        return False
    return "cluster" not in info or bool(info["cluster"].get("leader"))


async def have_leaders(path: ServerPath) -> bool:
    """Say whether each bucket of lines' masters has a leader that answers: else no line can be claimed."""
    for bucket in names.OWNERS:
        if not await has_leader(path, bucket):
            return False
    return True


async def owners_led_by(servers: Collection[str], path: ServerPath) -> tuple[str, ...]:
    """Return the buckets of lines' masters whose leader has one of these servers for its home.

    Raises FleetError where that cannot be said now.
    """
    found = []
    for place, bucket in enumerate(names.OWNERS):
        info = await ask(path, f"STREAM.INFO.KV_{bucket}")
        cluster = info.get("cluster", {"leader": path.server_name})
        if not cluster.get("leader"):
            raise Unsure(f"the bucket {bucket} has no leader")
        if home_of(place, cluster) in servers:
            found.append(bucket)
    return tuple(found)


async def bring_leaders_home(path: ServerPath) -> int:
    """Ask leaders elsewhere to step down in favour of their home; return how many were asked."""
    moved = 0
    for group in (names.LEASES, names.OWNERS):
        for place, bucket in enumerate(group):
            with suppress(FleetError):
                info = await ask(path, f"STREAM.INFO.KV_{bucket}")
                cluster = info.get("cluster") or {}
                if not cluster.get("leader"):
                    continue
                home = home_of(place, cluster)
                if cluster["leader"] != home and is_ready(home, cluster):
                    wanted = {"placement": {"preferred": home}}
                    await ask(path, f"STREAM.LEADER.STEPDOWN.KV_{bucket}", wanted)
                    moved += 1
    return moved
