"""Ownership of lines: when a gateway may claim or release a line, and which records it writes."""

from __future__ import annotations

import asyncio
from collections import Counter
from typing import Any

import pytest
from fleet_scale import groups, large_fleet, plant_of_fake_lines, until
from nats_clusters import Cluster as Servers
from tables import table

from multidrop.fleet.lines.rules import NEEDED, Claim, Step, claim_of, decide, owner_by, owner_value
from multidrop.fleet.servers import leaders, names
from multidrop.fleet.servers.buckets import Record
from multidrop.fleet.servers.leaders import SILENT_SERVER_S, Cluster, Releases, Replica

ME = ("a", 7)
BEFORE = ("a", 6)
LIVING = ("b", 2)
DEAD = ("c", 4)
GIVEN = ("", 0)
NEVER = None
BUCKETS = ("first", "second", "third")


def records_of(*owners: tuple[str, int] | None, alone: bool = False) -> dict[str, Record | None]:
    """Return a line's ownership records, which name these owners and have revisions from 11 on.

    With `alone`, the first record has two votes.
    """
    found: dict[str, Record | None] = {}
    for at, (bucket, owner) in enumerate(zip(BUCKETS, owners, strict=True)):
        value = owner and owner_value(owner, 5, 0, NEEDED if alone and not at else 1)
        found[bucket] = Record("x", 11 + at if value else 0, value)
    return found


def is_over(name: str, session: int) -> bool:
    return (name, session) in (DEAD, BEFORE)


def one_step(
    *owners: tuple[str, int] | None,
    wanted: str = "a",
    settled: bool = True,
    drains: bool = False,
    alone: bool = False,
) -> Step:
    records = records_of(*owners, alone=alone)
    return decide(
        ME,
        ["x"],
        {"x": wanted},
        lambda line: records,
        lambda line: claim_of(ME, records, is_over),
        is_settled=settled,
        is_draining=drains,
    )


def claims(first: dict[str, int], spare: dict[str, int], turn: int = 6, votes: int = 1) -> Step:
    return Step({"x": Claim(first, spare, turn, votes)}, set())


NOTHING, GOES = Step({}, set()), Step({}, {"x"})
ALL_FREE = claims({"first": 11, "second": 12}, {"third": 13})
CASES = {
    "own line is kept": (one_step(ME, ME, DEAD), NOTHING),
    "own line assigned to another is released": (one_step(ME, ME, DEAD, wanted="b"), GOES),
    "own line is released while draining": (one_step(ME, ME, DEAD, drains=True), GOES),
    "own line with a two-vote record is kept": (one_step(ME, NEVER, NEVER, alone=True), NOTHING),
    "own line with a two-vote record is released": (one_step(ME, NEVER, NEVER, alone=True, wanted="b"), GOES),
    "another gateway's line is not claimed": (one_step(LIVING, LIVING, DEAD, wanted="b"), NOTHING),
    "line of a living session is not claimed": (one_step(LIVING, LIVING, DEAD), NOTHING),
    "line of a living session with a two-vote record is not claimed": (
        one_step(LIVING, NEVER, NEVER, alone=True),
        NOTHING,
    ),
    "line of a dead session is claimed": (one_step(DEAD, DEAD, GIVEN, settled=False), ALL_FREE),
    "line of a dead session with a two-vote record is claimed": (
        one_step(DEAD, NEVER, NEVER, alone=True),
        claims({"first": 11, "second": 0}, {"third": 0}),
    ),
    "line of a dead session is left to its gateway": (one_step(DEAD, DEAD, DEAD, wanted="b"), NOTHING),
    "line of our earlier session is claimed": (one_step(BEFORE, BEFORE, DEAD), ALL_FREE),
    "released line is claimed": (one_step(GIVEN, GIVEN, DEAD, settled=False), ALL_FREE),
    "line released in two buckets is claimed there": (
        one_step(LIVING, GIVEN, GIVEN),
        claims({"second": 12, "third": 13}, {}),
    ),
    "half-claimed line is claimed completely": (one_step(LIVING, ME, DEAD), claims({"third": 13}, {})),
    "half-claimed line with a living rival is not claimed": (one_step(LIVING, ME, LIVING), NOTHING),
    "half-claimed line assigned to another is released": (one_step(DEAD, ME, DEAD, wanted="b"), GOES),
    "new line is claimed with a two-vote record": (
        one_step(NEVER, NEVER, NEVER),
        claims({"first": 0}, {}, 1, NEEDED),
    ),
    "new line is not claimed too early": (one_step(NEVER, NEVER, NEVER, settled=False), NOTHING),
    "no line is claimed while draining": (one_step(NEVER, NEVER, NEVER, drains=True), NOTHING),
}


