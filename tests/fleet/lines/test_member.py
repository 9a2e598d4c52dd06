"""The state machines of gateways on real NATS servers, with fake lines."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from functools import partial
from itertools import count, pairwise
from typing import Any

import pytest
from controlled_loop import run_controlled
from fleets import Hall, HandClock, MemoryBucket, RecordingMastership
from nats_clusters import Cluster, close_all, opened_paths

from multidrop.fleet.errors import Conflict
from multidrop.fleet.lines import line_keeper, shares
from multidrop.fleet.lines import member as member_module
from multidrop.fleet.lines import rules as lease_rules
from multidrop.fleet.lines.lease import HeldRecord, Lease, boottime_ns
from multidrop.fleet.lines.line_keeper import PortLoss
from multidrop.fleet.lines.member import IncompatibleGateways, Member, MemberState
from multidrop.fleet.lines.observer import Observer
from multidrop.fleet.lines.rules import RULES, SECOND, USUAL, Terms
from multidrop.fleet.servers import leaders, names
from multidrop.fleet.servers.buckets import Bucket, LeaseBucket
from multidrop.fleet.servers.connections import paths_of
from multidrop.fleet.servers.leaders import Cluster as Servers
from multidrop.fleet.servers.leaders import Replica
from multidrop.fleet.servers.plant_store import store
from multidrop.fleet.servers.setup import open_all

LINES = [f"line-{at}" for at in range(30)]
PATIENCE_S = 120.0
# 60 s, because a busy machine may suspend a test for longer than the usual lease
LONG = USUAL._replace(lease=60 * SECOND)


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(member_module, "SETTLE_S", 1.0)


async def until(condition: Callable[[], bool], what: str) -> float:
    """Wait until the condition holds; return how many seconds that took."""
    begun = time.monotonic()
    while not condition():
        assert time.monotonic() - begun < PATIENCE_S, what
        await asyncio.sleep(0.01)
    return time.monotonic() - begun


async def until_leaders_are_home(cluster: Cluster) -> None:
    """Wait until each server leads one of the lease buckets."""
    begun = time.monotonic()
    wanted = [{f"KV_{bucket}"} for bucket in names.LEASES]
    while True:
        leads = [await asyncio.to_thread(node.leads) for node in cluster.nodes]
        if all(one & set().union(*wanted) in wanted for one in leads):
            return
        assert time.monotonic() - begun < PATIENCE_S, leads
        await asyncio.sleep(0.1)


class Gateways:
    """The gateways (members) of one fleet, each with its own server connections."""

    _names = count()

    def __init__(self, cluster: Cluster, terms: Terms) -> None:
        self.cluster = cluster
        self.terms = terms
        self.hall = Hall()
        self.members: dict[str, Member] = {}
        self.tasks: dict[str, asyncio.Task[None]] = {}

    async def join(self, name: str) -> Member:
        paths = paths_of(self.cluster.urls)
        await open_all(paths)
        mastership = RecordingMastership(boottime_ns)
        lines = self.hall.add(name, mastership)
        member = Member(name, paths, lines, mastership, terms=self.terms)
        self.members[name] = member
        self.tasks[name] = asyncio.create_task(member.run())
        return member

    async def die(self, name: str) -> None:
        """End the gateway as SIGKILL would: its sockets are closed without further bytes."""
        member, task = self.members.pop(name), self.tasks.pop(name)
        member._leave = _do_nothing
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        await close_all(member.paths)
        self.hall.gateways = [lines for lines in self.hall.gateways if lines.name != name]

    async def leave(self, name: str) -> None:
        member, task = self.members.pop(name), self.tasks.pop(name)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        await close_all(member.paths)

    def taken(self) -> dict[str, set[str]]:
        return {name: set(member.polled) for name, member in self.members.items()}

    def all_are_polled(self) -> bool:
        return sorted(line for lines in self.taken().values() for line in lines) == sorted(LINES)

    def are_shared(self) -> bool:
        """Return True if each gateway knows all gateways, and polls exactly the lines assigned to it."""
        return all(
            set(member.wanted.values()) == set(self.members)
            and {line for line, gateway in member.wanted.items() if gateway == member.name}
            == set(member.polled)
            for member in self.members.values()
        )


async def _do_nothing() -> None:
    pass


@asynccontextmanager
async def gateways(cluster: Cluster, *members: str, terms: Terms = USUAL) -> AsyncIterator[Gateways]:
    async with opened_paths(cluster.urls) as paths:
        bucket = Bucket(names.PLANT, lambda: paths[0])
        await store(bucket, {line: {"line": {"name": line}, "files": {}} for line in LINES})
    running = Gateways(cluster, terms)
    try:
        await asyncio.gather(*(running.join(name) for name in members))
        await until(lambda: not members or running.all_are_polled(), "cold start")
        yield running
        assert running.hall.overlaps == []
    finally:
        await asyncio.gather(*(running.leave(name) for name in list(running.members)))


@asynccontextmanager
async def other_version(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Lease]:
    """Yield the lease of a gateway with an incompatible version of the ownership rules."""
    async with opened_paths(cluster.urls) as paths:
        buckets = [
            LeaseBucket(bucket, partial(paths.__getitem__, at), "other")
            for at, bucket in enumerate(names.LEASES)
        ]
        mastership = RecordingMastership(boottime_ns)
        lease = Lease("other", buckets, mastership, terms=LONG, note=lambda: {"draining": False})
        value = lease._value
        monkeypatch.setattr(lease, "_value", lambda **ended: {**value(**ended), "rules": RULES + 1})
        try:
            yield lease
        finally:
            await lease.end()


@pytest.mark.slow
@pytest.mark.long
async def test_other_gateways_take_over_the_lines_of_a_dead_gateway(fleet: Cluster) -> None:
    async with gateways(fleet, "a", "b", "c") as running:
        await until(lambda: all(5 <= len(lines) <= 11 for lines in running.taken().values()), "shares")
        dead = running.members["b"]
        assert dead.polled
        begun, left_s = time.monotonic(), dead.lease.left_s
        await running.die("b")
        await until(running.all_are_polled, "takeover")
        assert time.monotonic() - begun > left_s
        again = await running.join("b")
        assert not again.polled
        await until(lambda: len(again.polled) >= 5 and running.all_are_polled(), "it comes back")
        # more than 2 if the machine was suspended and the second session has expired
        assert again.lease.session >= 2


class Ports:
    """The ports of a gateway's lines. All ports fail while `is_cut` is True."""

    def __init__(self, member: Member) -> None:
        self.is_cut = False
        self._take = member.keeper.lines.take
        member.keeper.lines.take = self.take
        member.keeper.lines.port_loss = self.loss

    def loss(self, line: str) -> PortLoss | None:
        return PortLoss(f"{line}: No route to host", None) if self.is_cut else None

    async def take(self, line: str, description: object) -> None:
        if self.is_cut:
            raise OSError(f"{line}: No route to host")
        await self._take(line, description)


