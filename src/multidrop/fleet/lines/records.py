"""The records that a gateway or viewer reads about its fleet: sessions, masters of lines, the plant.

A large fleet has thousands of lines. A gateway reads the ownership records only of lines that it should poll
and does not poll yet. It need not read the records of the lines that it polls: no other gateway takes these
lines while its session lasts. So a gateway whose lines do not change reads no ownership records.
"""

from __future__ import annotations

import asyncio
import heapq
import time
from collections.abc import Awaitable, Callable, Coroutine, Iterable
from contextlib import suppress
from functools import partial
from typing import Any, NamedTuple

from multidrop.fleet.errors import FleetError
from multidrop.fleet.lines.observer import Observer
from multidrop.fleet.lines.rules import NOBODY, LineRecords, Owner, Terms, owner_by, owner_of
from multidrop.fleet.servers import names
from multidrop.fleet.servers.buckets import FOLLOW_S, NONE_YET, Bucket, Follower, LeaseBucket, OnTake, Record
from multidrop.fleet.servers.connections import ServerPath

_UNREAD: LineRecords = {}
ASKED_AT_ONCE = 500  # limit of lines in one read request; servers allow 1024
# How long to read a record again and again after a write without an answer. The servers may store the write
# late, once they have elected a new leader.
DOUBT_S = 30.0
MOST_MOVES = 100  # number of remembered changes of lines' masters
MOST_REPORTED = 20  # limit of such changes in the state that a gateway reports


class FleetRecords:
    """This process's copy of the records in all buckets.

    `on_change` is called when lines or masters have changed, when a session has ended, and when a session may
    be ended.
    """

    def __init__(
        self, me: str, path: Callable[[], ServerPath], terms: Terms, on_change: Callable[[], object]
    ) -> None:
        self.observer = Observer(me, [LeaseBucket(bucket, path, me) for bucket in names.LEASES], terms)
        self.moves = Moves()
        self.owners = {
            bucket: self._owner_follower(Bucket(bucket, path), partial(self._note_owner, bucket))
            for bucket in names.OWNERS
        }
        self._of: dict[str, dict[str, Record | None]] = {}  # ownership records, by line and bucket
        self._owned: dict[Owner, set[str]] = {}  # lines with a record that names the session, by session
        # each line's master, and how often the line has been claimed or released
        self._masters: dict[str, tuple[str, int]] = {}
        self.plant = Follower(Bucket(names.PLANT, path), self._note_plant)
        self._has_plant_changed = False
        self._lines: tuple[str, ...] = ()
        self._on_change = on_change
        self._read: set[str] = set()  # buckets that were read at least once
        self.is_complete = False  # True once each bucket was read at least once
        self._looks: dict[str, Callable[[], Awaitable[Any]]] = {
            names.PLANT: self._look_at_plant,
            **{name: partial(self.observer.look, at) for at, name in enumerate(names.LEASES)},
            **{name: follower.look for name, follower in self.owners.items()},
        }

    def _owner_follower(self, bucket: Bucket, on_take: OnTake) -> Follower:
        return Follower(bucket, on_take)

    def of(self, line: str) -> LineRecords:
        """Return a line's ownership records, by bucket; an empty mapping if none was read."""
        return self._of.get(line, _UNREAD)

    def owner(self, line: str) -> Record | None:
        """Return a record that names the line's owner (may be NOBODY); None if no owner has enough votes."""
        return owner_by(self.of(line))

    def lines(self) -> tuple[str, ...]:
        """The plant's lines, sorted by name: the same tuple until lines are added or removed."""
        return self._lines

    def is_in_plant(self, line: str) -> bool:
        record = self.plant.records.get(line)
        return bool(record and record.value and "line" in record.value)

    def owned_by(self, gateway: str, session: int) -> set[str]:
        return set(self._owned.get((gateway, session), ()))

    async def look(self) -> None:
        """Read the changes in each bucket once. Raises FleetError if a read fails."""
        done = await asyncio.gather(*map(self._look, self._looks), return_exceptions=True)
        for failure in filter(None, done):
            raise failure

    def works(self) -> list[Coroutine[Any, Any, None]]:
        """Return one endless reading coroutine per bucket, so that a slow bucket delays no other."""
        rests = {name: follower.rest for name, follower in {**self.owners, names.PLANT: self.plant}.items()}
        rests |= {name: partial(self.observer.rest, at) for at, name in enumerate(names.LEASES)}
        return [self._follow(name, rests[name]) for name in self._looks]

    async def _follow(self, name: str, rest: Callable[[], Awaitable[object]]) -> None:
        while True:
            with suppress(FleetError):
                await self._look(name)
            await rest()

    async def _look(self, name: str) -> None:
        if await self._looks[name]() or name not in self._read:
            self._on_change()
        self._read.add(name)
        self.is_complete = len(self._read) == len(names.BUCKETS)

    async def _look_at_plant(self) -> bool:
        try:
            return bool(await self.plant.look())
        finally:  # records that were read before a failure are not read again, so use them now
            if self._has_plant_changed:
                self._has_plant_changed = False
                self._lines = tuple(sorted(filter(self.is_in_plant, self.plant.records)))

    def _note_plant(self, before: Record | None, record: Record) -> None:
        self._has_plant_changed = True

    def _note_owner(self, bucket: str, before: Record | None, record: Record) -> None:
        line, former, owner = record.key, owner_of(before), owner_of(record)
        records = self._of.setdefault(line, dict.fromkeys(names.owner_buckets(line)))
        records[bucket] = record
        if former != owner:
            self._owned.setdefault(owner, set()).add(line)
            if former in self._owned and former not in map(owner_of, records.values()):
                self._owned[former].discard(line)
                if not self._owned[former]:
                    # delete the empty set; otherwise such sets would accumulate over years
                    del self._owned[former]
        if record.value:
            self._note_move(line)

    def _note_move(self, line: str) -> None:
        """Remember a change of a line's master.

        The former master is unknown (None) if an earlier record of the line was not read.
        """
        record = self.owner(line)
        if not record:
            return
        (master, _), turn = owner_of(record), record.value["turn"]
        before, seen = self._masters.get(line, (NOBODY, 0))
        if turn != seen:
            self._masters[line] = master, turn
            known = before if turn == seen + 1 else None
            # the master stays the same if a gateway claims its line again after a release without an answer
            if known != master:
                self.moves.add([Move(line, turn, record.value["since"], known, master)])


