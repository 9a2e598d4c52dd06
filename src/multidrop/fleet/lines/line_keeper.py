"""LineKeeper: claims, polls, closes and releases a gateway's lines, with one task at a time for each line.

A line is polled only while its records name our present session and the lease is valid. Half a second before
the lease expires, all lines are closed.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Coroutine, Iterable, Iterator, Mapping, Sequence
from itertools import islice
from typing import Any, NamedTuple, Protocol

from multidrop.fleet.leases.lease import Lease
from multidrop.fleet.lines.owner_records import OwnerRecords
from multidrop.fleet.lines.ownership import Claim
from multidrop.fleet.lines.records import ShareRecords
from multidrop.fleet.lines.unopened_lines import UnopenedLines

_log = logging.getLogger("multidrop.fleet")

REPORTED_NS = 2_000_000_000  # report a lost port immediately if the newest reply is older than this
# Lines are closed this many seconds before the lease expires. The kernel's timer fires half of the guard time
# after the expiry.
SILENT_S = 0.5
TAKE_AGAIN_S = 2.0  # pause between attempts to open a line
WRITTEN_AT_ONCE = 64  # limit of records written together: larger batches would delay renewals of the lease
LINES_AT_ONCE = 32


class Lines(Protocol):
    """The lines that this gateway polls."""

    async def take(self, line: str, description: Any) -> None:
        """Open the line and poll it.

        If this raises, it must leave the line closed; the keeper calls it again later.
        """

    async def let_go(self, line: str) -> None:
        """Stop polling the line and close it. After this call, no request is sent on it."""

    def port_loss(self, line: str) -> PortLoss | None:
        """Return how the port of a polled line was lost; None if it is open."""


class PortLoss(NamedTuple):
    """The loss of a polled line's port: why it could not be reopened, and how old the newest reply is (ns).

    `why` is None until the first attempt to reopen it has failed. `silent_ns` is None if no drive ever
    replied.
    """

    why: str | None
    silent_ns: int | None


class TakenLine(NamedTuple):
    """A polled line: the revision of its plant record, and when polling started (CLOCK_BOOTTIME, ns)."""

    revision: int
    since: int


class LineKeeper:
    """The lines that one gateway polls, and the task in progress on each.

    `on_change` is called when the member should take its next step.
    """

    def __init__(
        self, lines: Lines, lease: Lease, records: ShareRecords, on_change: Callable[[], object]
    ) -> None:
        self.lines = lines
        self.polled: dict[str, TakenLine] = {}
        self.troubles: dict[str, str] = {}  # why lines could not be opened, by line
        # how the port was lost, by line; only lines that are not polled because their port is lost
        self.lost: dict[str, str] = {}
        self.unopened = UnopenedLines(lambda: lease.clock())
        self.releasing: set[str] = set()  # our lines that must be released to other gateways
        self.may_claim = True  # False while a gateway of an incompatible version is alive
        self._lease = lease
        self._records = records
        self._owners = OwnerRecords(lease, records, lambda: self.may_poll, self._take_new)
        self._on_change = on_change
        self._is_leaving = False
        self._at_work: dict[str, asyncio.Task[None]] = {}  # task that opens, closes or claims a line
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
        """Return True if no line is open and no task on a line is in progress."""
        return not self.polled and not self._at_work

    @property
    def moves(self) -> int:
        """Return how often lines were claimed and released by this gateway."""
        return self._owners.moves

    def is_mine(self, line: str) -> bool:
        """Return True if the line's records name us, and we have not sent its release."""
        return self._owners.is_mine(line)

    def claim_of(self, line: str) -> Claim | None:
        """Return the records to write in order to claim the line; None if it cannot be claimed now."""
        return None if line in self._at_work else self._owners.claim_of(line)

    def may_stop(self, line: str) -> bool:
        """Return True if this gateway is the line's master now, even if `may_command` is still False."""
        return self._lease.is_valid and self.is_mine(line) and line in self.polled

    def may_command(self, line: str) -> bool:
        """Return True if this gateway is the line's master, and has been so for the guard time."""
        if not self.may_stop(line):
            return False
        return self._lease.clock() - self.polled[line].since >= self._lease.terms.guard

    async def fail(self) -> None:
        """Wait until an attempt to close a line fails; then raise the error, so that the process ends."""
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
        """Close lines that are no longer ours, open those that are, and release those that are closed.

        If a line should stay ours after its release was sent, claim it again, because the release may have
        been stored.
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
        """Note which polled lines lost their ports, so that other gateways can take such lines later."""
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
        self._tasks.add(task)  # the event loop keeps no reference to tasks
        self._at_work |= dict.fromkeys(lines, task)
        task.add_done_callback(lambda done: self._done(lines, done))

    def _done(self, lines: Sequence[str], task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        for line in lines:
            if self._at_work.get(line) is task:  # otherwise the line's next task has started already
                del self._at_work[line]
        self._on_change()
        failure = None if task.cancelled() else task.exception()
        if failure and not self._failure:
            self._failure = failure  # the line may still be open: `fail` ends the process
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
            except Exception as failure:  # such as an exception in a user's own class: other lines continue
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
    """Yield the lines in batches of at most WRITTEN_AT_ONCE."""
    left = iter(lines)
    while some := list(islice(left, WRITTEN_AT_ONCE)):
        yield some
