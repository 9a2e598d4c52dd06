"""Line keeper: the work on a gateway's lines, one thing at a time on each: claim, poll, let go, give away.

A line is polled only while its record names us and our present session, and while the lease is valid. Half a
second before it runs out all lines are let go.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Coroutine, Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple, Protocol

from multidrop.fleet import names
from multidrop.fleet.buckets import Record
from multidrop.fleet.errors import FleetError
from multidrop.fleet.lease import Lease
from multidrop.fleet.ownership import NOBODY, owner_of, owner_value
from multidrop.fleet.share_records import ShareRecords

_log = logging.getLogger("multidrop.fleet")

SILENT_S = 0.5  # before the lease runs out: time for closing; the timer leaves guard / 2 more
TAKE_AGAIN_S = 2.0  # after a line that could not be taken
WRITTEN_AT_ONCE = 64  # records; more would keep the renewal of the lease waiting
WRITERS = 2  # of them at a time in each bucket
LINES_AT_ONCE = 32


class Lines(Protocol):
    """The lines that this gateway polls."""

    async def take(self, line: str, description: Any) -> None:
        """Open the line and poll it. Raises OSError or ValueError where that fails; it is tried again."""

    async def let_go(self, line: str) -> None:
        """Poll the line no more, and close it: when this returns nothing of ours is sent on it."""


class TakenLine(NamedTuple):
    """A line that is polled: the revision of its description, and since when (CLOCK_BOOTTIME, ns)."""

    revision: int
    since: int


class LineKeeper:
    """The lines that one gateway polls, and what is under way on each of them.

    `on_change` is called when something is to be looked at anew.
    """

    def __init__(
        self, lines: Lines, lease: Lease, records: ShareRecords, on_change: Callable[[], object]
    ) -> None:
        self.lines = lines
        self.polled: dict[str, TakenLine] = {}
        self.troubles: dict[str, str] = {}  # lines that could not be taken, and why
        self.moves = 0
        self.releasing: set[str] = set()  # ours, and to be given away
        self._lease = lease
        self._records = records
        self._on_change = on_change
        self._is_leaving = False
        self._offered: dict[str, int] = {}  # the revisions at which lines were given away last, stored or not
        self._at_work: dict[str, asyncio.Task[None]] = {}  # by line: it is taken, let go or claimed
        self._again_at: dict[str, float] = {}
        self._failure: BaseException | None = None
        self._has_failed = asyncio.Event()
        self._writing = {bucket: asyncio.Semaphore(WRITERS) for bucket in names.OWNERS}
        self._openings = asyncio.Semaphore(LINES_AT_ONCE)

    @property
    def may_poll(self) -> bool:
        """Say whether lines may be taken and kept: the lease leaves time to close them before it ends."""
        return bool(self._lease.session) and self._lease.left_s > SILENT_S and not self._is_leaving

    @property
    def is_silent(self) -> bool:
        """Say whether no line is open, or about to be."""
        return not self.polled and not self._at_work

    def is_mine(self, line: str) -> bool:
        """Say whether the line's record names us, and the line was not given away at this very revision."""
        record = self._mine(line)
        return record is not None and self._offered.get(line) != record.revision

    def _mine(self, line: str) -> Record | None:
        """Return the line's record where it names us and our present session."""
        record = self._records.owner(line)
        return record if owner_of(record) == (self._lease.name, self._lease.session) else None

    def _owned(self) -> set[str]:
        return self._records.owned_by(self._lease.name, self._lease.session)

    def may_stop(self, line: str) -> bool:
        """Say whether this is the line's master now: a stop waits for no guard, here or in the engine."""
        return self._lease.is_valid and self.is_mine(line) and line in self.polled

    def may_command(self, line: str) -> bool:
        """Say whether this is the line's master now, and the guard of the one before is over."""
        if not self.may_stop(line):
            return False
        return self._lease.clock() - self.polled[line].since >= self._lease.terms.guard

    async def fail(self) -> None:
        """Wait for a line that cannot be let go, and raise its error: the process must end."""
        await self._has_failed.wait()
        assert self._failure is not None
        raise self._failure

    # ---- all lines ----

    def claim(self, claims: Mapping[str, int]) -> None:
        """Claim lines, each at the revision of its record that was judged."""
        free = {line: revision for line, revision in claims.items() if line not in self._at_work}
        self._hand_over(free, self._lease.name, self._lease.session)

    def reconcile(self) -> None:
        """Let go of what is not ours any more, take what is, and give away what was let go.

        Where a line is to stay after all, and nobody knows whether it was given away, it is claimed anew.
        """
        valid = self.may_poll
        kept = {
            line
            for line in (self._owned() if valid else ())
            if line not in self.releasing and self._records.is_in_plant(line)
        }
        mine = {line: self._records.plant.records[line].revision for line in kept if self.is_mine(line)}
        for line in self.troubles.keys() - mine.keys():
            self._forget_trouble(line)
        now = time.monotonic()
        for line, polled in list(self.polled.items()):
            if mine.get(line) != polled.revision and line not in self._at_work:
                self._start([line], self._let_go(line))
        for line in mine.keys() - self.polled.keys() - self._at_work.keys():
            if now >= self._again_at.get(line, 0.0):
                self._start([line], self._take(line))
        if valid:
            left = self.releasing - self.polled.keys() - self._at_work.keys()
            mine_still = {line: record for line in left if (record := self._mine(line))}
            self._hand_over({line: record.revision for line, record in mine_still.items()}, NOBODY, 0)
            self.claim({line: self._offered[line] for line in kept - mine.keys()})

    async def let_all_go(self) -> None:
        """Let go of all lines, whatever is under way. Raises the error of a line that could not be."""
        self._is_leaving = True
        try:
            while not self.is_silent:
                if self._failure:
                    raise self._failure
                self.reconcile()
                await asyncio.gather(*self._at_work.values(), return_exceptions=True)
        finally:
            self._is_leaving = False

    # ---- who is whose ----

    def _hand_over(self, revisions: Mapping[str, int], gateway: str, session: int) -> None:
        """Claim lines, or give them away, each at this revision of its record: many in one go."""
        value = owner_value(gateway, session, time.time_ns() // 1_000_000)
        for bucket in self._writing:
            records = [
                Record(line, revision, value)
                for line, revision in revisions.items()
                if names.owner_bucket(line) == bucket
            ]
            for at in range(0, len(records), WRITTEN_AT_ONCE):
                some = records[at : at + WRITTEN_AT_ONCE]
                self._start([record.key for record in some], self._write_owners(bucket, some))

    async def _write_owners(self, bucket: str, records: Sequence[Record]) -> None:
        """Replace records: the server decides, by the revision of each. Lines that are ours now are taken."""
        follower = self._records.owners[bucket]
        async with self._writing[bucket]:
            if not self.may_poll:
                return
            stored: list[Record] = []
            self._offered |= {
                record.key: record.revision for record in records if owner_of(record)[0] == NOBODY
            }
            with suppress(FleetError):
                stored = await follower.bucket.put_all(records)
        for record in stored:
            follower.take(record)
            self._offered.pop(record.key, None)
            if self.is_mine(record.key) and self._records.is_in_plant(record.key):
                self._start([record.key], self._take(record.key))
        self.moves += len(stored)
        self._records.doubt(bucket, {record.key for record in records} - {record.key for record in stored})

    # ---- one line ----

    def _start(self, lines: Sequence[str], work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(work)
        self._at_work |= dict.fromkeys(lines, task)
        task.add_done_callback(lambda done: self._done(lines, done))

    def _done(self, lines: Sequence[str], task: asyncio.Task[None]) -> None:
        for line in lines:
            if self._at_work.get(line) is task:  # else the next work on it has begun
                del self._at_work[line]
        self._on_change()
        failure = None if task.cancelled() else task.exception()
        if failure and not self._failure:
            self._failure = failure  # a line that is not closed for certain
            self._has_failed.set()

    async def _take(self, line: str) -> None:
        record = self._records.plant.records[line]
        async with self._openings:
            if not (self.may_poll and self.is_mine(line)):
                return
            try:
                await self.lines.take(line, record.value)
            except (OSError, ValueError) as failure:
                told, self.troubles[line] = self.troubles.get(line), str(failure)
                self._again_at[line] = time.monotonic() + TAKE_AGAIN_S
                asyncio.get_running_loop().call_later(1.01 * TAKE_AGAIN_S, self._on_change)
                if told != str(failure):
                    _log.warning("line %s is not taken, and tried again and again: %s", line, failure)
            else:
                if line in self.troubles:
                    _log.warning("line %s is taken now", line)
                    self._forget_trouble(line)
                self.polled[line] = TakenLine(record.revision, self._lease.clock())

    def _forget_trouble(self, line: str) -> None:
        del self.troubles[line], self._again_at[line]

    async def _let_go(self, line: str) -> None:
        await self.lines.let_go(line)
        self.polled.pop(line, None)
