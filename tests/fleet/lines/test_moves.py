"""Moves of lines: a former master is reported only if its record was read."""

from __future__ import annotations

from multidrop.fleet.lines.moves import Move, Moves, move_of


def told(*moves: Move) -> list[tuple[str | None, str]]:
    """Return the moves that are shown after these reports, each as former and new master."""
    found = Moves()
    found.add(moves)
    return [(move.before, move.after) for move in found.newest(100)]


def move(turn: int, before: str | None, after: str, line: str = "hall-1") -> Move:
    return Move(line, turn, 1000 * turn, before, after)


FIRST = move(1, "", "gw-1")


def test_the_newest_move_is_listed_first() -> None:
    assert told(FIRST, move(2, "gw-1", "gw-2")) == [("gw-1", "gw-2"), ("", "gw-1")]


def test_a_line_that_was_released_and_claimed_has_moved_once() -> None:
    moves = [FIRST, move(2, "gw-1", ""), move(3, "", "gw-2")]
    assert told(*moves) == told(*reversed(moves)) == [("gw-1", "gw-2"), ("", "gw-1")]


def test_a_released_line_has_no_master() -> None:
    assert told(FIRST, move(2, "gw-1", "")) == [("gw-1", ""), ("", "gw-1")]


def test_a_more_complete_report_of_a_move_replaces_another() -> None:
    assert told(move(2, None, "gw-2"), move(2, "gw-1", "gw-2")) == [("gw-1", "gw-2")]
    assert told(move(2, "gw-1", "gw-2"), move(2, None, "gw-2")) == [("gw-1", "gw-2")]


def test_a_release_and_a_claim_by_two_gateways_are_one_move() -> None:
    """Each gateway reports half of the move: the releasing one sees no claim, the claiming one no release."""
    giver, taker = [FIRST, move(2, "gw-1", "")], [move(2, None, ""), move(3, "", "gw-2")]
    back = [move_of(one.as_json()) for one in (*giver, *taker, *giver)]
    assert told(*back) == [("gw-1", "gw-2"), ("", "gw-1")]


def test_moves_of_different_lines_are_separate() -> None:
    moves = told(move(2, "gw-1", ""), move(3, "", "gw-2", "hall-2"))
    assert moves == [("", "gw-2"), ("gw-1", "")]


def test_a_move_survives_json() -> None:
    one = move(7, None, "gw-1")
    assert move_of(one.as_json()) == one


def test_only_the_newest_moves_are_kept() -> None:
    moves = Moves(most=10)
    for turn in range(1000, 0, -1):  # the records of buckets may be read in any order of time
        moves.add([move(turn, None, "gw-1", f"line-{turn}")])
    assert [one.turn for one in moves.newest(10)] == list(range(1000, 990, -1))
    assert len(moves.newest(1000)) <= 40
