"""Raft terms of the lease buckets: which are handed over while a server is silent, with fake servers."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Any

import pytest
from controlled_loop import run_controlled

from multidrop.fleet.errors import Unsure
from multidrop.fleet.servers import leaders, names
from multidrop.fleet.servers.leaders import (
    HAND_OVER_S,
    SILENT_FOR_S,
    SOON_S,
    LeaseTerms,
    bring_leaders_home,
    keep_leaders,
    led_clusters,
)

SERVERS = ("n1", "n2", "n3")
PATH: Any = None
ASKS_S = 4.0  # a server without contact may ask for votes after this time


class Servers:
    """Three fake servers. Each bucket has a leader and a Raft term."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.leaders = dict(zip((*names.LEASES, *names.OWNERS), 2 * SERVERS, strict=True))
        self.terms = dict.fromkeys(names.LEASES, 1)
        self.silent: set[str] = set()
        self.unheard_ns = 0  # time since the leader last heard the server; 0 for never
        self.lagging: set[str] = set()
        self.stuck: set[str] = set()  # buckets that have no leader after a hand-over
        self.under_way = 0
        self.now = 0.0
        self.found = LeaseTerms(lambda: self.now)
        monkeypatch.setattr(leaders, "ask", self.ask)

    async def ask(self, path: Any, subject: str, data: Mapping[str, Any] | None = None) -> dict[str, Any]:
        bucket = subject.rpartition("KV_")[2]
        leader = self.leaders[bucket]
        if not leader or leader in self.silent:
            await asyncio.sleep(1.0)
            raise Unsure("no answer")
        if data is not None:
            assert self.under_way == 0, "two buckets are without a leader"
            self.under_way += 1
            await asyncio.sleep(0.05)
            self.under_way -= 1
            self.leaders[bucket] = "" if bucket in self.stuck else data["placement"]["preferred"]
            if bucket in self.terms:
                self.terms[bucket] += 1
            return {}
        peers = [
            {
                "name": one,
                "current": not {one} & (self.silent | self.lagging),
                "active": self.unheard_ns if one in self.silent else 700_000_000,
            }
            for one in SERVERS
            if one != leader
        ]
        return {"cluster": {"leader": leader, "replicas": peers}}

    def pass_s(self, seconds: int) -> None:
        """Let this time pass, with one round of hand-overs per second."""

        async def main() -> None:
            for _ in range(seconds):
                clusters = await led_clusters(PATH)
                await self.found.keep_ahead(PATH, clusters)
                self.now += 1

        run_controlled(main())


@pytest.fixture
def servers(monkeypatch: pytest.MonkeyPatch) -> Servers:
    return Servers(monkeypatch)


def test_nothing_is_handed_over_while_no_server_is_silent(servers: Servers) -> None:
    servers.pass_s(100)
    assert set(servers.terms.values()) == {1}


def test_nothing_is_handed_over_because_a_server_lags(servers: Servers) -> None:
    servers.lagging = {"n3"}
    servers.pass_s(10)
    assert set(servers.terms.values()) == {1}


@pytest.mark.parametrize(("unheard_ns", "is_due"), [(1_900_000_000, False), (2_100_000_000, True), (0, True)])
def test_a_server_is_silent_after_two_missed_heartbeats(
    servers: Servers, unheard_ns: int, is_due: bool
) -> None:
    servers.silent, servers.unheard_ns = {"n3"}, unheard_ns
    servers.pass_s(1)
    assert (servers.terms[names.LEASES[0]] > 1) is is_due


def test_terms_grow_faster_than_a_silent_server_can_ask_for_votes(servers: Servers) -> None:
    servers.silent = {"n3"}
    for second in range(60):
        servers.pass_s(1)
        for bucket in names.LEASES[:2]:
            assert servers.terms[bucket] > 1 + second // 4
            assert servers.leaders[bucket] in ("n1", "n2")
    assert servers.terms[names.LEASES[2]] == 1  # the bucket has no leader that could hand it over
    assert HAND_OVER_S < ASKS_S


def test_a_bucket_with_a_new_leader_is_handed_over(servers: Servers) -> None:
    servers.silent = {"n3"}
    servers.leaders[names.LEASES[2]] = "n1"
    servers.pass_s(1)
    assert servers.terms[names.LEASES[2]] == 2
    assert servers.leaders[names.LEASES[2]] == "n2"


def test_a_long_silent_server_is_ignored_until_it_returns(servers: Servers) -> None:
    servers.silent = {"n3"}
    servers.leaders[names.LEASES[2]] = "n1"
    servers.pass_s(round(SILENT_FOR_S) + 5)
    before = dict(servers.terms)
    servers.pass_s(20)
    assert servers.terms == before
    servers.silent = set()
    servers.pass_s(1)
    servers.silent = {"n3"}
    servers.pass_s(1)
    assert all(servers.terms[bucket] > before[bucket] for bucket in names.LEASES)


def test_after_a_failed_hand_over_no_other_bucket_is_handed_over(servers: Servers) -> None:
    servers.silent, servers.stuck = {"n3"}, set(names.LEASES)
    servers.leaders[names.LEASES[2]] = "n1"
    servers.pass_s(1)
    assert sorted(servers.terms.values()) == [1, 1, 2]


def test_a_single_server_hands_nothing_over(servers: Servers) -> None:
    servers.silent = {"n2", "n3"}
    servers.pass_s(10)
    assert set(servers.terms.values()) == {1}


def test_a_silent_leader_does_not_delay_other_hand_overs(servers: Servers) -> None:
    servers.silent = {"n2"}

    async def main() -> None:
        begun = asyncio.get_running_loop().time()
        clusters = await led_clusters(PATH)
        assert asyncio.get_running_loop().time() - begun == pytest.approx(SOON_S)
        assert [cluster.leader for cluster in clusters.values()] == ["n1", "n3", "n1", "n3"]
        assert await bring_leaders_home(PATH, clusters) == 0

    run_controlled(main())


@pytest.mark.parametrize("cut_after_s", [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7])
def test_terms_are_ahead_before_a_server_that_was_cut_off_asks_for_votes(
    cut_after_s: float, servers: Servers
) -> None:
    """Leaders on the cut-off server do not answer. The other leaders report after 2 s that it is silent."""

    async def main() -> None:
        keeping = asyncio.create_task(
            keep_leaders(lambda: PATH, lambda: True, asyncio.get_running_loop().time)
        )
        await asyncio.sleep(10 + cut_after_s)
        servers.silent, servers.unheard_ns = {"n2"}, 1
        await asyncio.sleep(2.0)
        servers.unheard_ns = 2_000_000_000
        await asyncio.sleep(ASKS_S - 2.0)
        assert min(servers.terms["lease_0"], servers.terms["lease_2"]) > 1
        keeping.cancel()

    run_controlled(main())


def test_leaderships_return_to_their_home_servers(servers: Servers) -> None:
    """A leadership that was handed over because of a silent server returns too."""
    servers.leaders |= {"lease_0": "n2", "own_2": "n1"}
    servers.lagging = {"n1"}

    async def main() -> None:
        assert await bring_leaders_home(PATH, await led_clusters(PATH)) == 1
        servers.lagging = set()
        assert await bring_leaders_home(PATH, await led_clusters(PATH)) == 1
        assert await bring_leaders_home(PATH, await led_clusters(PATH)) == 0

    run_controlled(main())
    assert list(servers.leaders.values()) == list(2 * SERVERS)
