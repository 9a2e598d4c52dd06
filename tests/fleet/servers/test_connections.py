"""Repeated reads, and changes of buckets' leaders, with fake servers in simulated time."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from typing import Any

import pytest
from controlled_loop import run_controlled

from multidrop.fleet.errors import FleetError, NoRight, OutcomeUnknown
from multidrop.fleet.servers import leaders, names
from multidrop.fleet.servers.batch_client import DirectGet, DirectMessage, Request
from multidrop.fleet.servers.connections import AGAIN_S, EARNED, MOST_REPEATS, RepeatBudget, first_answer
from multidrop.fleet.servers.leaders import (
    HAND_OVER_S,
    SILENT_SERVER_S,
    SOON_S,
    LeaseTerms,
    bring_leaders_home,
    keep_leaders,
    led_clusters,
)

run_test = run_controlled  # runs the async tests
NEVER = 1e9
REQUEST = Request("questions", b"")


class SlowPath:
    """A fake server connection that answers its requests after these delays in s, or fails."""

    def __init__(self, name: str, *delays: float, failure: FleetError | None = None, gap: float = 0) -> None:
        self.name = name
        self.asked: list[float] = []
        self._delays = [*delays]
        self._failure = failure
        self._gap = gap  # pause between two messages, in s
        self.under_way = 0

    async def gather(self, request: Request, get: DirectGet) -> None:
        self.asked.append(round(asyncio.get_running_loop().time() - 1000.0, 3))
        self.under_way += 1
        try:
            await asyncio.sleep(self._delays.pop(0) if self._delays else NEVER)
            for number in range(3):
                if self._failure:
                    raise self._failure
                get.messages.append(DirectMessage(self.name, number, b""))
                get.count += 1
                await asyncio.sleep(self._gap)
        finally:
            self.under_way -= 1


async def answer(*paths: SlowPath) -> tuple[str, float]:
    """Send one read; return which connection's answer was used, and after how many s."""
    found = await first_answer(paths, REQUEST, full())
    took = asyncio.get_running_loop().time() - 1000.0
    assert [message.sequence for message in found] == [0, 1, 2]
    await asyncio.sleep(0)  # lets the other requests end
    assert [path.under_way for path in paths] == [0] * len(paths)
    return found[0].subject, round(took, 3)


def full() -> RepeatBudget:
    """Return a full budget for repeated reads, as after some time without load."""
    budget = RepeatBudget()
    for _ in range(round(MOST_REPEATS / EARNED)):
        budget.note(is_late=False)
        budget.learn(0.01)
    return budget


def asked(paths: Sequence[SlowPath]) -> list[list[float]]:
    return [path.asked for path in paths]


async def test_a_read_with_a_prompt_answer_sends_only_one_request() -> None:
    paths = [SlowPath("a", 0.01), SlowPath("b", 0.01), SlowPath("c", 0.01)]
    assert await answer(*paths) == ("a", 0.01)
    assert asked(paths) == [[0.0], [], []]


async def test_an_unanswered_read_is_repeated_on_all_connections() -> None:
    """The first server may have forwarded the request to a server that is cut off."""
    paths = [SlowPath("a"), SlowPath("b", NEVER, 0.01), SlowPath("c")]
    assert await answer(*paths) == ("b", 0.21)
    assert asked(paths) == [[0.0, 0.2], [0.1, 0.2], [0.1, 0.2]]


async def test_a_late_answer_to_the_first_request_is_used_even_after_a_repeat() -> None:
    paths = [SlowPath("a", 0.15), SlowPath("b")]
    assert await answer(*paths) == ("a", 0.15)


async def test_a_long_answer_is_not_requested_again_while_parts_arrive() -> None:
    paths = [SlowPath("a", 0.01, gap=0.09), SlowPath("b", 0.01)]
    assert await answer(*paths) == ("a", 0.28)
    assert asked(paths) == [[0.0], []]


