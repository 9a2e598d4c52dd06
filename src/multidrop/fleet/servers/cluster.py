"""Cluster: the servers that keep a bucket, as JetStream tells of them once that has their shape. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from multidrop.fleet.errors import Unsure
from multidrop.fleet.lines.record_shapes import misshapen

SILENT_NS = 2_000_000_000  # a follower answers its leader's heartbeat once a second
_CLUSTER = {"leader": str, "replicas": list}  # left out where there is none
_REPLICA = {"name": str, "current": bool, "offline": bool, "active": int}


class Replica(NamedTuple):
    """A server that follows a bucket's leader."""

    name: str
    is_current: bool
    is_offline: bool
    active_ns: int  # since the leader heard it; 0 for never

    @property
    def is_ready(self) -> bool:
        """Say whether it could lead now."""
        return self.is_current and not self.is_offline

    @property
    def is_silent(self) -> bool:
        """Say whether it was not heard for long, or never; one that lags is heard."""
        return not self.is_current and not 0 < self.active_ns < SILENT_NS


class Cluster(NamedTuple):
    """A bucket's leader, "" for none, and those that follow it."""

    leader: str = ""
    followers: tuple[Replica, ...] = ()

    def home_of(self, place: int) -> str:
        """Return the server that should lead the bucket at this place: they take turns, in order of name."""
        servers = sorted([self.leader, *(follower.name for follower in self.followers)])
        return servers[place % len(servers)]

    @property
    def has_silent(self) -> bool:
        """Say whether one of them is silent."""
        return any(follower.is_silent for follower in self.followers)

    @property
    def ready(self) -> list[str]:
        """Return the followers that could lead now."""
        return [follower.name for follower in self.followers if follower.is_ready]


def cluster_of(info: Mapping[str, Any]) -> Cluster | None:
    """Return the cluster in a stream's state; None where a server keeps it alone.

    Raises Unsure for what is no cluster.
    """
    if "cluster" not in info:
        return None
    told = _believed(info["cluster"], _CLUSTER, leader="", replicas=[])
    usual = {"current": False, "offline": False, "active": 0}
    followers = (_believed(one, _REPLICA, **usual) for one in told["replicas"])
    return Cluster(
        told["leader"],
        tuple(Replica(one["name"], one["current"], one["offline"], one["active"]) for one in followers),
    )


def _believed(told: Any, shape: Mapping[str, type], **usual: Any) -> dict[str, Any]:
    """Return a table with what is left out of it, or null. Raises Unsure for another shape."""
    found = told
    if isinstance(told, dict):
        found = {**usual, **{name: value for name, value in told.items() if value is not None}}
    if mistake := misshapen(found, shape):
        raise Unsure(f"what NATS answers of a bucket's servers is none of JetStream's: {mistake}")
    return dict(found)
