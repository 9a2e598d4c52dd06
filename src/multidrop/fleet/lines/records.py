"""Share records: what a gateway reads of its fleet; of the masters of lines, those of its own share alone.

A large fleet has thousands of lines. A gateway asks only about those that it should have and has not: nobody
takes the others from it while its session lasts. So at rest it asks nothing about masters at all.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Coroutine, Iterable
from contextlib import suppress
from functools import partial
from typing import Any

from multidrop.fleet.errors import FleetError
from multidrop.fleet.leases.observer import Observer
from multidrop.fleet.leases.rules import Terms
from multidrop.fleet.lines.moves import Move, Moves
from multidrop.fleet.lines.ownership import NOBODY, LineRecords, Owner, owner_by, owner_of
from multidrop.fleet.servers import names
from multidrop.fleet.servers.buckets import FOLLOW_S, NONE_YET, Bucket, Follower, LeaseBucket, OnTake, Record
from multidrop.fleet.servers.connections import ServerPath

_UNREAD: LineRecords = {}


class FleetRecords:
    """The records of all buckets, as far as they were read.

    `on_change` is called when lines or their masters have changed, or a session has come to its end, or may.
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
        self._of: dict[str, dict[str, Record | None]] = {}  # by line
        self._owned: dict[Owner, set[str]] = {}  # the lines of which one record at least names this session
        self._masters: dict[str, tuple[str, int]] = {}  # of each line, with the turn by which it has it
        self.plant = Follower(Bucket(names.PLANT, path), self._note_plant)
        self._has_plant_changed = False
        self._lines: tuple[str, ...] = ()
        self._on_change = on_change
        self._read: set[str] = set()  # buckets that were read at least once
        self.is_complete = False  # each bucket was read once
        self._looks: dict[str, Callable[[], Awaitable[Any]]] = {
            names.PLANT: self._look_at_plant,
            **{name: partial(self.observer.look, at) for at, name in enumerate(names.LEASES)},
            **{name: follower.look for name, follower in self.owners.items()},
        }

    def _owner_follower(self, bucket: Bucket, on_take: OnTake) -> Follower:
        """Return what follows a bucket of lines' masters: here all of them."""
        return Follower(bucket, on_take)

    def of(self, line: str) -> LineRecords:
        """Return the records of a line's master; none at all where none was read."""
        return self._of.get(line, _UNREAD)

    def owner(self, line: str) -> Record | None:
        """Return a record with the line's master, who may be nobody; None where nobody has enough votes."""
        return owner_by(self.of(line))

    def lines(self) -> tuple[str, ...]:
        """Return the lines of the plant, by name; the same tuple while none came or went."""
        return self._lines

    def is_in_plant(self, line: str) -> bool:
        record = self.plant.records.get(line)
        return bool(record and record.value and "line" in record.value)

    def owned_by(self, gateway: str, session: int) -> set[str]:
        """Return the lines of which one record at least names this session."""
        return set(self._owned.get((gateway, session), ()))

    async def look(self) -> None:
        """Read once what has changed in each bucket. Raises FleetError where that fails."""
        done = await asyncio.gather(*map(self._look, self._looks), return_exceptions=True)
        for failure in done:
            if failure is not None:
                raise failure

    def works(self) -> list[Coroutine[Any, Any, None]]:
        """Return a coroutine for each bucket, which reads it for ever: none waits for another."""
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
        finally:  # what was read before a failure is not read again
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
                    del self._owned[former]  # sessions come and go for years
        if record.value:
            self._note_move(line)

    def _note_move(self, line: str) -> None:
        """Note who has the line now, if that has changed, and who had it before, if no turn was missed."""
        record = self.owner(line)
        if not record:
            return
        (master, _), turn = owner_of(record), record.value["turn"]
        before, seen = self._masters.get(line, (NOBODY, 0))
        if turn != seen:
            self._masters[line] = master, turn
            known = before if turn == seen + 1 else None
            if known != master:  # else it was claimed anew, for nobody knew whether it was given away
                self.moves.add([Move(line, turn, record.value["since"], known, master)])


ASKED_AT_ONCE = 500  # lines; servers allow 1024
DOUBT_S = 30.0  # longer than the election of a bucket's leader, which may still store what it did not answer


class ShareFollower(Follower):
    """The records of a share's lines in one bucket; revision 0 stands for a line that nobody ever had.

    `is_mine` says whether a record names us and our present session, `has` whether we have a line.
    """

    def __init__(
        self, bucket: Bucket, on_take: OnTake, is_mine: Callable[[Record], bool], has: Callable[[str], bool]
    ) -> None:
        super().__init__(bucket, on_take)
        self._is_mine = is_mine
        self._has = has
        self._share: frozenset[str] = frozenset()
        self._asked: frozenset[str] | None = frozenset()  # lines of it that may change; None: not known
        self._doubted: dict[str, float] = {}  # lines whose writing failed or was not answered, since when
        self._is_urgent = asyncio.Event()

    def want(self, lines: Iterable[str]) -> None:
        """Follow these lines from now on."""
        self._share = frozenset(lines)
        self._asked = None
        self._is_urgent.set()

    def doubt(self, lines: Iterable[str]) -> None:
        """Ask what became of lines that were to be handed over: again and again, for it may take a while."""
        self._doubted |= dict.fromkeys(lines, time.monotonic())
        self._is_urgent.set()

    def look_anew(self) -> None:
        """Find anew which lines may change: a record of one of them has, in this bucket or another."""
        self._asked = None

    async def look(self) -> list[Record]:
        """Ask for what is not known of the share, or may change, and return what did."""
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
            self._asked = frozenset(line for line in self._share if self._may_change(line))
        return sorted(self._doubted.keys() | self._asked)

    def _may_change(self, line: str) -> bool:
        """Say whether a record is unknown, or another gateway's. Claiming a free one tells what it is."""
        record = self.records.get(line)
        if record is None:
            return True
        return owner_of(record)[0] != NOBODY and not self._is_mine(record) and not self._has(line)

    async def rest(self) -> None:
        """Wait until the next look."""
        with suppress(TimeoutError):
            await asyncio.wait_for(self._is_urgent.wait(), FOLLOW_S)


class ShareRecords(FleetRecords):
    """The records that a gateway needs."""

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
            share.look_anew()

    def want(self, lines: Iterable[str]) -> None:
        """Follow the masters of these lines from now on."""
        wanted = frozenset(lines)
        for share in self._shares.values():
            share.want(wanted)

    def doubt(self, bucket: str, lines: Iterable[str]) -> None:
        """Ask what became of lines of this bucket that were to be handed over."""
        self._shares[bucket].doubt(lines)