async def test_failed_read_is_repeated_immediately_on_another_connection() -> None:
    paths = [SlowPath("a", 0.0, failure=OutcomeUnknown("lost")), SlowPath("b", 0.01), SlowPath("c")]
    assert await answer(*paths) == ("b", 0.01)


@pytest.mark.parametrize("number", [1, 2, 3])
async def test_read_raises_immediately_after_failing_on_all_connections(number: int) -> None:
    paths = [SlowPath("a", 0.01, failure=OutcomeUnknown("it ended with 503")) for _ in range(number)]
    with pytest.raises(OutcomeUnknown, match="503"):
        await answer(*paths)
    assert asked(paths) == [[0.0], *[[0.01]] * (number - 1)]


async def test_a_forbidden_read_is_not_repeated() -> None:
    paths = [SlowPath("a", 0.01, failure=NoRight("no")), SlowPath("b", 0.01)]
    with pytest.raises(NoRight):
        await answer(*paths)
    assert asked(paths) == [[0.0], []]


async def test_read_raises_if_all_repeats_are_unanswered() -> None:
    paths = [SlowPath("a"), SlowPath("b"), SlowPath("c")]
    with pytest.raises(OutcomeUnknown, match="no answer to questions"):
        await first_answer(paths, REQUEST, full())
    assert asyncio.get_running_loop().time() - 1000.0 == pytest.approx(sum(AGAIN_S))
    assert [len(path.asked) for path in paths] == [4, 4, 4]
    assert [path.under_way for path in paths] == [0, 0, 0]


class LatePath(SlowPath):
    """A fake server connection that always answers after `delay` seconds."""

    def __init__(self, delay: float) -> None:
        super().__init__("late")
        self.delay = delay

    async def gather(self, request: Request, get: DirectGet) -> None:
        self._delays = [self.delay]
        await super().gather(request, get)


async def questions(reads: int, paths: Sequence[LatePath], budget: RepeatBudget) -> int:
    """Send this many reads one after another; return how many requests were sent for them."""
    before = sum(map(len, asked(paths)))
    for _ in range(reads):
        await first_answer(paths, REQUEST, budget)
    return sum(map(len, asked(paths))) - before


async def test_no_read_is_repeated_before_the_first_fast_answers() -> None:
    """Many gateways that start together slow down the servers, and repeats would slow them down more."""
    assert await questions(100, [LatePath(0.9) for _ in range(3)], RepeatBudget()) == 100


@pytest.mark.slow
async def test_repeated_reads_from_a_slow_cluster_are_limited() -> None:
    paths, budget = [LatePath(0.9) for _ in range(3)], full()
    assert 300 < await questions(300, paths, budget) < 300 + MOST_REPEATS
    assert await questions(300, paths, budget) == 300


@pytest.mark.slow
@pytest.mark.parametrize("late", [2, 5, 20])
async def test_occasional_late_answers_cause_few_repeated_reads(late: int) -> None:
    paths, budget = [LatePath(0.9) for _ in range(3)], full()
    await questions(300, paths, budget)
    count = 0
    for number in range(300):
        for path in paths:
            path.delay = 0.01 if number % late else 0.9
        count += await questions(1, paths, budget)
    assert count < 300 * (1 + EARNED)


async def test_fast_answers_increase_the_budget_for_repeated_reads() -> None:
    paths, budget = [LatePath(0.9) for _ in range(3)], full()
    await questions(300, paths, budget)
    for path in paths:
        path.delay = 0.01
    assert await questions(round(2 / EARNED), paths, budget) == 2 / EARNED
    paths[0].delay = NEVER  # from now on, the first connection never answers
    assert await questions(1, paths, budget) == 3


async def test_budget_of_repeated_reads_lasts_until_a_dead_route_is_dropped() -> None:
    """In the 3 s until servers notice a dead route, a gateway sends about 100 reads and loses a third."""
    paths, budget = [LatePath(0.01) for _ in range(3)], full()
    loop = asyncio.get_running_loop()
    for number in range(120):
        paths[0].delay = 0.01 if number % 3 else NEVER
        begun = loop.time()
        await first_answer(paths, REQUEST, budget)
        assert loop.time() - begun < 0.12


