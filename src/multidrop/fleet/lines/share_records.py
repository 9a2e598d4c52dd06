"""Share records: what a gateway reads of its fleet; of the masters of lines, those of its own share alone.

A large fleet has thousands of lines. A gateway asks only about those that it should have and has not: nobody
takes the others from it while its session lasts. So at rest it asks nothing about masters at all.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterable
from contextlib import suppress

from multidrop.fleet.leases.rules import Terms
from multidrop.fleet.lines.ownership import NOBODY, owner_of
from multidrop.fleet.servers.buckets import FOLLOW_S, NONE_YET, Bucket, Follower, OnTake, Record
from multidrop.fleet.servers.connections import ServerPath
from multidrop.fleet.servers.fleet_records import FleetRecords

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