@table("case", CASES)
def test_claims_and_releases_follow_the_ownership_records(case: str) -> None:
    found, wanted = CASES[case]
    assert found == wanted


def test_line_is_not_claimed_before_its_first_record_was_read() -> None:
    records = records_of(DEAD, DEAD, DEAD)
    records["first"] = None
    assert claim_of(ME, records, is_over) is None
    assert claim_of(ME, {}, is_over) is None


def test_claim_writes_only_ownership_records_that_were_read() -> None:
    records = records_of(DEAD, DEAD, DEAD)
    records["second"] = None
    assert claim_of(ME, records, is_over) == Claim({"first": 11, "third": 13}, {}, 6)
    records["third"] = None
    assert claim_of(ME, records, is_over) is None


def test_claim_is_written_last_to_a_bucket_without_a_leader() -> None:
    records = records_of(DEAD, DEAD, DEAD)
    assert claim_of(ME, records, is_over) == Claim({"first": 11, "second": 12}, {"third": 13}, 6)
    claim = claim_of(ME, records, is_over, leaderless=["first"])
    assert claim == Claim({"second": 12, "third": 13}, {"first": 11}, 6)
    records = records_of(DEAD, DEAD, LIVING)
    claim = claim_of(ME, records, is_over, leaderless=["first"])
    assert claim == Claim({"second": 12, "first": 11}, {}, 6)


def test_claim_replaces_records_of_an_unanswered_release() -> None:
    records = records_of(ME, ME, LIVING)
    assert claim_of(ME, records, is_over) is None
    assert claim_of(ME, records, is_over, ["second"]) == Claim({"second": 12}, {}, 6)
    assert claim_of(ME, records, is_over, ["first", "second"]) == Claim({"first": 11, "second": 12}, {}, 6)


def owner_by_records(*owners: tuple[str, int] | None, alone: bool = False) -> tuple[str, int] | None:
    record = owner_by(records_of(*owners, alone=alone))
    return record and (record.value["gateway"], record.value["session"])


def test_owner_of_a_line_needs_two_votes() -> None:
    assert owner_by_records(LIVING, DEAD, LIVING) == LIVING
    assert owner_by_records(LIVING, NEVER, NEVER, alone=True) == LIVING
    assert owner_by_records(GIVEN, ME, GIVEN) == GIVEN
    assert owner_by_records(LIVING, DEAD, ME) is None
    assert owner_by_records(LIVING, NEVER, NEVER) is None


def test_newer_owner_is_shown_if_an_old_record_also_has_two_votes() -> None:
    """A dead session's old record with two votes is left, because its bucket had no leader for a while."""
    records = records_of(DEAD, ME, ME, alone=True)
    for bucket in ("second", "third"):
        records[bucket] = Record("x", 20, owner_value(ME, 6, 0))
    found = owner_by(records)
    assert found
    assert found.value["gateway"] == "a"


@table(
    ("name", "better"),
    [
        *[("hall 1", "hall-1"), ("hall.1", "hall-1"), ("hall*", "hall"), ("зал 1", "1"), ("Größe", "Gr-e")],
        *[("a/b", "a-b"), ("x\n", "x"), ("", "line-1"), ("*", "line-1"), (">", "line-1")],
    ],
)
def test_error_for_an_invalid_line_name_suggests_a_valid_name(name: str, better: str) -> None:
    with pytest.raises(ValueError, match=f"may have only letters, digits, _ and -: write {better}$"):
        names.checked_name("line", name)
    assert names.is_name(better)


def test_the_first_records_of_lines_are_spread_over_all_three_buckets() -> None:
    lines = [f"hall-{hall}-line-{line}" for hall in range(20) for line in range(50)]
    places = [names.owner_buckets(line) for line in lines]
    assert all(sorted(place) == sorted(names.OWNERS) for place in places)
    shares = Counter(place[0] for place in places)
    assert min(shares[bucket] for bucket in names.OWNERS) > len(lines) / 4


# ---- a line is handed over only while other gateways can claim it, now and immediately afterwards ----


# for each bucket, a line whose very first record is written into that bucket
FIRST = {names.owner_buckets(line)[0]: line for line in (f"line-{at}" for at in range(30))}
FIRST_LINES = set(FIRST.values())


