"""Ownership of lines: how evenly they are assigned, and when a gateway may claim or release a line."""

from __future__ import annotations

import hashlib
import random
from collections import Counter

import pytest
from tables import table

from multidrop.fleet.lines.ownership import NEEDED, Claim, Step, claim_of, decide, owner_by, owner_value
from multidrop.fleet.lines.shares import assign
from multidrop.fleet.servers import names
from multidrop.fleet.servers.buckets import Record

LINES = [f"hall-{hall}-line-{line}" for hall in range(20) for line in range(50)]
GATEWAYS = [f"gw{at:02}" for at in range(20)]


def moved(before: dict[str, str], after: dict[str, str]) -> int:
    return sum(before[line] != after[line] for line in before)


def test_no_gateway_has_more_than_110_percent_of_the_mean() -> None:
    shares = Counter(assign(LINES, GATEWAYS).values())
    assert sum(shares.values()) == len(LINES)
    assert max(shares.values()) <= 55
    assert min(shares.values()) >= 25


def test_few_lines_move_when_a_gateway_joins_or_leaves() -> None:
    all_of_them = assign(LINES, GATEWAYS)
    without = assign(LINES, GATEWAYS[1:])
    must = sum(gateway == GATEWAYS[0] for gateway in all_of_them.values())
    assert must <= moved(all_of_them, without) <= must + len(LINES) // 20


def test_the_assignment_does_not_depend_on_the_order_of_names() -> None:
    lines, gateways = LINES[:], GATEWAYS[:]
    random.Random(1).shuffle(lines)
    random.Random(2).shuffle(gateways)
    assert assign(lines, gateways) == assign(LINES, GATEWAYS)


def weight(line: str, gateway: str, number: int) -> int:
    """Return the weight of a line and a gateway as the first version computed it, with Python's integers."""
    own, other = (
        int.from_bytes(hashlib.blake2b(name.encode(), digest_size=8).digest(), "big")
        for name in (line, gateway)
    )
    return ((own ^ other) * 0x9E3779B97F4A7C15 & 0xFFFF_FFFF_FFFF_0000) | number


