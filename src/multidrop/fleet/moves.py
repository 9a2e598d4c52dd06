"""Moves: the newest changes of mastership, as the records of lines told them. Pure."""

from __future__ import annotations

import heapq
from collections.abc import Iterable
from typing import Any, NamedTuple

from multidrop.fleet.buckets import Record
from multidrop.fleet.ownership import NOBODY, owner_of

MOST = 100
TOLD = 20  # by a gateway that is asked for its state


class Move(NamedTuple):
    """A line that went from one gateway to another; "" is nobody, None a master that was not seen."""

    line: str
    revision: int  # of the line's record: the same move has the same one, whoever saw it
    at_ms: int  # UTC, by the clock of the gateway that wrote it: for people alone
    before: str | None
    after: str
    released: int = 0  # the revision by which the master before gave it away; 0 where none was seen

    def as_json(self) -> dict[str, Any]:
        """Return it as a gateway tells it and `--json` prints it."""
        return {
            "line": self.line,
            "revision": self.revision,
            "at_ms": self.at_ms,
            "from": self.before,
            "to": self.after,
            "released": self.released,
        }


def move_of(told: Any) -> Move:
    """Return the move that another gateway told. Raises KeyError, TypeError or ValueError for none."""
    before = told["from"]
    return Move(
        str(told["line"]),
        int(told["revision"]),
        int(told["at_ms"]),
        None if before is None else str(before),
        str(told["to"]),
        int(told.get("released", 0)),  # older versions do not tell it
    )


class Moves:
    """The newest moves; a line that was given away and then taken has moved once."""

    def __init__(self, most: int = MOST) -> None:
        self._most = most
        self._moves: dict[tuple[str, int], Move] = {}
        self._given_away: dict[str, Move] = {}  # by line: nobody has taken it yet

    def note(self, before: Record | None, record: Record, *, is_next: bool) -> None:
        """Note a line's new record; `before` says whose it was only if this one is the next."""
        if not record.value:
            return
        after, _ = owner_of(record)
        master = owner_of(before)[0] if is_next else None
        move = Move(record.key, record.revision, int(record.value.get("since", 0)), master, after)
        given = self._given_away.pop(move.line, None)
        if after == NOBODY:
            self._given_away[move.line] = move
        elif given and is_next:
            self._moves.pop((given.line, given.revision), None)
            move = move._replace(before=given.before, released=given.revision)
        self.add([move])

    def add(self, moves: Iterable[Move]) -> None:
        """Add moves that others saw. Where two are the same move, the one that knows more is kept."""
        for move in moves:
            key = (move.line, move.revision)
            known = self._moves.get(key)
            if known is None or known.before is None:
                self._moves[key] = move
        if len(self._moves) > 4 * self._most:
            self._moves = {(move.line, move.revision): move for move in self.newest(self._most)}

    def newest(self, number: int) -> list[Move]:
        """Return so many moves at most, the newest first.

        Who gives a line away does not see who takes it, and that one may not know whose it was: one move.
        """
        moves = dict(self._moves)
        for key, move in self._moves.items():
            given = moves.pop((move.line, move.released), None)
            if given and move.before is None:
                moves[key] = move._replace(before=given.before)
        return heapq.nlargest(number, moves.values(), key=lambda move: (move.at_ms, move.revision))
