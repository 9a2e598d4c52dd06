"""Moves: the newest changes of mastership, as the records of lines told them. Pure."""

from __future__ import annotations

import heapq
from collections.abc import Iterable
from typing import Any, NamedTuple

from multidrop.fleet.lines.ownership import NOBODY

MOST = 100
TOLD = 20  # by a gateway that is asked for its state


class Move(NamedTuple):
    """A line that went from one gateway to another; "" is nobody, None a master that was not seen."""

    line: str
    turn: int  # of the line's records: the same move has the same one, whoever saw it
    at_ms: int  # UTC, by the clock of the gateway that wrote it: for people alone
    before: str | None
    after: str

    def as_json(self) -> dict[str, Any]:
        """Return it as a gateway tells it and `--json` prints it."""
        return {
            "line": self.line,
            "turn": self.turn,
            "at_ms": self.at_ms,
            "from": self.before,
            "to": self.after,
        }


def move_of(told: Any) -> Move:
    """Return the move that another gateway told. Raises KeyError, TypeError or ValueError for none."""
    before = told["from"]
    return Move(
        str(told["line"]),
        int(told["turn"]),
        int(told["at_ms"]),
        None if before is None else str(before),
        str(told["to"]),
    )


class Moves:
    """The newest moves; a line that was given away and then taken has moved once."""

    def __init__(self, most: int = MOST) -> None:
        self._most = most
        self._moves: dict[tuple[str, int], Move] = {}

    def add(self, moves: Iterable[Move]) -> None:
        """Add moves. Where two are the same move, the one that knows more is kept."""
        for move in moves:
            key = (move.line, move.turn)
            known = self._moves.get(key)
            if known is None or known.before is None:
                self._moves[key] = move
        if len(self._moves) > 4 * self._most:
            kept = heapq.nlargest(2 * self._most, self._moves.values(), key=_age)
            self._moves = {(move.line, move.turn): move for move in kept}

    def newest(self, number: int) -> list[Move]:
        """Return so many moves at most, the newest first.

        Who gives a line away does not see who takes it, and that one may not know whose it was: one move.
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