class ShareFollower(Follower):
    """The ownership records, in one bucket, of the lines that this gateway should poll.

    Revision 0 means that the line never had a master. `is_mine` returns True for a record that names this
    gateway's present session. `has` returns True for a line whose master is this gateway.
    """

    def __init__(
        self, bucket: Bucket, on_take: OnTake, is_mine: Callable[[Record], bool], has: Callable[[str], bool]
    ) -> None:
        super().__init__(bucket, on_take)
        self._is_mine = is_mine
        self._has = has
        self._share: frozenset[str] = frozenset()
        # lines to read at each look; None: not determined yet
        self._asked: frozenset[str] | None = frozenset()
        # lines with an unanswered write to their record, and when that write was sent
        self._doubted: dict[str, float] = {}
        self._is_urgent = asyncio.Event()

    def want(self, lines: Iterable[str]) -> None:
        self._share = frozenset(lines)
        self._asked = None
        self._is_urgent.set()

    def doubt(self, lines: Iterable[str]) -> None:
        """Read these lines again for DOUBT_S, because the outcome of a write to their records is unknown."""
        self._doubted |= dict.fromkeys(lines, time.monotonic())
        self._is_urgent.set()

    def recompute(self) -> None:
        """Before the next read, determine again which lines must be read."""
        self._asked = None

    async def look(self) -> list[Record]:
        """Read the ownership records that are unknown or may have changed; return those that have changed."""
        self._is_urgent.clear()
        asked = self._to_ask()
        changed: list[Record] = []
        for at in range(0, len(asked), ASKED_AT_ONCE):
            some = asked[at : at + ASKED_AT_ONCE]
            found = {record.key: record for record in await self.bucket.newest(some)}
            records = (found.get(line, Record(line, NONE_YET, None)) for line in some)
            changed += [record for record in records if self.take(record)]
        return changed

    def _to_ask(self) -> list[str]:
        oldest = time.monotonic() - DOUBT_S
        self._doubted = {line: since for line, since in self._doubted.items() if since > oldest}
        if self._asked is None:
            self._asked = frozenset(line for line in self._share if self._must_read(line))
        return sorted(self._doubted.keys() | self._asked)

    def _must_read(self, line: str) -> bool:
        """Return True if the line's ownership record must be read: it is unknown, or names another gateway.

        If the record names no gateway, this gateway writes its claim without reading the record again. The
        server refuses the claim if the record has changed.
        """
        record = self.records.get(line)
        if record is None:
            return True
        return owner_of(record)[0] != NOBODY and not self._is_mine(record) and not self._has(line)

    async def rest(self) -> None:
        """Wait until the next read is due. A call of `want` or `doubt` makes it due immediately."""
        with suppress(TimeoutError):
            await asyncio.wait_for(self._is_urgent.wait(), FOLLOW_S)


