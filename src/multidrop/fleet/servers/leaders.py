"""Leaders of buckets: each bucket is led by another server, so that one failed server stops only one path.

A server that is cut off from the others starts an election every 4 to 9 s, each time in a newer term, though
the others do not hear it. When it returns, a leader with an older term steps down, and the bucket has no
leader for 4 to 9 s. If that happens to two of the lease buckets, no line is polled. Handing over a leadership
also starts a newer term, and takes an instant. So while a server is silent, leadership of the lease buckets
is handed over more often than that server starts elections, and its term stays older. Which gateway may poll
depends only on revisions, whichever server leads.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, NamedTuple

from multidrop.fleet.errors import FleetError, Unsure
from multidrop.fleet.lines.ownership import NEEDED
from multidrop.fleet.servers import names
from multidrop.fleet.servers.buckets import ask
from multidrop.fleet.servers.connections import ServerPath
from multidrop.supervisor import end_tasks

SILENT_NS = 2_000_000_000  # without an answer; a follower answers its leader once a second


class Replica(NamedTuple):
    """A server that follows a bucket's leader."""

    name: str
    is_current: bool
    is_offline: bool
    active_ns: int  # time since the leader heard from it; 0 for never

    @property
    def is_ready(self) -> bool:
        """Return True if this server could lead now."""
        return self.is_current and not self.is_offline

    @property
    def is_silent(self) -> bool:
        """Return True if the leader never heard this server, or not for 2 s. A lagging server is heard."""
        return not self.is_current and not 0 < self.active_ns < SILENT_NS


class Cluster(NamedTuple):
    """A bucket's leader, "" for none, and its followers."""

    leader: str = ""
    followers: tuple[Replica, ...] = ()

    def home_of(self, place: int) -> str:
        """Return the server that should lead bucket number `place`; servers take turns in order of name."""
        servers = sorted([self.leader, *(follower.name for follower in self.followers)])
        return servers[place % len(servers)]

    @property
    def has_silent(self) -> bool:
        """Return True if one of the followers is silent."""
        return any(follower.is_silent for follower in self.followers)

    @property
    def ready(self) -> list[str]:
        """Return the followers that could lead now."""
        return [follower.name for follower in self.followers if follower.is_ready]


def cluster_of(info: Mapping[str, Any], path: ServerPath) -> Cluster:
    """Return the cluster in a stream's state: the present server alone if the stream is not replicated.

    Raises Unsure for an invalid state.
    """
    if "cluster" not in info:
        return Cluster(path.server_name)
    try:
        found = info["cluster"]
        followers = [
            Replica(
                str(one["name"]),
                bool(one.get("current")),
                bool(one.get("offline")),
                int(one.get("active", 0)),
            )
            for one in found.get("replicas") or ()
        ]
        return Cluster(str(found.get("leader") or ""), tuple(followers))
    except (AttributeError, KeyError, TypeError, ValueError):
        raise Unsure("the answer of NATS about a bucket's servers is invalid") from None


SOON_S = 0.4  # time limit for leaders' answers, which usually take some milliseconds


async def known_cluster(path: ServerPath, bucket: str) -> Cluster:
    """Return the servers of a bucket; a cluster without a leader if none answers."""
    with suppress(FleetError):
        return cluster_of(await ask(path, f"STREAM.INFO.KV_{bucket}"), path)
    return Cluster()


async def have_leaders(path: ServerPath) -> bool:
    """Return True if lines can be claimed: enough buckets of masters have a leader that answers."""
    clusters = await asyncio.gather(*(known_cluster(path, bucket) for bucket in names.OWNERS))
    return sum(bool(cluster.leader) for cluster in clusters) >= NEEDED


async def led_clusters(path: ServerPath) -> dict[str, Cluster]:
    """Return the servers of those lease and master buckets whose leader answers within SOON_S."""
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
    """Ask each leader other than the home server to step down in its favour; return how many were asked."""
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


HAND_OVER_S = 3.0  # time between hand-overs of a bucket: less than the shortest time between two elections
SILENT_FOR_S = 60.0  # a server that is silent for longer is ignored
HANDED_S = 1.0  # time limit of a hand-over, which takes 0.03 to 0.3 s
LEADER_LOOK_S = 0.02


class LeaseTerms:
    """Keeps the terms of the lease buckets newer than a silent server's, by hand-overs."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._silent_since: float | None = None
        self._handed_at: dict[str, float] = {}  # time of the last hand-over, by bucket

    async def keep_ahead(self, path: ServerPath, clusters: Mapping[str, Cluster]) -> bool:
        """Hand over the lease buckets that are due, and return True if any was.

        Stop after a hand-over that fails, so that at most one bucket waits for an election because of this.
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
        if (
            now - self._silent_since > SILENT_FOR_S
            or now - self._handed_at.get(bucket, -HAND_OVER_S) < HAND_OVER_S
        ):
            return False
        self._handed_at[bucket] = now
        return True


async def _leads_now(path: ServerPath, bucket: str, server: str) -> bool:
    """Hand a bucket over to this server; return True once the server leads it, False after HANDED_S."""
    await hand_over(path, bucket, server)
    with suppress(TimeoutError):
        async with asyncio.timeout(HANDED_S):
            while (await known_cluster(path, bucket)).leader != server:
                await asyncio.sleep(LEADER_LOOK_S)
            return True
    return False


KEEP_S = 0.4  # leaders report a silent server after 2 s; that server starts elections after 4 s


async def keep_leaders(
    path: Callable[[], ServerPath], is_ours: Callable[[], bool], clock: Callable[[], float] = time.monotonic
) -> None:
    """Manage the buckets' leaders forever, as long as `is_ours()` returns True."""
    terms = LeaseTerms(clock)
    while True:
        await asyncio.sleep(KEEP_S)
        if is_ours():
            best = path()
            clusters = await led_clusters(best)
            if not await terms.keep_ahead(best, clusters):
                await bring_leaders_home(best, clusters)