async def test_a_failed_read_raises_if_the_budget_for_repeats_is_empty() -> None:
    budget = RepeatBudget()
    paths = [SlowPath("a", 0.01, failure=OutcomeUnknown("it ended with 503")), SlowPath("b", 0.01)]
    with pytest.raises(OutcomeUnknown, match="503"):
        await first_answer(paths, REQUEST, budget)
    assert asked(paths) == [[0.0], []]


async def test_reads_are_repeated_later_if_answers_were_slow() -> None:
    """Many gateways that start together slow down the servers; early repeats would slow them down more."""
    path, others, budget = LatePath(0.2), [SlowPath("b"), SlowPath("c")], full()
    for _ in range(10):
        await first_answer([path, *others], REQUEST, budget)
    assert asked(others) == [[0.1], [0.1]]  # only the first read was repeated


async def test_lost_reads_are_repeated_soon_if_answers_were_fast() -> None:
    paths, budget = [LatePath(0.3) for _ in range(3)], full()
    await questions(10, paths, budget)
    for path in paths:
        path.delay = 0.01
    await questions(100, paths, budget)
    paths[0].delay = NEVER
    loop = asyncio.get_running_loop()
    begun = loop.time()
    await first_answer(paths, REQUEST, budget)
    assert loop.time() - begun == pytest.approx(0.11)


# ---- lease buckets: their leaders change while a server is silent; with fake servers ----


SERVERS = ("n1", "n2", "n3")
PATH: Any = None
ASKS_S = 4.0  # a server without contact to the leader asks for votes after this time, at the earliest


