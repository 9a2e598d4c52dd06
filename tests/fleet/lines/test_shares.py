"""Shares of lines: assigned immediately or, in a cold start, when no further gateways join."""

from __future__ import annotations

import asyncio
from collections import Counter
from typing import Any

from fleets import Hall, HandClock, RecordingMastership

from multidrop.fleet.leases.member import SETTLE_S, Member
from multidrop.fleet.leases.rules import RULES, SECOND
from multidrop.fleet.lines.shares import QUIET_NS

VALUE: dict[str, Any] = {"session": 1, "draining": False, "rules": RULES}
LINES = tuple(f"line-{at}" for at in range(40))


class Trial:
    """Gateway a at the start of its session, with its own clock and without a server."""

    def __init__(self) -> None:
        self.clock = HandClock()
        mastership = RecordingMastership(self.clock)
        self.member = Member("a", [], Hall().add("a", mastership), mastership)
        self.member.lease.clock = self.clock
        self.member.lease.session = 1
        self.member._settled_at = self.clock() + int(SETTLE_S * SECOND)
        self.member.records._lines = LINES

    def sees(self, *others: str) -> None:
        """Note these other gateways, as gateway a does before its session starts."""
        self.member._see(dict.fromkeys(others, VALUE))

    def shared_among(self, *others: str) -> set[str]:
        """Take a step while these other gateways are present; return the gateways that have lines now."""
        asyncio.run(self.member._share_out(dict.fromkeys(others, VALUE)))
        return set(Counter(self.member.wanted.values()))

    def is_shared_with_those_who_come(self, *others: str) -> bool:
        return self.shared_among(*others) == {"a", *others}


def test_a_returning_gateway_gets_its_share_immediately() -> None:
    trial = Trial()
    trial.sees("b", "c")
    trial.clock.pass_s(QUIET_NS / SECOND)
    assert trial.is_shared_with_those_who_come("b", "c")


def test_a_cold_start_assigns_lines_once_no_gateway_joins() -> None:
    """Otherwise the first gateway would read the records of all lines, the second those of half."""
    trial = Trial()
    assert trial.shared_among("b") == set()
    trial.clock.pass_s(QUIET_NS / SECOND - 0.01)
    assert trial.shared_among("b") == set()
    assert trial.shared_among("b", "c") == set()
    trial.clock.pass_s(QUIET_NS / SECOND - 0.01)
    assert trial.shared_among("b", "c") == set()
    trial.clock.pass_s(0.02)
    assert trial.is_shared_with_those_who_come("b", "c")


def test_a_settled_gateway_reassigns_lines_immediately() -> None:
    trial = Trial()
    trial.clock.pass_s(SETTLE_S)
    assert trial.is_shared_with_those_who_come("b", "c")
    assert trial.is_shared_with_those_who_come("b")
    assert trial.is_shared_with_those_who_come("b", "d")
