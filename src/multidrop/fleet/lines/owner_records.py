"""OwnerRecords: which lines are ours, and which records to write to claim and release lines.

A line stops being ours right before its release is sent, because the release may be stored at any later time,
even without an answer. The line is ours again once newer records name us.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress

from multidrop.fleet.errors import FleetError
from multidrop.fleet.leases.lease import Lease
from multidrop.fleet.leases.rules import SECOND
from multidrop.fleet.lines.ownership import (
    NEEDED,
    NOBODY,
    Claim,
    Owner,
    claim_of,
    owner_of,
    owner_value,
    turn_of,
)
from multidrop.fleet.lines.records import ShareRecords
from multidrop.fleet.servers import names
from multidrop.fleet.servers.buckets import Record, WriteAnswers
from multidrop.supervisor import end_tasks

WRITERS = 2  # limit of concurrent batches of writes in each bucket
# Two renewal periods. If the last renewal of our lease on one path is this much older than those on the other
# paths, that path's bucket may have no leader.
LAG_NS = SECOND
SPARE_S = 0.15  # how long to wait after the first bucket's answer before the spare bucket is used


class OwnerRecords:
    """The records of lines that name our present session as the master.

    Records are written only while `may_write()` returns True. `on_mine` is called with each line that becomes
    ours.
    """

    def __init__(
        self,
        lease: Lease,
        records: ShareRecords,
        may_write: Callable[[], bool],
        on_mine: Callable[[str], object],
    ) -> None:
        self.moves = 0
        self._lease = lease
        self._records = records
        self._may_write = may_write
        self._on_mine = on_mine
        self._offered: dict[tuple[str, str], int] = {}  # revision at the latest release, by line and bucket
        self._writing = {bucket: asyncio.Semaphore(WRITERS) for bucket in names.OWNERS}

    @property
    def _me(self) -> Owner:
        return self._lease.name, self._lease.session

    def is_mine(self, line: str) -> bool:
        """Return True if records with enough votes name us, not counting records whose release was sent."""
        me, votes = self._me, 0
        for bucket, record in self._records.of(line).items():
            if owner_of(record) == me and record and self._offered.get((line, bucket)) != record.revision:
                votes += record.value["votes"]
        return votes >= NEEDED

    def doubted(self, line: str) -> set[str]:
        """Return the buckets to which this line's release was sent, with an unknown outcome."""
        return {
            bucket
            for bucket, record in self._records.of(line).items()
            if record and self._offered.get((line, bucket)) == record.revision
        }

    def _naming_us(self, line: str) -> dict[str, Record]:
        records = self._records.of(line)
        return {
            bucket: record for bucket, record in records.items() if record and owner_of(record) == self._me
        }

    def owned(self) -> set[str]:
        """Return the lines for which at least one record names our session."""
        return self._records.owned_by(*self._me)

    def claim_of(self, line: str) -> Claim | None:
        """Return the records to write to claim the line; None if it cannot be claimed, or is ours already."""
        is_over = self._records.observer.is_over
        return claim_of(self._me, self._records.of(line), is_over, self.doubted(line), self._leaderless())

    def _leaderless(self) -> set[str]:
        """Return the bucket, if any, that may have no leader: our lease on its path is not being renewed."""
        sent = [path.sent if path else 0 for path in self._lease.held]
        since = sorted(sent)[1] - LAG_NS
        return {bucket for bucket, moment in zip(names.OWNERS, sent, strict=True) if moment < since}

    async def claim(self, claims: Mapping[str, Claim]) -> None:
        """Write the first records of these claims; also write the spare records if a bucket answers late.

        A refused claim is repeated soon with newer records. So after a refusal, do not wait for further
        answers, such as those of a bucket that may have no leader.
        """
        now_ms, begun = time.time_ns() // 1_000_000, time.monotonic()
        values = {
            line: owner_value(self._me, claim.turn, now_ms, claim.votes) for line, claim in claims.items()
        }
        writes = self._write(
            (bucket, Record(line, revision, values[line]))
            for line, claim in claims.items()
            for bucket, revision in claim.first.items()
        )
        refused: set[str] = set()
        late = set(writes.values())
        vain = {writes[bucket] for bucket in self._leaderless() & writes.keys()}
        if hopeful := late - vain:
            await asyncio.wait(hopeful, return_when=asyncio.FIRST_COMPLETED)
        late = await self._decide(claims, late, refused, max(SPARE_S, time.monotonic() - begun))
        spare = self._write(
            (bucket, Record(line, revision, values[line]))
            for line in claims.keys() - refused
            if not self.is_mine(line)
            for bucket, revision in claims[line].spare.items()
        )
        late = await self._decide(claims, (late - vain).union(spare.values()), refused)
        if refused:
            late, vain = set(), late | vain
        await end_tasks(*vain)  # a cancelled request may still be stored; the next read shows whether it was
        await asyncio.gather(*late)

    async def _decide(
        self,
        lines: Iterable[str],
        writes: Iterable[asyncio.Task[set[str]]],
        refused: set[str],
        within_s: float | None = None,
    ) -> set[asyncio.Task[set[str]]]:
        """Wait until each line is ours or refused, for at most `within_s`; return the unanswered writes.

        Add the lines of refused writes to `refused`.
        """
        late = set(writes)
        with suppress(TimeoutError):
            async with asyncio.timeout(within_s):
                while late and not all(line in refused or self.is_mine(line) for line in lines):
                    done, late = await asyncio.wait(late, return_when=asyncio.FIRST_COMPLETED)
                    refused.update(*(write.result() for write in done))
        return late

    async def give_away(self, lines: Sequence[str]) -> None:
        """Release these lines: replace each record that names us by a record that names no gateway.

        `is_mine` returns False for all of them before the first write is sent, so a late answer to a claim
        cannot make a line ours.
        """
        now_ms, nobody = time.time_ns() // 1_000_000, (NOBODY, 0)
        given: list[tuple[str, Record]] = []
        for line in lines:
            ours = self._naming_us(line)
            for bucket, record in ours.items():
                self._offered[line, bucket] = record.revision
                value = owner_value(nobody, turn_of(ours) + 1, now_ms, record.value["votes"])
                given.append((bucket, record._replace(value=value)))
        await asyncio.gather(*self._write(given).values())
        self.moves += sum(not self._naming_us(line) for line in lines)

    def _write(self, records: Iterable[tuple[str, Record]]) -> dict[str, asyncio.Task[set[str]]]:
        """Start a task for each bucket that replaces the bucket's records; each returns the refused lines."""
        by_bucket: dict[str, list[Record]] = {}
        for bucket, record in records:
            by_bucket.setdefault(bucket, []).append(record)
        return {
            bucket: asyncio.create_task(self._write_in(bucket, some)) for bucket, some in by_bucket.items()
        }

    async def _write_in(self, bucket: str, records: Sequence[Record]) -> set[str]:
        """Replace the records whose revision has not changed, and return the lines of the refused records.

        Report each line that becomes ours.
        """
        follower = self._records.owners[bucket]
        async with self._writing[bucket]:
            if not self._may_write():
                return set()
            written = WriteAnswers([], set())
            try:
                with suppress(FleetError):
                    written = await follower.bucket.put_all(records)
            finally:
                stored = {record.key for record in written.stored}
                self._records.doubt(bucket, {record.key for record in records} - stored)
        for record in written.stored:
            was_mine = self.is_mine(record.key)
            follower.take(record)
            if self.is_mine(record.key) and not was_mine:
                self.moves += 1
                self._on_mine(record.key)
        return written.refused
