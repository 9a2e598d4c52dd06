"""Moves: who had a line before is told where it was seen, and nowhere else."""

from __future__ import annotations

from peers import require_module

require_module("nats")

from multidrop.fleet.buckets import Record  # noqa: E402
from multidrop.fleet.moves import Move, Moves, move_of  # noqa: E402
from multidrop.fleet.ownership import owner_value  # noqa: E402


def record(revision: int, gateway: str, line: str = "hall-1") -> Record:
    return Record(line, revision, owner_value(gateway, 1 if gateway else 0, 1000 * revision))


def noted(*gateways: str, is_next: bool = True) -> Moves:
    """Return what was noted of one line with these masters, one after another."""
    moves, before = Moves(), None
    for revision, gateway in enumerate(gateways, 1):
        found = record(revision, gateway)
        moves.note(before, found, is_next=is_next)
        before = found
    return moves


def told(moves: Moves) -> list[tuple[str | None, str]]:
    return [(move.before, move.after) for move in moves.newest(100)]


def test_a_line_that_nobody_had() -> None:
    assert told(noted("gw-1")) == [("", "gw-1")]


def test_a_takeover() -> None:
    assert told(noted("gw-1", "gw-2")) == [("gw-1", "gw-2"), ("", "gw-1")]


def test_a_line_that_was_given_away_and_taken_has_moved_once() -> None:
    assert told(noted("gw-1", "", "gw-2")) == [("gw-1", "gw-2"), ("", "gw-1")]


def test_a_line_that_was_given_away_and_is_nobodys() -> None:
    assert told(noted("gw-1", "")) == [("gw-1", ""), ("", "gw-1")]


def test_a_first_look_does_not_say_who_was_master_before() -> None:
    assert told(noted("gw-2", is_next=False)) == [(None, "gw-2")]


def test_what_was_seen_long_ago_does_not_say_who_was_master_before() -> None:
    moves = noted("gw-1", "")
    moves.note(record(2, ""), record(9, "gw-2"), is_next=False)
    assert told(moves)[0] == (None, "gw-2")


def test_a_move_that_another_saw_whole_is_taken_from_it() -> None:
    moves = noted("gw-2", is_next=False)
    moves.add([Move("hall-1", 1, 1000, "gw-1", "gw-2")])
    moves.add([Move("hall-1", 1, 1000, None, "gw-2")])
    assert told(moves) == [("gw-1", "gw-2")]


def test_a_line_that_one_gave_away_and_another_took_has_moved_once() -> None:
    """Each sees its own half: a drained gateway follows no line any more, and the next began late."""
    giver, taker, moves = noted("gw-1", ""), Moves(), Moves()
    taker.note(None, record(2, ""), is_next=False)
    taker.note(record(2, ""), record(3, "gw-2"), is_next=True)
    for one in (giver, taker, giver):
        moves.add(move_of(move.as_json()) for move in one.newest(100))
    assert told(moves) == [("gw-1", "gw-2"), ("", "gw-1")]


def test_a_line_that_was_seen_to_be_taken_is_not_told_to_be_nobodys_again() -> None:
    moves = noted("gw-1", "", "gw-2")
    moves.add(noted("gw-1", "").newest(100))  # the one who gave it away tells that again and again
    assert told(moves) == [("gw-1", "gw-2"), ("", "gw-1")]


def test_what_is_told_comes_back() -> None:
    [move] = noted("gw-1", is_next=False).newest(1)
    assert move_of(move.as_json()) == move


def test_a_record_that_was_removed_is_no_move() -> None:
    moves = noted("gw-1")
    moves.note(record(1, "gw-1"), Record("hall-1", 2, None), is_next=True)
    assert len(told(moves)) == 1


def test_the_newest_are_kept_of_very_many() -> None:
    moves = Moves(most=10)
    for revision in range(1000, 0, -1):  # a first look reads its buckets in no order of time
        moves.note(None, record(revision, "gw-1", f"line-{revision}"), is_next=False)
    assert [move.revision for move in moves.newest(10)] == list(range(1000, 990, -1))
    assert len(moves.newest(1000)) <= 40
