"""Leaders of buckets. Three lease buckets have three different leaders, so one failed server stops only one.

A server that is cut off starts an election every 4 to 9 s, each in a newer term of Raft, although no other
server receives its messages. When it returns, a leader with an older term steps down, and its bucket has no
leader for 4 to 9 s. If that happens to two lease buckets, no line is polled. A hand-over of the leadership
also starts a newer term, but takes only an instant. So while a server is silent, the lease buckets are handed
over more often than that server starts elections. The terms of the silent server then stay older. Which
server leads a bucket has no effect on which gateway may poll: only the records' revisions decide that.

A line can change its master only while its buckets have leaders. So a gateway asks Releases before it hands
over a line.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Mapping, Set
from contextlib import suppress
from typing import Any, NamedTuple

from multidrop.fleet.errors import FleetError, OutcomeUnknown
from multidrop.fleet.lines.rules import NEEDED
from multidrop.fleet.servers import names
from multidrop.fleet.servers.buckets import ask
from multidrop.fleet.servers.connections import ServerPath
from multidrop.supervisor import end_tasks

# a server counts as silent after this time (in ns); followers contact their leader once a second
SILENT_NS = 2_000_000_000
SOON_S = 0.4  # time limit for a leader's answer, which usually takes some milliseconds
# Pause between two changes of a bucket's leader. It is shorter than the time between two elections that a
# silent server starts.
HAND_OVER_S = 3.0
# A server that is silent for longer than this is ignored: no bucket changes its leader because of it, and
# gateways hand over lines without waiting for it.
SILENT_SERVER_S = 60.0
RELEASE_LOOK_S = 0.05  # pause between checks of the servers' states while a line waits to be handed over
HANDED_S = 1.0  # time limit for a change of a bucket's leader, which takes 0.03 to 0.3 s
LEADER_LOOK_S = 0.02
# Pause between checks by `keep_leaders`. Leaders report a silent server after 2 s, and the server starts its
# first election after 4 s. So several checks find the silent server before that election.
KEEP_S = 0.4


class Replica(NamedTuple):
    """A server that follows a bucket's leader."""

    name: str
    is_current: bool
    is_offline: bool
    active_ns: int  # ns since the leader last received a message from this server; 0: never

    @property
    def is_ready(self) -> bool:
        return self.is_current and not self.is_offline

    @property
    def is_silent(self) -> bool:
        """Return True if the bucket's leader has received no message from this follower for 2 s, or never.

        A follower whose copy of the bucket is old is not silent while its messages arrive.
        """
        return not self.is_current and not 0 < self.active_ns < SILENT_NS


class Cluster(NamedTuple):
    """The leader of a bucket ("" for none) and the servers that follow it."""

    leader: str = ""
    followers: tuple[Replica, ...] = ()

    def home_of(self, place: int) -> str:
        """Return the server that should lead bucket number `place`.

        The servers, sorted by name, take the buckets in turn.
        """
        servers = sorted([self.leader, *(follower.name for follower in self.followers)])
        return servers[place % len(servers)]

    @property
    def has_silent(self) -> bool:
        return any(follower.is_silent for follower in self.followers)

    @property
    def ready(self) -> list[str]:
        """Return the followers that could become leader now."""
        return [follower.name for follower in self.followers if follower.is_ready]


def cluster_of(info: Mapping[str, Any], path: ServerPath) -> Cluster:
    """Return the leader and the followers of a stream, from its state in `info`.

    The present server is the leader of a stream without replicas. Raises OutcomeUnknown if `info` is invalid.
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
        raise OutcomeUnknown("the answer of NATS about a bucket's servers is invalid") from None


async def known_cluster(path: ServerPath, bucket: str) -> Cluster:
    """Return a bucket's leader and followers. If no server answers, the result has no leader."""
    with suppress(FleetError):
        return cluster_of(await ask(path, f"STREAM.INFO.KV_{bucket}"), path)
    return Cluster()


async def have_leaders(path: ServerPath) -> bool:
    """Return True if lines can be claimed: two of the three ownership buckets have a leader."""
    clusters = await asyncio.gather(*(known_cluster(path, bucket) for bucket in names.OWNERS))
    return sum(bool(cluster.leader) for cluster in clusters) >= NEEDED


