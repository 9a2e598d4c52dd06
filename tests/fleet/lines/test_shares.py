"""Shares: which gateway each line is assigned to, and how a gateway reports lines that it cannot open."""

from __future__ import annotations

import asyncio
import hashlib
import random
from collections import Counter
from typing import Any

from fleets import Hall, HandClock, RecordingMastership
from tables import table

from multidrop.fleet.lines.member import SETTLE_S, Member
from multidrop.fleet.lines.rules import RULES, SECOND
from multidrop.fleet.lines.shares import (
    FIRST_WAIT_NS,
    LAST_WAIT_NS,
    LOST_NS,
    MOST_BYTES,
    OPENINGS,
    QUIET_NS,
    REPLY_NS,
    TRIAL_NS,
    UnopenedLines,
    assign,
    hand_over,
)

LINES = [f"hall-{hall}-line-{line}" for hall in range(20) for line in range(50)]
GATEWAYS = [f"gw{at:02}" for at in range(20)]


def moved(before: dict[str, str], after: dict[str, str]) -> int:
    return sum(before[line] != after[line] for line in before)


def test_no_gateway_gets_more_than_110_percent_of_the_mean_line_count() -> None:
    shares = Counter(assign(LINES, GATEWAYS).values())
    assert sum(shares.values()) == len(LINES)
    assert max(shares.values()) <= 55
    assert min(shares.values()) >= 25


def test_few_lines_change_gateways_when_a_gateway_joins_or_leaves() -> None:
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
    """Compute the weight of a line and a gateway with Python's integers, as the first version did."""
    own, other = (
        int.from_bytes(hashlib.blake2b(name.encode(), digest_size=8).digest(), "big")
        for name in (line, gateway)
    )
    return ((own ^ other) * 0x9E3779B97F4A7C15 & 0xFFFF_FFFF_FFFF_0000) | number