@table("number", [1, 2, 3, 5, 20])
@table("lines", [1, 7, 40, 333])
def test_each_line_is_with_the_heaviest_gateway_that_has_room(lines: int, number: int) -> None:
    """Versions with other weights would assign lines differently, and so move them back and forth."""
    room = dict.fromkeys(GATEWAYS[:number], -(-lines * 110 // (100 * number)))
    wanted = {}
    for line in sorted(LINES[:lines]):
        weights = {weight(line, name, at): name for at, name in enumerate(room) if room[name]}
        wanted[line] = weights[max(weights)]
        room[wanted[line]] -= 1
    assert assign(LINES[:lines], GATEWAYS[:number]) == wanted


def test_without_gateways_no_line_is_assigned() -> None:
    assert assign(LINES, []) == {}


ME = ("a", 7)
BEFORE = ("a", 6)
LIVING = ("b", 2)
DEAD = ("c", 4)
GIVEN = ("", 0)
NEVER = None
BUCKETS = ("first", "second", "third")


def records_of(*owners: tuple[str, int] | None, alone: bool = False) -> dict[str, Record | None]:
    """Return a line's records with these owners and revisions from 11 on.

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
    "mine stays": (one_step(ME, ME, DEAD), NOTHING),
    "mine that is another's goes": (one_step(ME, ME, DEAD, wanted="b"), GOES),
    "mine goes when I drain": (one_step(ME, ME, DEAD, drains=True), GOES),
    "mine by its first record alone stays": (one_step(ME, NEVER, NEVER, alone=True), NOTHING),
    "mine by its first record alone goes": (one_step(ME, NEVER, NEVER, alone=True, wanted="b"), GOES),
    "another's stays its": (one_step(LIVING, LIVING, DEAD, wanted="b"), NOTHING),
    "a living one's is waited for": (one_step(LIVING, LIVING, DEAD), NOTHING),
    "a living one's by its first record alone": (one_step(LIVING, NEVER, NEVER, alone=True), NOTHING),
    "a dead one's is claimed": (one_step(DEAD, DEAD, GIVEN, settled=False), ALL_FREE),
    "a dead one's by its first record alone": (
        one_step(DEAD, NEVER, NEVER, alone=True),
        claims({"first": 11, "second": 0}, {"third": 0}),
    ),
    "a dead one's is not mine by the balance": (one_step(DEAD, DEAD, DEAD, wanted="b"), NOTHING),
    "my session's before is claimed": (one_step(BEFORE, BEFORE, DEAD), ALL_FREE),
    "one that was given away": (one_step(GIVEN, GIVEN, DEAD, settled=False), ALL_FREE),
    "one that was given away in two buckets": (
        one_step(LIVING, GIVEN, GIVEN),
        claims({"second": 12, "third": 13}, {}),
    ),
    "one that I have half": (one_step(LIVING, ME, DEAD), claims({"third": 13}, {})),
    "one that I have half, and another": (one_step(LIVING, ME, LIVING), NOTHING),
    "one that I have half goes": (one_step(DEAD, ME, DEAD, wanted="b"), GOES),
    "one that nobody had": (one_step(NEVER, NEVER, NEVER), claims({"first": 0}, {}, 1, NEEDED)),
    "one that nobody had, too early": (one_step(NEVER, NEVER, NEVER, settled=False), NOTHING),
    "none while I drain": (one_step(NEVER, NEVER, NEVER, drains=True), NOTHING),
}


@table("case", CASES)
def test_claims_and_releases_in_each_case(case: str) -> None:
    found, wanted = CASES[case]
    assert found == wanted


def test_a_line_is_not_claimed_before_its_first_record_was_read() -> None:
    records = records_of(DEAD, DEAD, DEAD)
    records["first"] = None
    assert claim_of(ME, records, is_over) is None
    assert claim_of(ME, {}, is_over) is None


def test_a_record_that_was_not_read_is_not_written() -> None:
    records = records_of(DEAD, DEAD, DEAD)
    records["second"] = None
    assert claim_of(ME, records, is_over) == Claim({"first": 11, "third": 13}, {}, 6)
    records["third"] = None
    assert claim_of(ME, records, is_over) is None


def test_a_bucket_that_may_have_no_leader_is_written_last() -> None:
    records = records_of(DEAD, DEAD, DEAD)
    assert claim_of(ME, records, is_over) == Claim({"first": 11, "second": 12}, {"third": 13}, 6)
    claim = claim_of(ME, records, is_over, leaderless=["first"])
    assert claim == Claim({"second": 12, "third": 13}, {"first": 11}, 6)
    records = records_of(DEAD, DEAD, LIVING)
    claim = claim_of(ME, records, is_over, leaderless=["first"])
    assert claim == Claim({"second": 12, "first": 11}, {}, 6)


def test_a_line_with_an_uncertain_release_is_claimed_at_that_revision() -> None:
    records = records_of(ME, ME, LIVING)
    assert claim_of(ME, records, is_over) is None
    assert claim_of(ME, records, is_over, ["second"]) == Claim({"second": 12}, {}, 6)
    assert claim_of(ME, records, is_over, ["first", "second"]) == Claim({"first": 11, "second": 12}, {}, 6)


def owner_by_records(*owners: tuple[str, int] | None, alone: bool = False) -> tuple[str, int] | None:
    record = owner_by(records_of(*owners, alone=alone))
    return record and (record.value["gateway"], record.value["session"])


def test_the_owner_of_a_line_needs_two_votes() -> None:
    assert owner_by_records(LIVING, DEAD, LIVING) == LIVING
    assert owner_by_records(LIVING, NEVER, NEVER, alone=True) == LIVING
    assert owner_by_records(GIVEN, ME, GIVEN) == GIVEN
    assert owner_by_records(LIVING, DEAD, ME) is None
    assert owner_by_records(LIVING, NEVER, NEVER) is None


def test_the_newer_of_two_owners_is_shown() -> None:
    """The first record has two votes for a dead session, because its bucket has no leader."""
    records = records_of(DEAD, ME, ME, alone=True)
    for bucket in ("second", "third"):
        records[bucket] = Record("x", 20, owner_value(ME, 6, 0))
    found = owner_by(records)
    assert found
    assert found.value["gateway"] == "a"


@table("name", ["", "hall.1", "hall 1", "hall*", ">", "Größe", "a/b", "x\n"])
def test_names_that_are_invalid_in_a_subject_are_rejected(name: str) -> None:
    with pytest.raises(ValueError, match="may have only letters, digits, _ and -"):
        names.checked_name("line", name)


@pytest.mark.parametrize(
    ("name", "better"),
    [("hall 1", "hall-1"), ("hall.1", "hall-1"), ("зал 1", "1"), ("", "line-1"), ("*", "line-1")],
)
def test_an_invalid_name_is_rejected_with_a_suggestion(name: str, better: str) -> None:
    with pytest.raises(ValueError, match=f": write {better}$"):
        names.checked_name("line", name)
    assert names.is_name(better)


def test_first_records_are_spread_over_all_three_buckets() -> None:
    places = [names.owner_buckets(line) for line in LINES]
    assert all(sorted(place) == sorted(names.OWNERS) for place in places)
    shares = Counter(place[0] for place in places)
    assert min(shares[bucket] for bucket in names.OWNERS) > len(LINES) / 4