class Servers:
    """Three fake servers and their buckets, each with a leader and a Raft term."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.leaders = dict(zip((*names.LEASES, *names.OWNERS), 2 * SERVERS, strict=True))
        self.terms = dict.fromkeys(names.LEASES, 1)
        self.silent: set[str] = set()
        self.unheard_ns = 0  # ns since a leader last received a message from a silent server; 0: never
        self.lagging: set[str] = set()
        self.stuck: set[str] = set()  # buckets that have no leader after their leader has stepped down
        self.under_way = 0
        self.now = 0.0
        self.found = LeaseTerms(lambda: self.now)
        monkeypatch.setattr(leaders, "ask", self.ask)

    async def ask(self, path: Any, subject: str, data: Mapping[str, Any] | None = None) -> dict[str, Any]:
        bucket = subject.rpartition("KV_")[2]
        leader = self.leaders[bucket]
        if not leader or leader in self.silent:
            await asyncio.sleep(1.0)
            raise OutcomeUnknown("no answer")
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

    async def pass_s(self, seconds: int) -> None:
        """Let this time pass. Once per second, change the leaders that are due."""
        for _ in range(seconds):
            clusters = await led_clusters(PATH)
            await self.found.keep_ahead(PATH, clusters)
            self.now += 1


@pytest.fixture
def servers(monkeypatch: pytest.MonkeyPatch) -> Servers:
    return Servers(monkeypatch)


@pytest.mark.parametrize("lagging", [set(), {"n3"}])
async def test_no_bucket_changes_its_leader_while_all_servers_answer(
    servers: Servers, lagging: set[str]
) -> None:
    servers.lagging = lagging  # their copies of the buckets lag behind
    await servers.pass_s(100)
    assert set(servers.terms.values()) == {1}


@pytest.mark.parametrize(("unheard_ns", "is_due"), [(1_900_000_000, False), (2_100_000_000, True), (0, True)])
async def test_a_server_counts_as_silent_after_two_seconds(
    servers: Servers, unheard_ns: int, is_due: bool
) -> None:
    servers.silent, servers.unheard_ns = {"n3"}, unheard_ns
    await servers.pass_s(1)
    assert (servers.terms[names.LEASES[0]] > 1) is is_due


async def test_buckets_change_their_leaders_before_a_silent_servers_next_election(servers: Servers) -> None:
    servers.silent = {"n3"}
    for second in range(60):
        await servers.pass_s(1)
        for bucket in names.LEASES[:2]:
            assert servers.terms[bucket] > 1 + second // 4
            assert servers.leaders[bucket] in ("n1", "n2")
    assert servers.terms[names.LEASES[2]] == 1  # its leader is silent, so it cannot step down
    assert HAND_OVER_S < ASKS_S


async def test_elected_leader_is_changed_again_while_a_server_is_silent(servers: Servers) -> None:
    servers.silent = {"n3"}
    servers.leaders[names.LEASES[2]] = "n1"
    await servers.pass_s(1)
    assert servers.terms[names.LEASES[2]] == 2
    assert servers.leaders[names.LEASES[2]] == "n2"


async def test_server_that_stays_silent_is_ignored_until_it_returns(servers: Servers) -> None:
    servers.silent = {"n3"}
    servers.leaders[names.LEASES[2]] = "n1"
    await servers.pass_s(round(SILENT_SERVER_S) + 5)
    before = dict(servers.terms)
    await servers.pass_s(20)
    assert servers.terms == before
    servers.silent = set()
    await servers.pass_s(1)
    servers.silent = {"n3"}
    await servers.pass_s(1)
    assert all(servers.terms[bucket] > before[bucket] for bucket in names.LEASES)


async def test_no_further_bucket_changes_its_leader_after_a_failed_change(servers: Servers) -> None:
    servers.silent, servers.stuck = {"n3"}, set(names.LEASES)
    servers.leaders[names.LEASES[2]] = "n1"
    await servers.pass_s(1)
    assert sorted(servers.terms.values()) == [1, 1, 2]


async def test_a_single_remaining_server_stays_the_leader_of_its_buckets(servers: Servers) -> None:
    servers.silent = {"n2", "n3"}
    await servers.pass_s(10)
    assert set(servers.terms.values()) == {1}


async def test_other_leaders_are_found_quickly_if_one_leader_is_silent(servers: Servers) -> None:
    servers.silent = {"n2"}
    begun = asyncio.get_running_loop().time()
    clusters = await led_clusters(PATH)
    assert asyncio.get_running_loop().time() - begun == pytest.approx(SOON_S)
    assert [cluster.leader for cluster in clusters.values()] == ["n1", "n3", "n1", "n3"]
    assert await bring_leaders_home(PATH, clusters) == 0


@pytest.mark.parametrize("cut_after_s", [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7])
async def test_raft_terms_rise_before_a_cut_off_server_starts_an_election(
    cut_after_s: float, servers: Servers
) -> None:
    """Leaders on other servers report the cut-off server as silent after 2 s."""
    keeping = asyncio.create_task(keep_leaders(lambda: PATH, lambda: True, asyncio.get_running_loop().time))
    await asyncio.sleep(10 + cut_after_s)
    servers.silent, servers.unheard_ns = {"n2"}, 1
    await asyncio.sleep(2.0)
    servers.unheard_ns = 2_000_000_000
    await asyncio.sleep(ASKS_S - 2.0)
    assert min(servers.terms["lease_0"], servers.terms["lease_2"]) > 1
    keeping.cancel()


async def test_bucket_leadership_returns_to_the_planned_server(servers: Servers) -> None:
    """Another server may lead a bucket, such as after a time in which a server was silent."""
    servers.leaders |= {"lease_0": "n2", "own_2": "n1"}
    servers.lagging = {"n1"}
    assert await bring_leaders_home(PATH, await led_clusters(PATH)) == 1
    servers.lagging = set()
    assert await bring_leaders_home(PATH, await led_clusters(PATH)) == 1
    assert await bring_leaders_home(PATH, await led_clusters(PATH)) == 0
    assert list(servers.leaders.values()) == list(2 * SERVERS)