class Releasing:
    """A `Releases` with fake servers: `led` buckets have a leader, `maimed` ones have a silent server."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.led = set(names.OWNERS)
        self.maimed: set[str] = set()
        self.asked: list[str] = []
        self.changes = 0
        self.now_s = 0.0
        nowhere: Any = None
        self.releases = Releases(lambda: nowhere, self.note, lambda: self.now_s)
        monkeypatch.setattr(leaders, "known_cluster", self.known_cluster)

    def note(self) -> None:
        self.changes += 1

    async def known_cluster(self, path: Any, bucket: str) -> Cluster:
        self.asked.append(bucket)
        silent = Replica("n3", is_current=bucket not in self.maimed, is_offline=False, active_ns=0)
        return Cluster("n1" if bucket in self.led else "", (silent,))

    def look(self) -> None:
        asyncio.run(self.releases.look())


def test_lines_are_handed_over_only_while_two_nats_buckets_have_leaders(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    trial = Releasing(monkeypatch)
    trial.led = {"own_1"}
    assert trial.releases.due(FIRST_LINES) == set()
    trial.look()
    assert trial.changes == 1
    assert trial.releases.due(FIRST_LINES) == set()
    trial.led.add("own_2")
    trial.look()
    assert trial.changes == 2
    assert trial.releases.due(FIRST_LINES) == {FIRST["own_1"], FIRST["own_2"]}


def test_servers_are_checked_only_while_lines_wait_to_be_handed_over(monkeypatch: pytest.MonkeyPatch) -> None:
    trial = Releasing(monkeypatch)
    trial.look()
    assert trial.asked == []
    trial.releases.due(FIRST_LINES)
    trial.look()
    assert trial.asked == [*names.OWNERS]
    assert trial.releases.due(set()) == set()
    trial.look()
    trial.led.clear()
    assert trial.releases.due(FIRST_LINES) == set()


def test_no_line_is_handed_over_while_servers_of_two_buckets_are_silent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    trial = Releasing(monkeypatch)
    trial.maimed = {"own_0", "own_1"}
    trial.releases.due(FIRST_LINES)
    trial.look()
    assert trial.releases.due(FIRST_LINES) == set()
    trial.maimed.remove("own_0")
    trial.look()
    assert trial.changes == 2
    assert trial.releases.due(FIRST_LINES) == FIRST_LINES - {FIRST["own_1"]}


def test_lines_are_handed_over_after_a_server_was_silent_for_60_s(monkeypatch: pytest.MonkeyPatch) -> None:
    trial = Releasing(monkeypatch)
    trial.maimed = {"own_0", "own_1"}
    trial.releases.due(FIRST_LINES)
    trial.look()
    trial.now_s = SILENT_SERVER_S - 1
    trial.look()
    assert trial.releases.due(FIRST_LINES) == set()
    trial.now_s = SILENT_SERVER_S
    trial.look()
    assert trial.releases.due(FIRST_LINES) == FIRST_LINES
    trial.maimed.clear()  # the server has answered and is silent again, so the 60 s restart
    trial.look()
    trial.maimed = {"own_0", "own_1"}
    trial.look()
    assert trial.releases.due(FIRST_LINES) == set()


def test_draining_gateway_does_not_wait_for_silent_servers(monkeypatch: pytest.MonkeyPatch) -> None:
    trial = Releasing(monkeypatch)
    trial.maimed = set(names.OWNERS)
    trial.led.remove("own_2")
    trial.releases.due(FIRST_LINES, 0)
    trial.look()
    assert trial.releases.due(FIRST_LINES, 0) == FIRST_LINES - {FIRST["own_2"]}
    assert trial.releases.due(FIRST_LINES) == set()
    trial.led.remove("own_1")
    trial.look()
    assert trial.releases.due(FIRST_LINES, 0) == set()


# ---- the state machines of 20 gateways with a thousand lines, in four processes ----


@pytest.mark.slow
@pytest.mark.long
def test_each_of_1000_lines_has_one_gateway_after_5_gateways_restart(nats: Servers) -> None:
    with large_fleet(nats, plant_of_fake_lines(1000)) as fleet:
        fleet.settled(fleet.start(*groups(20, 4)))
        until(lambda: 30 <= fleet.loads()[0] <= fleet.loads()[-1] <= 55, "each has its share")
        dead = fleet.processes[1]
        fleet.kill(dead)
        fleet.check()
        fleet.start(dead.gateways)
        until(lambda: fleet.loads()[0] >= 30, "those that come back have their share")
        fleet.check()
