"""Leaders of buckets: each at a server of its own, so that one dead server stops one path alone."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from multidrop.fleet import names
from multidrop.fleet.buckets import ask
from multidrop.fleet.errors import FleetError
from multidrop.fleet.servers import ServerPath


def home_of(place: int, cluster: Mapping[str, Any]) -> str:
    """Return the server that should lead the bucket at this place: they take turns, in order of name."""
    servers = sorted([cluster.get("leader", ""), *(peer["name"] for peer in cluster.get("replicas", []))])
    return str(servers[place % len(servers)])


def is_ready(server: str, cluster: Mapping[str, Any]) -> bool:
    """Say whether a follower could lead now."""
    peers = {peer["name"]: peer for peer in cluster.get("replicas", [])}
    return bool(server in peers and peers[server].get("current") and not peers[server].get("offline"))


async def have_leaders(path: ServerPath) -> bool:
    """Say whether each bucket of lines' masters has a leader that answers: else no line can be claimed."""
    try:
        infos = [await ask(path, f"STREAM.INFO.KV_{bucket}") for bucket in names.OWNERS]
    except FleetError:
        return False
    return all("cluster" not in info or info["cluster"].get("leader") for info in infos)


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
