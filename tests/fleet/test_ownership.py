"""Whose a line is: the balance, and who may claim and give away when."""

from __future__ import annotations

import random
from collections import Counter

import pytest
from peers import require_module
from tables import table

require_module("nats")

from multidrop.fleet import names  # noqa: E402
from multidrop.fleet.balance import Balance  # noqa: E402
from multidrop.fleet.buckets import Record  # noqa: E402
from multidrop.fleet.ownership import Step, decide, owner_value  # noqa: E402

LINES = [f"hall-{hall}-line-{line}" for hall in range(20) for line in range(50)]
GATEWAYS = [f"gw{at:02}" for at in range(20)]


def moved(before: dict[str, str], after: dict[str, str]) -> int:
    return sum(before[line] != after[line] for line in before)


def test_nobody_has_more_than_110_percent_of_the_mean() -> None:
    shares = Counter(Balance().assign(LINES, GATEWAYS).values())
    assert sum(shares.values()) == len(LINES)
    assert max(shares.values()) <= 55
    assert min(shares.values()) >= 25


def test_few_lines_move_when_a_gateway_leaves_or_comes() -> None:
    balance = Balance()
    all_of_them = balance.assign(LINES, GATEWAYS)
    without = balance.assign(LINES, GATEWAYS[1:])
    must = sum(gateway == GATEWAYS[0] for gateway in all_of_them.values())
    assert must <= moved(all_of_them, without) <= must + len(LINES) // 20
    assert balance.assign(LINES, GATEWAYS) == all_of_them


def test_all_gateways_find_the_same_in_any_order() -> None:
    lines, gateways = LINES[:], GATEWAYS[:]
    random.Random(1).shuffle(lines)
    random.Random(2).shuffle(gateways)
    assert Balance().assign(lines, gateways) == Balance().assign(LINES, GATEWAYS)


# Each gateway beside one of three servers, each of which leads one bucket.
BESIDE = {gateway: (names.OWNERS[at % 3],) for at, gateway in enumerate(GATEWAYS)}


def in_vain(shares: dict[str, str]) -> list[str]:
    """Return the lines whose gateway avoids their bucket."""
    return [line for line, gateway in shares.items() if names.owner_bucket(line) in BESIDE[gateway]]


@pytest.mark.slow
@table("number", [2, 3, 4, 5, 20])
@table("lines", [7, 12, 40, 1000])
def test_lines_are_where_they_are_not_avoided_and_the_bound_holds(lines: int, number: int) -> None:
    """One of two gateways alone suits some of the buckets, and may have too little room for all of those."""
    for at in range(max(1, 300 // lines)):
        names_of_them = [f"trial-{at}-line-{line}" for line in range(lines)]
        shares = Balance().assign(names_of_them, GATEWAYS[:number], BESIDE)
        assert sorted(shares) == sorted(names_of_them)
        most = -(-lines * 110 // (100 * number))
        loads = Counter(shares.values())
        assert max(loads.values()) <= most
        for bucket in {names.owner_bucket(line) for line in in_vain(shares)}:
            for gateway in GATEWAYS[:number]:
                others = {names.owner_bucket(line) for line, name in shares.items() if name == gateway}
                is_full = loads[gateway] == most and others == {bucket}
                assert is_full or bucket in BESIDE[gateway], "a line could have been moved on"


def test_few_lines_move_where_gateways_avoid_buckets_and_order_does_not_matter() -> None:
    balance = Balance()
    all_of_them = balance.assign(LINES, GATEWAYS, BESIDE)
    without = balance.assign(LINES, GATEWAYS[1:], BESIDE)
    must = sum(gateway == GATEWAYS[0] for gateway in all_of_them.values())
    assert must <= moved(all_of_them, without) <= must + len(LINES) // 20
    assert in_vain(all_of_them) == in_vain(without) == []
    assert Balance().assign(LINES[::-1], GATEWAYS[::-1], BESIDE) == all_of_them


def test_what_all_gateways_avoid_is_shared_as_if_nobody_did() -> None:
    everything = dict.fromkeys(GATEWAYS, names.OWNERS)
    assert Balance().assign(LINES, GATEWAYS, everything) == Balance().assign(LINES, GATEWAYS)


def test_no_gateway_no_share() -> None:
    assert Balance().assign(LINES, []) == {}


ME = ("a", 7)
LIVING = ("b", 2)
DEAD = ("c", 4)


def one_step(
    owner: tuple[str, int] | None, wanted: str, *, settled: bool = True, drains: bool = False
) -> Step:
    record = None if owner is None else Record("x", 9, owner_value(*owner, 0))
    return decide(
        ME,
        ["x"],
        {"x": wanted},
        lambda line: record,
        lambda name, session: (name, session) == DEAD or (name == ME[0] and session < ME[1]),
        is_settled=settled,
        is_draining=drains,
    )


NOTHING = Step({}, set())
CASES = {
    "mine stays": (one_step(ME, "a"), NOTHING),
    "mine that is another's goes": (one_step(ME, "b"), Step({}, {"x"})),
    "mine goes when I drain": (one_step(ME, "a", drains=True), Step({}, {"x"})),
    "another's stays its": (one_step(LIVING, "b"), NOTHING),
    "a living one's is waited for": (one_step(LIVING, "a"), NOTHING),
    "a dead one's is claimed": (one_step(DEAD, "a", settled=False), Step({"x": 9}, set())),
    "a dead one's is not mine by the balance": (one_step(DEAD, "b"), NOTHING),
    "my session's before is claimed": (one_step(("a", 6), "a"), Step({"x": 9}, set())),
    "one that was given away": (one_step(("", 0), "a", settled=False), Step({"x": 9}, set())),
    "one that nobody had": (one_step(None, "a"), Step({"x": 0}, set())),
    "one that nobody had, too early": (one_step(None, "a", settled=False), NOTHING),
    "none while I drain": (one_step(None, "a", drains=True), NOTHING),
}


@table("case", CASES)
def test_claims_and_releases(case: str) -> None:
    found, wanted = CASES[case]
    assert found == wanted


@table("name", ["", "hall.1", "hall 1", "hall*", ">", "Größe", "a/b", "x\n"])
def test_names_that_cannot_be_in_a_subject(name: str) -> None:
    with pytest.raises(ValueError, match="may have letters, digits, _ and - alone"):
        names.checked_name("line", name)


@pytest.mark.parametrize(
    ("name", "better"),
    [("hall 1", "hall-1"), ("hall.1", "hall-1"), ("зал 1", "1"), ("", "line-1"), ("*", "line-1")],
)
def test_a_name_that_would_do_is_said(name: str, better: str) -> None:
    with pytest.raises(ValueError, match=f": write {better}$"):
        names.checked_name("line", name)
    assert names.is_name(better)


def test_records_of_lines_are_in_all_three_buckets() -> None:
    shares = Counter(map(names.owner_bucket, LINES))
    assert set(shares) == set(names.OWNERS)
    assert min(shares.values()) > len(LINES) / 4