@pytest.mark.slow
@pytest.mark.long
async def test_line_moves_to_another_gateway_if_the_port_cannot_be_opened(
    fleet: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A gateway is cut off from its lines but not from the servers, so its lease stays valid."""
    monkeypatch.setattr(shares, "LOST_NS", SECOND // 2)
    # longer than a failed attempt to open a line again, which takes up to 2 s
    for wait in ("FIRST_WAIT_NS", "LAST_WAIT_NS"):
        monkeypatch.setattr(shares, wait, 3 * SECOND)
    monkeypatch.setattr(line_keeper, "TAKE_AGAIN_S", 0.1)
    async with gateways(fleet, "a", "b", "c", terms=LONG) as running:
        await until(running.are_shared, "shares")
        ports = {name: Ports(member) for name, member in running.members.items()}
        a, b, c = (running.members[name] for name in "abc")
        ports["a"].is_cut = True
        await until(lambda: len(b.polled) + len(c.polled) == len(LINES), "others have those of a")
        assert a.lease.is_valid
        ports["b"].is_cut = True
        await until(lambda: len(c.polled) == len(LINES), "c has all")
        ports["c"].is_cut = True
        await until(lambda: len(c.keeper.lost) > 1, "nobody polls")
        ports["b"].is_cut = False
        await until(lambda: len(b.polled) == len(LINES) and not b.keeper.lost, "b has all")
        for one in ports.values():
            one.is_cut = False
        await until(running.are_shared, "all are home")
        assert not any(member.keeper.lost for member in (a, b, c))


@pytest.mark.slow
@pytest.mark.long
async def test_a_gateway_gives_up_all_lines_after_fleet_drain(fleet: Cluster) -> None:
    async with gateways(fleet, "a", "b", "c", terms=LONG) as running:
        drained = running.members["c"]
        drained.drain()
        await until(lambda: not drained.polled and running.all_are_polled(), "drain")
        await until(lambda: drained.state is MemberState.DRAINING and drained.lease.is_valid, "its lease")
        await asyncio.sleep(0.5)
        assert not drained.polled


@pytest.mark.slow
@pytest.mark.long
async def test_a_silent_server_delays_handovers_of_lines_except_after_fleet_drain(
    fleet: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    silent = Replica("n3", is_current=False, is_offline=True, active_ns=0)

    async def maimed(*_: object) -> Servers:
        return Servers("n1", (silent,))

    monkeypatch.setattr(member_module, "SILENT_SERVER_S", math.inf)
    async with gateways(fleet, "a", "b", terms=LONG) as running:
        await until(running.are_shared, "start")
        monkeypatch.setattr(leaders, "known_cluster", maimed)
        joined, drained = await running.join("c"), running.members["b"]
        await until(lambda: "c" in drained.wanted.values(), "its share")
        await asyncio.sleep(1.0)
        assert not joined.polled
        drained.drain()
        await until(lambda: not drained.polled and running.all_are_polled(), "drain")


@pytest.mark.slow
@pytest.mark.long
async def test_gateway_hands_over_all_lines_immediately_at_shutdown(fleet: Cluster) -> None:
    async with gateways(fleet, "a", "b", terms=LONG) as running:
        await running.leave("a")
        await until(running.all_are_polled, "leave")


@pytest.mark.slow
@pytest.mark.long
async def test_lines_are_added_changed_and_removed_with_the_plant(fleet: Cluster) -> None:
    async with gateways(fleet, "a", terms=LONG) as running:
        lines, member = running.hall.gateways[0], running.members["a"]
        bucket = Bucket(names.PLANT, member.best)
        records = {line: {"line": {"name": line}, "files": {}} for line in LINES}
        records["line-1"] = {"line": {"name": "line-1", "port": "another"}, "files": {}}
        del records["line-2"]
        records["line-new"] = {"line": {"name": "line-new"}, "files": {}}
        before = dict(member.polled)
        told = await store(bucket, records)
        assert told == {"new": 1, "changed": 1, "removed": 1, "kept": 28}
        await until(lambda: lines.taken == set(records), "the lines of the other plant")
        await until(lambda: member.polled["line-1"] != before["line-1"], "the changed line")
        assert all(member.polled[line] == before[line] for line in LINES if line not in ("line-1", "line-2"))
        owned = [name for one in member.records.owners.values() for name, record in one.records.items()]
        assert "line-new" in owned
        del records["line-new"]
        await store(bucket, {line: {"line": {"name": line}, "files": {}} for line in LINES})
        await until(running.all_are_polled, "the plant as before")


@pytest.mark.slow
@pytest.mark.long
async def test_no_line_gets_a_new_master_while_an_incompatible_gateway_runs(
    fleet: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The incompatible gateway is alive at the start of this gateway, or joins the fleet later."""
    async with gateways(fleet, terms=LONG) as running, other_version(fleet, monkeypatch) as other:
        await other.begin()
        member = await running.join("a")
        await until(lambda: "while it runs on other" in member.trouble, "a word about it")
        await until(lambda: member.records.is_complete, "all records")
        await asyncio.sleep(0.5)
        assert member.lease.session == 0
        await other.end()
        await until(running.all_are_polled, "start")
        await other.begin()
        await until(lambda: "while it runs on other" in member.trouble, "a word about it")
        bucket = Bucket(names.PLANT, member.best)
        more = [*LINES, "line-new"]
        await store(bucket, {line: {"line": {"name": line}, "files": {}} for line in more})
        await until(lambda: "line-new" in member.wanted, "its share")
        await asyncio.sleep(0.5)
        assert running.all_are_polled()
        await other.end()
        await until(lambda: "line-new" in member.polled, "the new line")


@pytest.mark.slow
@pytest.mark.long
async def test_no_line_changes_its_master_when_a_server_dies(fleet: Cluster) -> None:
    """Two of three lease records are renewed as before. The third waits 4 to 9 s for another leader."""
    async with gateways(fleet, "a", "b", terms=LONG) as running:
        member = running.members["a"]
        await until(running.are_shared, "shares")
        await until_leaders_are_home(fleet)
        before, moves = dict(member.polled), member.keeper.moves
        leases = [one.lease for one in running.members.values()]
        node = fleet.nodes[1]
        [dead] = [at for at, bucket in enumerate(names.LEASES) if f"KV_{bucket}" in node.leads()]
        node.kill()
        killed = boottime_ns()
        renewals: dict[tuple[Lease, int], set[int]] = {
            (lease, path): set() for lease in leases for path in range(len(names.LEASES))
        }

        def is_led_again() -> bool:
            for lease, path in renewals:
                held = lease.held[path]
                if held and held.sent > killed:
                    renewals[lease, path].add(held.sent)
            return all(renewals[lease, dead] for lease in leases)

        await until(is_led_again, "another leader")
        assert all(len(sent) > 2 for (_, path), sent in renewals.items() if path != dead)
        assert (member.polled, member.keeper.moves) == (before, moves)
        fleet.nodes[1].start()
        await asyncio.to_thread(fleet.wait)
        await until(lambda: all(path.url == path.urls[0] for path in member.paths), "home again")


@pytest.mark.slow
@pytest.mark.long
async def test_sessions_with_only_two_lease_records_are_replaced_one_after_another(
    fleet: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One more dead server would end all sessions with two lease records at once."""
    monkeypatch.setattr(member_module, "WEAK_NS", 3600 * SECOND)

    async def lose_a_path(member: Member) -> None:
        other = LeaseBucket(names.LEASES[1], member.best, "other")
        while not member.lease.is_weak:
            record = await other.get(member.name)
            with suppress(Conflict):  # raised if the record was renewed after it was read
                await other.put(member.name, {**record.value, "ended": True}, record.revision)
            await member.lease.renew_once(1)

    async with gateways(fleet, "a", "b", terms=LONG) as running:
        members = running.members
        for member in members.values():
            await lose_a_path(member)
            assert "a new lease starts soon" in member.trouble
        monkeypatch.setattr(member_module, "WEAK_NS", 0)
        began = {name: member.lease.session for name, member in members.items()}
        await until(lambda: members["a"].lease.session > began["a"], "a's new session")
        assert members["b"].lease.session == began["b"]
        await until(lambda: members["b"].lease.session > began["b"], "b's new session")
        await until(lambda: all(None not in one.lease.held for one in members.values()), "all paths")
        assert [member.trouble for member in members.values()] == ["", ""]
        await until(running.are_shared, "shares")
        assert running.hall.overlaps == []


@pytest.mark.slow
@pytest.mark.long
async def test_all_lines_are_closed_if_no_server_answers(
    fleet: Cluster, caplog: pytest.LogCaptureFixture
) -> None:
    """The kernel's timer is cancelled when the lines are closed, and never set to a time in the past."""
    async with gateways(fleet, "a", "b") as running:
        await until(running.are_shared, "shares")  # until each gateway has had a lease and a timer
        with fleet.paused():
            await until(lambda: not any(running.taken().values()), "silence")
            masterships = [lines.mastership for lines in running.hall.gateways]
            await until(lambda: [one.events[-1] for one in masterships] == ["end", "end"], "the timer")
            members = running.members.values()
            await until(lambda: {member.state for member in members} == {MemberState.NO_LEASE}, "no lease")
        await until(running.all_are_polled, "they come back")
        await until(lambda: {member.state for member in members} == {MemberState.WORKING}, "work")
        for name in ("a", "b"):
            await until(lambda name=name: f"{name}: the lease is valid again" in caplog.messages, "a word")


# ---- gateways with an incompatible ownership protocol: how they are detected, and when they are ignored ----


SENTENCE = "incompatible version of multidrop in this fleet: no line is taken while it runs on {}"


class Trial:
    """A gateway called "me" that watches other gateways. Their sessions are in memory."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.clock = HandClock()
        self.buckets: list[Any] = [MemoryBucket(f"lease_{path}") for path in range(3)]
        self.observer = Observer("me", self.buckets, USUAL, self.clock)
        self.incompatible = IncompatibleGateways("me", self.observer)
        self._monkeypatch = monkeypatch

    def begin(self, name: str, rules: int) -> Lease:
        """Start a session of a gateway with this version of the ownership rules."""
        lease = Lease(name, self.buckets, RecordingMastership(self.clock), clock=self.clock)
        with self._monkeypatch.context() as patch:
            patch.setattr(lease_rules, "RULES", rules)
            assert asyncio.run(lease.try_to_begin())
        return lease

    @property
    def trouble(self) -> str:
        """Read all lease records, and return the sentence about incompatible gateways."""
        for path in range(3):
            asyncio.run(self.observer.look(path))
        self.incompatible.look(self.observer.sessions())
        return self.incompatible.trouble


@pytest.fixture
def trial(monkeypatch: pytest.MonkeyPatch) -> Trial:
    return Trial(monkeypatch)


def test_status_names_an_incompatible_gateway_until_its_session_ends(trial: Trial) -> None:
    trial.begin("alike", RULES)
    older, newer = trial.begin("older", RULES - 1), trial.begin("newer", RULES + 1)
    assert trial.trouble == SENTENCE.format("newer, older")
    asyncio.run(newer.end())
    assert trial.trouble == SENTENCE.format("older")
    asyncio.run(older.end())
    assert trial.trouble == ""


def test_gateway_without_a_rules_version_is_incompatible(trial: Trial) -> None:
    trial.begin("first", RULES)
    for bucket in trial.buckets:
        bucket.store(
            "first", {key: one for key, one in bucket.records["first"].value.items() if key != "rules"}
        )
    assert trial.trouble == SENTENCE.format("first")


def test_killed_incompatible_gateway_is_ignored_after_lease_expiry(trial: Trial) -> None:
    trial.begin("older", RULES - 1)
    assert trial.trouble
    trial.clock.now += USUAL.lease - 1
    assert trial.trouble
    trial.clock.now += 1
    assert trial.trouble == ""


def test_gateway_does_not_report_its_own_earlier_session_as_incompatible(trial: Trial) -> None:
    trial.begin("me", RULES - 1)
    assert trial.trouble == ""


# ---- the steps of a gateway's state machine and their order, in simulated time, without a server ----


def a_member() -> Member:
    """Return a gateway that has a session but no server."""
    mastership = RecordingMastership(boottime_ns)
    lines = Hall().add("a", mastership)
    member = Member("a", paths_of(["nats://nowhere.invalid:4222"]), lines, mastership)
    member.lease.session, member.lease.held = 1, [HeldRecord(1, 0)] * 3
    return member


def steps(wake: Callable[[Member], object]) -> list[float]:
    """Return the times (s) of the state machine's steps in 0.12 s; `wake` is called at 0.06 s."""

    async def main() -> list[float]:
        loop = asyncio.get_running_loop()
        member = a_member()
        taken: list[float] = []

        async def step() -> None:
            taken.append(round(loop.time() - 1000.0, 3))

        member.step = step
        living = asyncio.create_task(member._live())
        loop.call_later(0.06, wake, member)
        await asyncio.sleep(0.12)
        living.cancel()
        return taken

    return run_controlled(main())


def test_the_state_machine_takes_a_step_every_50_ms() -> None:
    assert steps(lambda member: None) == pytest.approx([0.0, 0.05, 0.1])


@pytest.mark.parametrize("times", [1, 100])
def test_a_changed_record_causes_an_immediate_step_of_the_state_machine(times: int) -> None:
    def wake(member: Member) -> None:
        for _ in range(times):
            member.records._on_change()

    assert steps(wake) == pytest.approx([0.0, 0.05, 0.06, 0.11])


def test_state_machine_pauses_10_ms_between_steps() -> None:
    def wake(member: Member) -> None:
        member.records._on_change()
        if len(asyncio.all_tasks()) > 1:
            asyncio.get_running_loop().call_later(0.001, wake, member)

    taken = steps(wake)
    assert min(after - before for before, after in pairwise(taken)) == pytest.approx(0.01, abs=0.001)
    assert len(taken) > 6


@pytest.mark.parametrize(("left_s", "ends"), [(2.0, True), (0.9, False), (-1.0, False)])
async def test_gateway_ends_no_other_session_just_before_its_own_lease_expires(
    left_s: float, ends: bool
) -> None:
    """If its own lease expires, all servers may be failing. A session that it ended could not continue."""
    member = a_member()
    clock = HandClock()
    member.lease.clock = clock
    member.lease.until = clock.now + 2 * SECOND
    await member.step()  # at the first step, all other sessions count as just renewed
    asked: list[object] = []

    async def note(present: object) -> bool:
        asked.append(present)
        return False

    member.records.observer.end_the_dead = note
    member.lease.until = clock.now + round(left_s * SECOND)
    await member.step()
    assert bool(asked) is ends
