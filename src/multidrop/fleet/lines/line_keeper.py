"""LineKeeper: claims, polls, closes and releases a gateway's lines, with one task at a time for each line.

A gateway polls a line only while the line's ownership records name the gateway's present session and its
lease is valid. Half a second before the lease expires, it closes all lines. Right before it sends a line's
release, it stops treating the line as its own, because the release may be stored at any later time, even
without an answer. The line is its own again once newer records name this session.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Coroutine, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import islice
from typing import Any, NamedTuple, Protocol

from multidrop.fleet.errors import FleetError
from multidrop.fleet.lines.lease import Lease
from multidrop.fleet.lines.records import ShareRecords
from multidrop.fleet.lines.rules import (
    NEEDED,
    NOBODY,
    SECOND,
    Claim,
    Owner,
    claim_of,
    owner_of,
    owner_value,
    turn_of,
)
from multidrop.fleet.lines.shares import UnopenedLines
from multidrop.fleet.servers import names
from multidrop.fleet.servers.buckets import Record, WriteAnswers
from multidrop.supervisor import end_tasks

_log = logging.getLogger("multidrop.fleet")

REPORTED_NS = 2_000_000_000  # report a lost port immediately if the newest reply is older than this
# Lines are closed this many seconds before the lease expires.
SILENT_S = 0.5
TAKE_AGAIN_S = 2.0  # pause between attempts to open a line
# limit of ownership records written together: larger batches would delay renewals of the lease
WRITTEN_AT_ONCE = 64
LINES_AT_ONCE = 32  # limit of lines that are opened or closed concurrently
WRITERS = 2  # limit of concurrent batches of writes in each bucket
# A gateway renews its lease in three buckets. If the newest renewal in one bucket is this much older than
# those in the other two, the bucket's server may have failed. The time is two renewal periods.
LAG_NS = SECOND
# To claim a line, a gateway writes two of the line's three ownership records. If the servers have not
# confirmed both after this time, it also writes the third one.
SPARE_S = 0.15


class Lines(Protocol):
    """The lines that this gateway polls."""

    async def take(self, line: str, description: Any) -> None:
        """Open the line and poll it.

        If this raises, it must leave the line closed; LineKeeper calls it again later.
        """

    async def let_go(self, line: str) -> None:
        """Stop polling the line and close it. After this call, no request is sent on it."""

    def port_loss(self, line: str) -> PortLoss | None:
        """Return how the port of a polled line was lost; None if it is open."""


class PortLoss(NamedTuple):
    """How a polled line lost its port: the reason, and the age of the newest reply (ns).

    `why` is None until the first attempt to reopen the port has failed. `silent_ns` is None if no drive ever
    replied.
    """

    why: str | None
    silent_ns: int | None


class TakenLine(NamedTuple):
    """A polled line: revision of its stored description, and start of the polling (CLOCK_BOOTTIME, ns)."""

    revision: int
    since: int


class LineKeeper:
    """The lines that one gateway polls, and the task in progress on each.

    `on_change` is called when the gateway's state machine (Member) should take its next step.
    """

    def __init__(
        self, lines: Lines, lease: Lease, records: ShareRecords, on_change: Callable[[], object]
    ) -> None:
        self.lines = lines
        self.polled: dict[str, TakenLine] = {}
        self.troubles: dict[str, str] = {}  # reasons why lines could not be opened, by line
        self.lost: dict[str, str] = {}  # reasons why ports were lost or cannot be opened, by line
        self.unopened = UnopenedLines(lambda: lease.clock())
        self.releasing: set[str] = set()  # this gateway's lines that it must release to other gateways
        self.may_claim = True  # False while a gateway of an incompatible version is alive
        self._lease = lease
        self._records = records
        self._owners = OwnerRecords(lease, records, lambda: self.may_poll, self._take_new)
        self._on_change = on_change
        self._is_leaving = False
        # task in progress on a line: to open, close or claim it
        self._at_work: dict[str, asyncio.Task[None]] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._again_at: dict[str, float] = {}
        self._failure: BaseException | None = None
        self._has_failed = asyncio.Event()
        self._openings = asyncio.Semaphore(LINES_AT_ONCE)

    @property
    def may_poll(self) -> bool:
        """Return True if the lease leaves enough time to close all lines before it expires."""
        return bool(self._lease.session) and self._lease.left_s > SILENT_S and not self._is_leaving

    @property
    def is_silent(self) -> bool:
        """True if no line is open and no task on a line is in progress."""
        return not self.polled and not self._at_work

    @property
    def moves(self) -> int:
        """The number of claims and releases of lines by this gateway."""
        return self._owners.moves

    def is_mine(self, line: str) -> bool:
        return self._owners.is_mine(line)

    def claim_of(self, line: str) -> Claim | None:
        """Return the records that must be written to claim the line; None if it cannot be claimed now."""
        return None if line in self._at_work else self._owners.claim_of(line)

    def may_stop(self, line: str) -> bool:
        """Return True if this gateway is the line's master now."""
        return self._lease.is_valid and self.is_mine(line) and line in self.polled

    def may_command(self, line: str) -> bool:
        """Return True if this gateway is the line's master, and has been so for the guard time."""
        if not self.may_stop(line):
            return False
        return self._lease.clock() - self.polled[line].since >= self._lease.terms.guard

    async def fail(self) -> None:
        """Wait until an attempt to close a line fails; then raise its error, which ends the process."""
        await self._has_failed.wait()
        assert self._failure is not None
        raise self._failure

    # ---- all lines ----

    def claim(self, claims: Mapping[str, Claim]) -> None:
        """Write the records that claim these lines, if the records still have the revisions in `claims`."""
        free = claims.keys() - self._at_work.keys() if self.may_claim else ()
        for lines in _some_at_once(free):
            self._start(lines, self._owners.claim({line: claims[line] for line in lines}))

    def reconcile(self) -> None:
        """Close lines that others own now, open own lines, and release closed lines that others should take.

        If a line should stay with this gateway after its release was sent, claim it again, because the
        release may have been stored.
        """
        valid = self.may_poll
        kept = {
            line
            for line in (self._owners.owned() if valid else ())
            if line not in self.releasing and self._records.is_in_plant(line)
        }
        mine = {line: self._records.plant.records[line].revision for line in kept if self.is_mine(line)}
        for line in self.troubles.keys() - mine.keys():
            self._forget_trouble(line)
        self._look_at_ports()
        now = time.monotonic()
        for line, polled in list(self.polled.items()):
            if mine.get(line) != polled.revision and line not in self._at_work:
                self._start([line], self._let_go(line))
        for line in mine.keys() - self.polled.keys() - self._at_work.keys():
            if now >= self._again_at.get(line, 0.0):
                self._start([line], self._take(line))
        if valid:
            left = (self.releasing & self._owners.owned()) - self.polled.keys() - self._at_work.keys()
            for lines in _some_at_once(left):
                self._start(lines, self._owners.give_away(lines))
            doubted = filter(self._owners.doubted, kept - mine.keys())
            self.claim({line: claim for line in doubted if (claim := self.claim_of(line))})

    def _look_at_ports(self) -> None:
        """Note which polled lines lost their ports. Other gateways can take such lines later."""
        for line in self.polled.keys() - self._at_work.keys():
            if loss := self.lines.port_loss(line):
                why = loss.why or ("it is being reopened" if (loss.silent_ns or 0) > REPORTED_NS else "")
                if why and line not in self.lost:
                    _log.warning("line %s is not polled: its port is lost: %s", line, why)
                if why:
                    self.lost[line] = why
                self.unopened.lost(line, loss.silent_ns)
            else:
                self._opened(line)

    def _opened(self, line: str) -> None:
        if self.lost.pop(line, None):
            _log.warning("line %s is polled again", line)
        self.unopened.opened(line)

    def _not_ours(self, line: str) -> None:
        self.lost.pop(line, None)
        self.unopened.gone(line)

    async def let_all_go(self) -> None:
        """Close all lines, whatever is in progress on them. If that fails for a line, raise its error."""
        self._is_leaving = True
        try:
            while not self.is_silent:
                if self._failure:
                    raise self._failure
                self.reconcile()
                await asyncio.gather(*self._at_work.values(), return_exceptions=True)
        finally:
            self._is_leaving = False

    # ---- one line ----

    def _start(self, lines: Sequence[str], work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(work)
        self._tasks.add(task)  # keeps a reference, because the event loop keeps none
        self._at_work |= dict.fromkeys(lines, task)
        task.add_done_callback(lambda done: self._done(lines, done))

    def _done(self, lines: Sequence[str], task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        for line in lines:
            if self._at_work.get(line) is task:  # otherwise the next task on this line has started already
                del self._at_work[line]
        self._on_change()
        failure = None if task.cancelled() else task.exception()
        if failure and not self._failure:
            # the line may still be open, so this process must end: `fail` raises the error
            self._failure = failure
            self._has_failed.set()

    def _take_new(self, line: str) -> None:
        if self._records.is_in_plant(line):
            self._start([line], self._take(line))

    async def _take(self, line: str) -> None:
        record = self._records.plant.records[line]
        async with self._openings:
            if not (self.may_poll and self.is_mine(line)):
                return
            try:
                await self.lines.take(line, record.value)
            except Exception as failure:  # such as an error in a user's drive class; other lines continue
                is_foreseen = isinstance(failure, (OSError, ValueError))
                why = str(failure) if is_foreseen else f"{type(failure).__name__}: {failure}"
                reported, self.troubles[line] = self.troubles.get(line), why
                if isinstance(failure, OSError):
                    self.lost[line] = str(failure)
                    self.unopened.failed(line)
                self._again_at[line] = time.monotonic() + TAKE_AGAIN_S
                asyncio.get_running_loop().call_later(1.01 * TAKE_AGAIN_S, self._on_change)
                if reported != why:
                    cause = None if is_foreseen else failure
                    _log.warning("line %s cannot be opened; retrying: %s", line, why, exc_info=cause)
            else:
                if line in self.troubles:
                    _log.warning("line %s is open now", line)
                    self._forget_trouble(line)
                self.lost.pop(line, None)
                self.unopened.opened(line)
                self.polled[line] = TakenLine(record.revision, self._lease.clock())

    def _forget_trouble(self, line: str) -> None:
        del self.troubles[line], self._again_at[line]
        self._not_ours(line)

    async def _let_go(self, line: str) -> None:
        await self.lines.let_go(line)
        self.polled.pop(line, None)
        self._not_ours(line)


def _some_at_once(lines: Iterable[str]) -> Iterator[list[str]]:
    left = iter(lines)
    while some := list(islice(left, WRITTEN_AT_ONCE)):
        yield some


class OwnerRecords:
    """Reads and writes the ownership records of this gateway's lines.

    Records are written only while `may_write()` returns True. `on_mine` is called with each line that this
    gateway now owns.
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
        # When this gateway releases a line, it replaces the line's record in each bucket. This is the
        # revision of the replaced record, by line and bucket.
        self._released: dict[tuple[str, str], int] = {}
        self._writing = {bucket: asyncio.Semaphore(WRITERS) for bucket in names.OWNERS}

    @property
    def _me(self) -> Owner:
        return self._lease.name, self._lease.session

    def is_mine(self, line: str) -> bool:
        """Return True if this session is the line's master: enough ownership records contain its name.

        A record is not counted after this gateway has sent a release that replaces it.
        """
        me, votes = self._me, 0
        for bucket, record in self._records.of(line).items():
            if owner_of(record) == me and record and self._released.get((line, bucket)) != record.revision:
                votes += record.value["votes"]
        return votes >= NEEDED

    def doubted(self, line: str) -> set[str]:
        """Return the NATS buckets that have not answered this gateway's release of the line."""
        return {
            bucket
            for bucket, record in self._records.of(line).items()
            if record and self._released.get((line, bucket)) == record.revision
        }

    def _naming_us(self, line: str) -> dict[str, Record]:
        records = self._records.of(line)
        return {
            bucket: record for bucket, record in records.items() if record and owner_of(record) == self._me
        }

    def owned(self) -> set[str]:
        return self._records.owned_by(*self._me)

    def claim_of(self, line: str) -> Claim | None:
        """Return the records that must be written to claim the line.

        Return None if the line cannot be claimed, or is this gateway's already.
        """
        is_over = self._records.observer.is_over
        return claim_of(self._me, self._records.of(line), is_over, self.doubted(line), self._leaderless())

    def _leaderless(self) -> set[str]:
        """Return the ownership buckets whose NATS server seems to have failed."""
        # the lease bucket and the ownership bucket of the same number have the same home server
        sent = [path.sent if path else 0 for path in self._lease.held]
        since = sorted(sent)[1] - LAG_NS
        return {bucket for bucket, moment in zip(names.OWNERS, sent, strict=True) if moment < since}

    async def claim(self, claims: Mapping[str, Claim]) -> None:
        """Claim lines: write the records in `Claim.first`, and if a bucket answers late, also `Claim.spare`.

        If the server of a bucket refuses a record, do not wait for other buckets: the line is claimed again
        soon, with newer records.
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
        await end_tasks(*vain)  # a cancelled write may still be stored; the next read shows whether it was
        await asyncio.gather(*late)

    async def _decide(
        self,
        lines: Iterable[str],
        writes: Iterable[asyncio.Task[set[str]]],
        refused: set[str],
        within_s: float | None = None,
    ) -> set[asyncio.Task[set[str]]]:
        """Wait until each line is claimed or its claim refused, for at most `within_s`.

        Return the unanswered writes. Add each line whose record was refused to `refused`.
        """
        late = set(writes)
        with suppress(TimeoutError):
            async with asyncio.timeout(within_s):
                while late and not all(line in refused or self.is_mine(line) for line in lines):
                    done, late = await asyncio.wait(late, return_when=asyncio.FIRST_COMPLETED)
                    refused.update(*(write.result() for write in done))
        return late

    async def give_away(self, lines: Sequence[str]) -> None:
        """Release these lines: overwrite this session's ownership records with records without a gateway.

        `is_mine` returns False for these lines before the first release is sent. So this gateway does not
        poll a released line again if an earlier write of its ownership is confirmed late.
        """
        now_ms, nobody = time.time_ns() // 1_000_000, (NOBODY, 0)
        given: list[tuple[str, Record]] = []
        for line in lines:
            ours = self._naming_us(line)
            for bucket, record in ours.items():
                self._released[line, bucket] = record.revision
                value = owner_value(nobody, turn_of(ours) + 1, now_ms, record.value["votes"])
                given.append((bucket, record._replace(value=value)))
        await asyncio.gather(*self._write(given).values())
        self.moves += sum(not self._naming_us(line) for line in lines)

    def _write(self, records: Iterable[tuple[str, Record]]) -> dict[str, asyncio.Task[set[str]]]:
        """Start a task for each bucket, which writes its records.

        Each task returns the lines whose record was refused.
        """
        by_bucket: dict[str, list[Record]] = {}
        for bucket, record in records:
            by_bucket.setdefault(bucket, []).append(record)
        return {
            bucket: asyncio.create_task(self._write_in(bucket, some)) for bucket, some in by_bucket.items()
        }

    async def _write_in(self, bucket: str, records: Sequence[Record]) -> set[str]:
        """Replace the records whose revision has not changed; return the lines whose record was refused."""
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
