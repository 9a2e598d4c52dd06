"""Lines that a gateway cannot open: when it reports them to others, and when it tries them again."""

from __future__ import annotations

import pytest
from fleets import HandClock

from multidrop.fleet.leases.rules import SECOND
from multidrop.fleet.lines.shares import assign, hand_over
from multidrop.fleet.lines.unopened_lines import (
    FIRST_WAIT_NS,
    LAST_WAIT_NS,
    LOST_NS,
    MOST_BYTES,
    OPENINGS,
    REPLY_NS,
    TRIAL_NS,
    UnopenedLines,
)


def failed(unopened: UnopenedLines, line: str) -> None:
    for _ in range(OPENINGS):
        unopened.failed(line)


def test_a_line_is_reported_after_three_failed_openings() -> None:
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


def test_a_polled_line_is_reported_when_its_port_is_lost_for_6_s() -> None:
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


@pytest.mark.parametrize(
    ("silent_s", "named_after_s"),
    [(2.0, 4.0), (REPLY_NS / SECOND, 3.0), (60.0, 6.0), (None, 6.0)],  # also an old last reply, and no reply
)
def test_a_loss_counts_from_the_last_reply(silent_s: float | None, named_after_s: float) -> None:
    """The port's loss and the failure of reopening are noticed only some seconds after the line was cut."""
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


def test_one_line_is_tried_at_a_time_with_increasing_pauses() -> None:
    clock = HandClock()
    unopened = UnopenedLines(clock)
    for line in "abc":
        failed(unopened, line)
    wait_s = FIRST_WAIT_NS / SECOND
    for line in "abcab":
        clock.pass_s(wait_s - 1)
        assert unopened.named() == set("abc")
        clock.pass_s(1)
        assert unopened.named() == set("abc") - {line}
        failed(unopened, line)
        assert unopened.named() == set("abc")
        wait_s = min(2 * wait_s, LAST_WAIT_NS / SECOND)


def test_lines_reported_by_all_gateways_are_tried_first_and_regularly() -> None:
    clock = HandClock()
    unopened = UnopenedLines(clock)
    for line in "abc":
        failed(unopened, line)
    unopened.hopeless = frozenset("b")
    for _ in range(5):
        clock.pass_s(FIRST_WAIT_NS / SECOND)
        assert unopened.named() == {"a", "c"}
        failed(unopened, "b")
    unopened.hopeless = frozenset()
    clock.pass_s(FIRST_WAIT_NS / SECOND)
    assert unopened.named() == {"a", "b", "c"}


def test_after_a_successful_trial_the_other_lines_are_tried_at_once() -> None:
    clock = HandClock()
    unopened = UnopenedLines(clock)
    for line in "abc":
        failed(unopened, line)
    clock.pass_s(FIRST_WAIT_NS / SECOND)
    for line, left in (("a", {"b", "c"}), ("b", {"c"}), ("c", set[str]())):
        assert unopened.named() == left
        unopened.opened(line)


def test_a_trial_prefers_assigned_lines_and_its_success_clears_the_rest() -> None:
    """A line that is assigned to another gateway would not come back after a trial."""
    clock = HandClock()
    unopened = UnopenedLines(clock)
    for line in "abcd":
        failed(unopened, line)
    unopened.home = frozenset("bd")
    clock.pass_s(FIRST_WAIT_NS / SECOND)
    assert unopened.named() == {"a", "c", "d"}
    unopened.opened("b")
    assert unopened.named() == frozenset()  # the trial of d starts immediately
    unopened.opened("d")
    assert unopened.named() == frozenset()


def test_a_trial_ends_after_a_minute_if_the_line_does_not_come_back() -> None:
    clock = HandClock()
    unopened = UnopenedLines(clock)
    failed(unopened, "a")
    failed(unopened, "b")
    clock.pass_s(FIRST_WAIT_NS / SECOND)
    assert unopened.named() == {"b"}
    clock.pass_s(max(TRIAL_NS, FIRST_WAIT_NS) / SECOND)
    assert unopened.named() == frozenset()


def test_only_lines_that_fit_into_a_lease_record_are_reported() -> None:
    unopened = UnopenedLines(HandClock())
    for number in range(MOST_BYTES):
        failed(unopened, f"line-{number}")
    assert 0 < sum(len(line) + 4 for line in unopened.named()) <= MOST_BYTES


# ---- which gateway gets reported lines ----

LINES = [f"line-{number}" for number in range(60)]
SHARED = assign(LINES, ["a", "b", "c"])
OF_A = {line for line, name in SHARED.items() if name == "a"}


def test_only_reported_lines_move_and_all_gateways_agree_where() -> None:
    found = hand_over(SHARED, {"a": OF_A, "b": [], "c": []})
    assert set(found.values()) == {"b", "c"}
    assert {line for line in LINES if found[line] != SHARED[line]} == OF_A
    assert found == hand_over(dict(reversed(SHARED.items())), {"c": [], "b": [], "a": sorted(OF_A)})


def test_a_line_that_no_gateway_can_open_is_not_moved() -> None:
    assert hand_over(SHARED, {"a": LINES, "b": LINES, "c": LINES}) == SHARED


def test_a_reported_line_moves_to_a_gateway_that_has_not_tried_it() -> None:
    found = hand_over(SHARED, {"a": OF_A, "b": OF_A, "c": []})
    assert {found[line] for line in OF_A} == {"c"}


def test_a_gateway_without_a_list_of_unopened_lines_gets_no_others() -> None:
    """A gateway without a list has another version, which would not take lines that are handed over."""
    assert hand_over(SHARED, {"a": OF_A}) == SHARED
    assert set(hand_over(SHARED, {"a": OF_A, "c": []}).values()) == {"b", "c"}