async def led_clusters(path: ServerPath) -> dict[str, Cluster]:
    """Return the lease and ownership buckets whose leaders answer within SOON_S, with their clusters."""
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
    """Make the server that should lead a bucket its leader, if that server is ready.

    Return the number of buckets whose leader has changed.
    """
    moved = 0
    for place, bucket in (*enumerate(names.LEASES), *enumerate(names.OWNERS)):
        if cluster := clusters.get(bucket):
            home = cluster.home_of(place)
            if home in cluster.ready:
                await hand_over(path, bucket, home)
                moved += 1
    return moved


async def hand_over(path: ServerPath, bucket: str, server: str) -> None:
    """Ask the leader of a bucket to step down in favour of this server; ignore a failure."""
    with suppress(FleetError):
        wanted = {"placement": {"preferred": server}}
        await ask(path, f"STREAM.LEADER.STEPDOWN.KV_{bucket}", wanted)


class LeaseTerms:
    """Changes the leaders of lease buckets regularly while a server is silent.

    Each change starts a newer term of Raft, so that the silent server's term stays older. Otherwise the
    buckets would lose their leaders when that server returns.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._silent_since: float | None = None
        self._handed_at: dict[str, float] = {}  # time of the last change of leaders, by bucket

    async def keep_ahead(self, path: ServerPath, clusters: Mapping[str, Cluster]) -> bool:
        """Change the leader of each lease bucket that has a silent server.

        Skip a bucket whose leader was changed less than HAND_OVER_S ago. Stop after a change that failed, so
        that at most one bucket must wait for an election. Return True if a change was tried.
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
            now - self._silent_since > SILENT_SERVER_S
            or now - self._handed_at.get(bucket, -HAND_OVER_S) < HAND_OVER_S
        ):
            return False
        self._handed_at[bucket] = now
        return True


async def _leads_now(path: ServerPath, bucket: str, server: str) -> bool:
    """Make this server the leader of a bucket; return True once it is the leader.

    Return False if that takes longer than HANDED_S.
    """
    await hand_over(path, bucket, server)
    with suppress(TimeoutError):
        async with asyncio.timeout(HANDED_S):
            while (await known_cluster(path, bucket)).leader != server:
                await asyncio.sleep(LEADER_LOOK_S)
            return True
    return False


async def keep_leaders(
    path: Callable[[], ServerPath], is_ours: Callable[[], bool], clock: Callable[[], float] = time.monotonic
) -> None:
    """Manage the buckets' leaders whenever `is_ours()` returns True. Runs until it is cancelled."""
    terms = LeaseTerms(clock)
    while True:
        await asyncio.sleep(KEEP_S)
        if is_ours():
            best = path()
            clusters = await led_clusters(best)
            if not await terms.keep_ahead(best, clusters):
                await bring_leaders_home(best, clusters)


# ---- lines that are handed over to other gateways ----


class Releases:
    """Decides which lines this gateway may hand over to other gateways now.

    A line that is handed over has no master for a moment: this gateway's release must be stored, and then
    the claim of the next gateway. The servers store both only in buckets with a leader. So this gateway keeps
    polling a line while too few buckets have a leader. It also does so while a server is silent, because
    buckets may lose their leaders for seconds when that server returns.

    `on_change` is called when the servers' state has changed.
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
        # For each bucket with a leader: since when (s) one of its servers is silent; None if all answer.
        self._led: dict[str, float | None] = {}

    def due(self, lines: Set[str], wait_s: float = SILENT_SERVER_S) -> set[str]:
        """Return the lines in `lines` that may be handed over now; the other lines must wait.

        A bucket is ready if it has a leader and no silent server. A server that is silent for longer than
        `wait_s` seconds is ignored. At least two buckets must be ready, including the line's first
        bucket, since its record may be enough to make a gateway the master.
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
            await asyncio.sleep(RELEASE_LOOK_S)

    async def look(self) -> None:
        """Check the servers' states once, if this gateway has lines to hand over."""
        buckets = names.OWNERS if self._has_lines else ()
        found = await asyncio.gather(*(known_cluster(self._path(), bucket) for bucket in buckets))
        now, before, self._led = self._clock(), self._led, {}
        for bucket, cluster in zip(buckets, found, strict=True):
            if cluster.leader:
                since = before.get(bucket)
                self._led[bucket] = (now if since is None else since) if cluster.has_silent else None
        if self._led != before:
            self._on_change()
