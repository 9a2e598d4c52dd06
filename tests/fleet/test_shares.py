"""Shares of a fleet's lines: made anew at once, or when no gateway comes or goes in a cold start."""

from __future__ import annotations

import asyncio
from collections import Counter
from typing import Any

from fleets import Hall, HandClock, NotedMastership
from peers import require_module

require_module("nats")

from multidrop.fleet import names  # noqa: E402
from multidrop.fleet.lease_rules import SECOND  # noqa: E402
from multidrop.fleet.member import SETTLE_S, Member  # noqa: E402
from multidrop.fleet.own_machine import avoided_by  # noqa: E402
from multidrop.fleet.shares import QUIET_NS  # noqa: E402

LINES = tuple(f"line-{at}" for at in range(40))


class Trial:
    """Gateway a, whose session has just begun, with a clock of its own and no server."""

    def __init__(self) -> None:
        self.clock = HandClock()
        mastership = NotedMastership(self.clock)
        self.member = Member("a", [], Hall().add("a", mastership), mastership)
        self.member.lease.clock = self.clock
        self.member.lease.session = 1
        self.member._settled_at = self.clock() + int(SETTLE_S * SECOND)
        self.member.records._lines = LINES

    def shared_among(self, *others: str) -> set[str]:
        """Step beside these gateways, and return who has lines by the balance now."""
        value: dict[str, Any] = {"session": 1, "draining": False}
        asyncio.run(self.member._share_out(dict.fromkeys(others, value)))
        return set(Counter(self.member.wanted.values()))

    def is_shared_with_those_who_come(self, *others: str) -> bool:
        return self.shared_among(*others) == {"a", *others}


def test_who_comes_back_shares_with_those_who_are_there_at_once() -> None:
    assert Trial().is_shared_with_those_who_come("b", "c")


def test_gateways_of_a_cold_start_are_shared_with_once_none_has_come_for_a_while() -> None:
    trial = Trial()
    assert trial.is_shared_with_those_who_come()
    assert trial.shared_among("b") == {"a"}
    trial.clock.pass_s(QUIET_NS / SECOND - 0.01)
    assert trial.shared_among("b", "c") == {"a"}
    trial.clock.pass_s(QUIET_NS / SECOND - 0.01)
    assert trial.shared_among("b", "c") == {"a"}
    trial.clock.pass_s(0.01)
    assert trial.is_shared_with_those_who_come("b", "c")


def test_who_has_settled_shares_anew_at_once() -> None:
    trial = Trial()
    assert trial.is_shared_with_those_who_come("b", "c")
    trial.clock.pass_s(SETTLE_S)
    assert trial.is_shared_with_those_who_come("b")
    assert trial.is_shared_with_those_who_come("b", "d")


AVOIDING: dict[str, dict[str, Any]] = {
    name: {"session": 1, "draining": False, "avoids": [bucket]}
    for name, bucket in zip(("a", "b", "c"), names.OWNERS, strict=True)
}


def lines_in_avoided_buckets(trial: Trial, others: dict[str, dict[str, Any]]) -> int:
    trial.member.own_machine.avoided = (names.OWNERS[0],)
    asyncio.run(trial.member._share_out(others))
    wanted = trial.member.wanted
    return sum(names.owner_bucket(line) in AVOIDING[wanted[line]]["avoids"] for line in wanted)


def test_lines_go_where_their_record_does_not_die_with_their_master() -> None:
    others = {name: AVOIDING[name] for name in ("b", "c")}
    assert lines_in_avoided_buckets(Trial(), others) == 0


def test_where_a_gateway_does_not_say_what_it_avoids_lines_are_shared_as_it_shares_them() -> None:
    others = {"b": AVOIDING["b"], "c": {"session": 1, "draining": False}}
    trial, older = Trial(), Trial()
    assert lines_in_avoided_buckets(trial, others) > 0
    older.shared_among("b", "c")
    assert trial.member.wanted == older.member.wanted


def test_what_else_stands_in_a_record_is_not_avoided() -> None:
    told = {"avoids": ["own_1", "own_9", None, ["own_0"], {}]}
    assert avoided_by({"a": told}) == {"a": ("own_1",)}
    assert avoided_by({"a": told, "b": {"avoids": "own_0"}}) == {}
