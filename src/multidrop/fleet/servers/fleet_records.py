"""Fleet records: what a gateway reads of its fleet again and again: sessions, owners of lines, the plant."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Coroutine
from contextlib import suppress
from functools import partial
from typing import Any

from multidrop.fleet.errors import FleetError
from multidrop.fleet.leases.bucket import LeaseBucket
from multidrop.fleet.leases.observer import Observer
from multidrop.fleet.leases.rules import Terms
from multidrop.fleet.lines.moves import Move, Moves
from multidrop.fleet.lines.ownership import NOBODY, LineRecords, Owner, owner_by, owner_of
from multidrop.fleet.servers import names
from multidrop.fleet.servers.buckets import Bucket, Follower, OnTake, Record
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
