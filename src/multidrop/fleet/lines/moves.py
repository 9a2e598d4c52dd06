"""Moves: the latest changes of lines' masters, derived from the lines' records. No I/O."""

from __future__ import annotations

import heapq
from collections.abc import Iterable
from typing import Any, NamedTuple

from multidrop.fleet.lines.ownership import NOBODY

MOST = 100
MOST_REPORTED = 20  # limit of the moves that a gateway reports with its state


class Move(NamedTuple):
    """A line's move from one gateway to another. A name is "" if there is none, None if it is unknown."""

    line: str
    turn: int  # number of the move: all observers of a move see the same number
    at_ms: int  # UTC by the clock of the gateway that wrote the record; only for display
    before: str | None
    after: str

    def as_json(self) -> dict[str, Any]:
        """Return this move as gateways send it and `--json` prints it."""
        return {
            "line": self.line,
            "turn": self.turn,
            "at_ms": self.at_ms,
            "from": self.before,
            "to": self.after,
        }


def move_of(sent: Any) -> Move:
    """Parse a move that another gateway sent. Raises KeyError, TypeError or ValueError for an invalid one."""
    before = sent["from"]
    return Move(
        str(sent["line"]),
        int(sent["turn"]),
        int(sent["at_ms"]),
        None if before is None else str(before),
        str(sent["to"]),
    )


class Moves:
    """The latest moves. A release of a line and the claim that follows it are one move."""

    def __init__(self, most: int = MOST) -> None:
        self._most = most
        self._moves: dict[tuple[str, int], Move] = {}

    def add(self, moves: Iterable[Move]) -> None:
        """Add moves. If a move was reported before, keep the more complete report."""
        for move in moves:
            key = (move.line, move.turn)
            known = self._moves.get(key)
            if known is None or known.before is None:
                self._moves[key] = move
        if len(self._moves) > 4 * self._most:
            kept = heapq.nlargest(2 * self._most, self._moves.values(), key=_age)
            self._moves = {(move.line, move.turn): move for move in kept}

    def newest(self, number: int) -> list[Move]:
        """Return at most this many moves of lines, newest first.

        A gateway that releases a line does not see which gateway claims it, and that gateway may not know
        the previous master. The two gateways' reports are joined into one move.
        """
        moves = dict(self._moves)
        for (line, turn), move in self._moves.items():
            given = self._moves.get((line, turn - 1))
            if given and given.after == NOBODY != move.after:
                del moves[line, turn - 1]
                moves[line, turn] = move._replace(before=given.before)
        return heapq.nlargest(number, moves.values(), key=_age)


def _age(move: Move) -> tuple[int, int]:
    return move.at_ms, move.turn