class ShareRecords(FleetRecords):
    """The records that a gateway needs: all sessions, the plant, and the owners of lines it should poll."""

    def __init__(
        self,
        me: str,
        path: Callable[[], ServerPath],
        terms: Terms,
        on_change: Callable[[], object],
        is_mine: Callable[[Record], bool],
    ) -> None:
        self._is_mine = is_mine
        self._shares: dict[str, ShareFollower] = {}
        super().__init__(me, path, terms, on_change)

    def _owner_follower(self, bucket: Bucket, on_take: OnTake) -> ShareFollower:
        self._shares[bucket.name] = ShareFollower(bucket, on_take, self._is_mine, self._has)
        return self._shares[bucket.name]

    def _has(self, line: str) -> bool:
        record = self.owner(line)
        return record is not None and self._is_mine(record)

    def _note_owner(self, bucket: str, before: Record | None, record: Record) -> None:
        super()._note_owner(bucket, before, record)
        for share in self._shares.values():
            share.recompute()

    def want(self, lines: Iterable[str]) -> None:
        """Read the ownership records of exactly these lines from now on."""
        wanted = frozenset(lines)
        for share in self._shares.values():
            share.want(wanted)

    def doubt(self, bucket: str, lines: Iterable[str]) -> None:
        self._shares[bucket].doubt(lines)


class Move(NamedTuple):
    """A change of a line's master. A gateway's name is "" if there is none, None if it is unknown."""

    line: str
    turn: int  # number of this change in the line's history, the same for all gateways
    at_ms: int  # UTC by the clock of the gateway that wrote the record; only for display
    before: str | None
    after: str

    def as_json(self) -> dict[str, Any]:
        """Return this change as gateways send it and `--json` prints it."""
        line, turn, at_ms, before, after = self
        return {"line": line, "turn": turn, "at_ms": at_ms, "from": before, "to": after}


def move_of(sent: Any) -> Move:
    """Parse a change of a line's master as another gateway has sent it.

    Raises KeyError, TypeError or ValueError if it is invalid.
    """
    line, turn, at_ms, before, after = (sent[key] for key in ("line", "turn", "at_ms", "from", "to"))
    return Move(str(line), int(turn), int(at_ms), None if before is None else str(before), str(after))


class Moves:
    """The latest changes of lines' masters. A release of a line and the following claim are one change."""

    def __init__(self, most: int = MOST_MOVES) -> None:
        self._most = most
        self._moves: dict[tuple[str, int], Move] = {}

    def add(self, moves: Iterable[Move]) -> None:
        """Add changes of lines' masters. Of two reports of a change, keep the one with the former master."""
        for move in moves:
            key = (move.line, move.turn)
            known = self._moves.get(key)
            if known is None or known.before is None:
                self._moves[key] = move
        if len(self._moves) > 4 * self._most:
            kept = heapq.nlargest(2 * self._most, self._moves.values(), key=_age)
            self._moves = {(move.line, move.turn): move for move in kept}

    def newest(self, number: int) -> list[Move]:
        """Return at most this many changes of lines' masters, newest first.

        If a gateway releases a line and another one claims it, each gateway reports its own part. The two
        reports are joined into one change with the former and the new master.
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