@table("number", [1, 2, 3, 5, 20])
@table("lines", [1, 7, 40, 333])
def test_line_is_assigned_to_the_highest_weighted_gateway_with_room(lines: int, number: int) -> None:
    """All versions must use the same weights; otherwise they would move lines back and forth."""
    room = dict.fromkeys(GATEWAYS[:number], -(-lines * 110 // (100 * number)))
    wanted = {}
    for line in sorted(LINES[:lines]):
        weights = {weight(line, name, at): name for at, name in enumerate(room) if room[name]}
        wanted[line] = weights[max(weights)]
        room[wanted[line]] -= 1
    assert assign(LINES[:lines], GATEWAYS[:number]) == wanted


def test_no_line_is_assigned_if_there_is_no_gateway() -> None:
    assert assign(LINES, []) == {}


# ---- shares of lines: assigned immediately, or in a cold start once no further gateway joins ----


VALUE: dict[str, Any] = {"session": 1, "draining": False, "rules": RULES}
FEW_LINES = tuple(f"line-{at}" for at in range(40))


class Trial:
    """Gateway "a" at the start of its session, with its own clock and without a server."""

    def __init__(self) -> None:
        self.clock = HandClock()
        mastership = RecordingMastership(self.clock)
        self.member = Member("a", [], Hall().add("a", mastership), mastership)
        self.member.lease.clock = self.clock
        self.member.lease.session = 1
        self.member._settled_at = self.clock() + int(SETTLE_S * SECOND)
        self.member.records._lines = FEW_LINES

    def sees(self, *others: str) -> None:
        """Let gateway "a" note these other gateways, as it does before its session starts."""
        self.member._note_others(dict.fromkeys(others, VALUE))

    def shared_among(self, *others: str) -> set[str]:
        """Assign lines while these other gateways are present; return the gateways that have lines now."""
        asyncio.run(self.member._share_out(dict.fromkeys(others, VALUE)))
        return set(Counter(self.member.wanted.values()))

    def is_shared_with(self, *others: str) -> bool:
        return self.shared_among(*others) == {"a", *others}


def test_a_gateway_that_rejoins_a_running_fleet_gets_its_share_immediately() -> None:
    trial = Trial()
    trial.sees("b", "c")
    trial.clock.pass_s(QUIET_NS / SECOND)
    assert trial.is_shared_with("b", "c")


def test_starting_fleet_waits_until_no_more_gateways_join() -> None:
    """Otherwise the first gateway would read all records of lines, and the second one half of the records."""
    trial = Trial()
    assert trial.shared_among("b") == set()
    trial.clock.pass_s(QUIET_NS / SECOND - 0.01)
    assert trial.shared_among("b") == set()
    assert trial.shared_among("b", "c") == set()
    trial.clock.pass_s(QUIET_NS / SECOND - 0.01)
    assert trial.shared_among("b", "c") == set()
    trial.clock.pass_s(0.02)
    assert trial.is_shared_with("b", "c")


def test_lines_are_assigned_again_when_a_gateway_joins_or_leaves() -> None:
    trial = Trial()
    trial.clock.pass_s(SETTLE_S)
    assert trial.is_shared_with("b", "c")
    assert trial.is_shared_with("b")
    assert trial.is_shared_with("b", "d")


# ---- lines that a gateway cannot open: when it reports them to others, and when it tries them again ----


def failed(unopened: UnopenedLines, line: str) -> None:
    for _ in range(OPENINGS):
        unopened.failed(line)


def reported(*lines: str) -> tuple[HandClock, UnopenedLines]:
    """Return a clock, and the lines that a gateway could not open."""
    clock = HandClock()
    unopened = UnopenedLines(clock)
    for line in lines:
        failed(unopened, line)
    return clock, unopened


def test_port_is_reported_after_three_failed_attempts_to_open() -> None:
    unopened = UnopenedLines(HandClock())
    for _ in range(OPENINGS - 1):
        unopened.failed("a")
    unopened.opened("a")
    for _ in range(OPENINGS - 1):
        unopened.failed("a")
    assert unopened.named() == frozenset()
    unopened.failed("a")
    assert unopened.named() == {"a"}
    unopened.opened("a")
    assert unopened.named() == frozenset()


def test_line_is_reported_when_its_port_stays_lost_for_6_s() -> None:
    clock = HandClock()
    unopened = UnopenedLines(clock)
    unopened.lost("a")
    clock.pass_s(LOST_NS / SECOND - 1)
    unopened.lost("a")
    unopened.opened("a")
    unopened.lost("a")
    clock.pass_s(LOST_NS / SECOND - 1)
    unopened.lost("a")
    assert unopened.named() == frozenset()
    clock.pass_s(1)
    unopened.lost("a")
    assert unopened.named() == {"a"}


@table(
    ("silent_s", "named_after_s"),
    [(2.0, 4.0), (REPLY_NS / SECOND, 3.0), (60.0, 6.0), (None, 6.0)],  # None: the line never had a reply
)
def test_recent_silence_counts_toward_the_6_s_of_a_lost_port(
    silent_s: float | None, named_after_s: float
) -> None:
    """A gateway notices a cut line only after seconds, so the 6 s start at the last reply before the cut."""
    clock = HandClock()
    unopened = UnopenedLines(clock)

    def lost_after(seconds: float) -> bool:
        clock.pass_s(seconds)
        silent_ns = None if silent_s is None else round((silent_s + seconds) * SECOND)
        unopened.lost("a", silent_ns)
        return "a" in unopened.named()

    assert not lost_after(0.0)
    assert not lost_after(named_after_s - 0.1)
    assert lost_after(0.1)


def test_failed_ports_are_retried_in_turn_with_increasing_pauses() -> None:
    clock, unopened = reported(*"abc")
    wait_s = FIRST_WAIT_NS / SECOND
    for line in "abcab":
        clock.pass_s(wait_s - 1)
        assert unopened.named() == set("abc")
        clock.pass_s(1)
        assert unopened.named() == set("abc") - {line}
        failed(unopened, line)
        assert unopened.named() == set("abc")
        wait_s = min(2 * wait_s, LAST_WAIT_NS / SECOND)


def test_line_is_retried_first_if_no_gateway_can_open_its_port() -> None:
    clock, unopened = reported(*"abc")
    unopened.hopeless = frozenset("b")
    for _ in range(5):
        clock.pass_s(FIRST_WAIT_NS / SECOND)
        assert unopened.named() == {"a", "c"}  # b is tried, so it is not reported now
        failed(unopened, "b")
    unopened.hopeless = frozenset()
    clock.pass_s(FIRST_WAIT_NS / SECOND)
    assert unopened.named() == {"a", "b", "c"}


def test_all_reported_lines_are_retried_as_soon_as_one_was_opened() -> None:
    clock, unopened = reported(*"abc")
    clock.pass_s(FIRST_WAIT_NS / SECOND)
    for line, left in (("a", {"b", "c"}), ("b", {"c"}), ("c", set[str]())):
        assert unopened.named() == left
        unopened.opened(line)


def test_a_gateway_first_retries_the_lines_that_it_usually_polls() -> None:
    """A line that another gateway usually polls would be assigned to that gateway, not to this one."""
    clock, unopened = reported(*"abcd")
    unopened.home = frozenset("bd")
    clock.pass_s(FIRST_WAIT_NS / SECOND)
    assert unopened.named() == {"a", "c", "d"}
    unopened.opened("b")
    # After the success with b, none is reported: d is tried, and other gateways usually poll a and c.
    assert unopened.named() == frozenset()
    unopened.opened("d")
    assert unopened.named() == frozenset()


def test_next_line_is_retried_if_the_first_is_not_assigned_in_time() -> None:
    clock, unopened = reported("a", "b")
    clock.pass_s(FIRST_WAIT_NS / SECOND)
    assert unopened.named() == {"b"}
    clock.pass_s(max(TRIAL_NS, FIRST_WAIT_NS) / SECOND)
    assert unopened.named() == frozenset()


def test_list_of_failed_lines_is_limited_in_bytes() -> None:
    _, unopened = reported(*(f"line-{number}" for number in range(MOST_BYTES // 8)))
    assert 0 < sum(len(line) + 4 for line in unopened.named()) <= MOST_BYTES


SIXTY = [f"line-{number}" for number in range(60)]
SHARED = assign(SIXTY, ["a", "b", "c"])
OF_A = {line for line, name in SHARED.items() if name == "a"}


def test_only_lines_that_cannot_be_opened_are_reassigned() -> None:
    found = hand_over(SHARED, {"a": OF_A, "b": [], "c": []})
    assert set(found.values()) == {"b", "c"}
    assert {line for line in SIXTY if found[line] != SHARED[line]} == OF_A
    assert found == hand_over(dict(reversed(SHARED.items())), {"c": [], "b": [], "a": sorted(OF_A)})


def test_line_keeps_its_gateway_if_no_gateway_can_open_the_port() -> None:
    assert hand_over(SHARED, {"a": SIXTY, "b": SIXTY, "c": SIXTY}) == SHARED


def test_line_is_assigned_to_a_gateway_that_can_open_the_port() -> None:
    found = hand_over(SHARED, {"a": OF_A, "b": OF_A, "c": []})
    assert {found[line] for line in OF_A} == {"c"}


def test_failed_lines_are_not_assigned_to_a_gateway_without_a_report() -> None:
    """A gateway of another version reports no list, and would not take lines that others could not open."""
    assert hand_over(SHARED, {"a": OF_A}) == SHARED
    assert set(hand_over(SHARED, {"a": OF_A, "c": []}).values()) == {"b", "c"}
