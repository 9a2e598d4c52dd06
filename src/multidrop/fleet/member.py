"""Member: the state machine of one gateway of a fleet.

    OUTSIDE   no session. No line is polled. Ends with a session on two of three paths.
    SETTLING  3 s from then on: lines of dead gateways and lines that others give away are taken, but none
              that nobody had, so that in a cold start each gateway takes its own share.
    WORKING   every line that the balance gives us is claimed, and polled from then on.
    DRAINING  every line is given away and none is claimed.

In every state: a line is polled only while its record names us and our present session, and while the lease
is valid. Half a second before it runs out the lines are closed; when the last of them is, the kernel's timer
is called off. (The engine sends nothing after the deadline, closed or not. Closing takes back what the system
was given and could not send; so a process that stands still before that must die.) A session that is renewed
before anybody has ended it goes on.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from contextlib import suppress
from enum import StrEnum
from functools import partial
from typing import Any, Protocol

from multidrop.fleet import names
from multidrop.fleet.balance import Balance
from multidrop.fleet.buckets import Bucket, Follower, Record
from multidrop.fleet.errors import Conflict, FleetError
from multidrop.fleet.leaders import bring_leaders_home
from multidrop.fleet.lease import Lease, LifeLock, MayPoll
from multidrop.fleet.lease_rules import SECOND, USUAL, Terms
from multidrop.fleet.observer import Observer
from multidrop.fleet.ownership import NOBODY, decide, owner_of, owner_value
from multidrop.fleet.servers import ServerPath

_log = logging.getLogger("multidrop.fleet")

SILENT_S = 0.5  # before the lease runs out: time for closing; the timer leaves guard / 2 more
GUARD_LOOK_S = 0.02
STEP_S = 0.1
FOLLOW_S = 0.2
SETTLE_S = 3.0
HOME_S = 1.0
CANCEL_S = 0.2
TAKE_AGAIN_S = 2.0  # after a line that could not be taken
CLAIMS_AT_ONCE = 64
LINES_AT_ONCE = 32


class MemberState(StrEnum):
    OUTSIDE = "outside"
    SETTLING = "settling"
    WORKING = "working"
    DRAINING = "draining"


class Lines(Protocol):
    """The lines that this gateway polls."""

    async def take(self, line: str, description: Any) -> None:
        """Open the line and poll it. Raises OSError or ValueError where that fails; it is tried again."""

    async def let_go(self, line: str) -> None:
        """Poll the line no more, and close it: when this returns nothing of ours is sent on it."""


class Member:
    """One gateway: its lease, its share of the lines, and what it does about the other gateways."""

    def __init__(
        self,
        name: str,
        paths: Sequence[ServerPath],
        lines: Lines,
        mastership: MayPoll,
        *,
        lock: LifeLock | None = None,
        terms: Terms = USUAL,
    ) -> None:
        self.name = names.checked_name("gateway", name)
        self.paths = paths
        self.lines = lines
        self.mastership = mastership
        self.polled: dict[str, int] = {}  # lines, with the revision of their description
        self.troubles: dict[str, str] = {}  # lines that could not be taken, and why
        self.is_draining = False
        self.moves = 0
        own = [Bucket(bucket, partial(self._path, at)) for at, bucket in enumerate(names.LEASES)]
        self.lease = Lease(name, own, mastership, lock=lock, terms=terms, note=self._note)
        self.observer = Observer(name, [Bucket(bucket, self.best) for bucket in names.LEASES], terms)
        self.owners = {bucket: Follower(Bucket(bucket, self.best)) for bucket in names.OWNERS}
        self.plant = Follower(Bucket(names.PLANT, self.best))
        self.wanted: dict[str, str] = {}
        self._balance = Balance()
        self._balanced: tuple[Any, ...] = ()
        self._settled_at = 0
        self._looked: set[str] = set()  # buckets that were read at least once
        self._is_dirty = True
        self._is_leaving = self._was_valid = False
        self._stepped: tuple[bool, bool] | None = None
        self._releasing: set[str] = set()
        self._at_work: dict[str, asyncio.Task[None]] = {}  # by line: it is taken, let go or claimed
        self._again_at: dict[str, float] = {}
        self._failed: asyncio.Future[None] | None = None
        self._claims = asyncio.Semaphore(CLAIMS_AT_ONCE)
        self._openings = asyncio.Semaphore(LINES_AT_ONCE)

    # ---- what others ask ----

    @property
    def state(self) -> MemberState:
        if not self.lease.session:
            return MemberState.OUTSIDE
        if self.is_draining:
            return MemberState.DRAINING
        return MemberState.WORKING if self._is_settled else MemberState.SETTLING

    @property
    def _is_settled(self) -> bool:
        return self.lease._clock() >= self._settled_at

    @property
    def _may_poll(self) -> bool:
        """Say whether lines are taken and kept: there is a lease, and time to close them before it ends."""
        return bool(self.lease.session) and self.lease.left_s > SILENT_S and not self._is_leaving

    def _path(self, number: int) -> ServerPath:
        return self.paths[number]

    def best(self) -> ServerPath:
        """Return the path whose lease was renewed last, or before there is one any that is open."""
        path = self.paths[self.lease.best]
        return path if path.is_open else next((one for one in self.paths if one.is_open), path)

    def _mark_dirty(self) -> None:
        self._is_dirty = True

    def drain(self) -> None:
        """Give all lines away, and take none from now on."""
        self.is_draining = self._is_dirty = True

    def record(self, line: str) -> Record | None:
        """Return the record of a line's master."""
        return self.owners[names.owner_bucket(line)].records.get(line)

    def is_mine(self, line: str) -> bool:
        return owner_of(self.record(line)) == (self.name, self.lease.session)

    def may_command(self, line: str) -> bool:
        """Say whether this is the line's master now."""
        return self.lease.is_valid and self.is_mine(line) and line in self.polled

    def _note(self) -> dict[str, Any]:
        return {"draining": self.is_draining, "lines": len(self.polled), "margin_ms": self._margin_ms()}

    def _margin_ms(self) -> int:
        return max(0, round(1000 * self.lease.left_s))

    # ---- life ----

    async def run(self) -> None:
        """Live until cancelled; then give all lines away and end the session."""
        works: list[Coroutine[Any, Any, None]] = [
            *(path.keep() for path in self.paths),
            *(self.lease.renew(path) for path in range(len(self.paths))),
            self._guard(),
            self._home(),
            *(self._follow(name, look) for name, look in self._looks().items()),
            self._live(),
        ]
        tasks = [asyncio.create_task(work) for work in works]
        self._failed = asyncio.get_running_loop().create_future()
        try:
            await asyncio.wait([*tasks, self._failed], return_when=asyncio.FIRST_COMPLETED)
        finally:
            await _cancel(tasks)
            ended = await asyncio.gather(*tasks, return_exceptions=True)
            await self._leave()
            for failure in ended:
                if isinstance(failure, Exception):
                    raise failure
            if self._failed.done():
                self._failed.result()

    async def _leave(self) -> None:
        """Let all lines go, and end the session: others take over at once."""
        await self._let_all_go()
        await self.lease.end()

    async def _let_all_go(self) -> None:
        self._is_leaving = True
        try:
            while self.polled or self._at_work:
                self._reconcile()
                await asyncio.gather(*self._at_work.values(), return_exceptions=True)
        finally:
            self._is_leaving = False

    async def _live(self) -> None:
        while True:
            if not self.lease.session:
                await self.lease.begin()
                self._settled_at = self.lease._clock() + int(SETTLE_S * SECOND)
                self._is_dirty = True
                _log.info("%s: session %d began", self.name, self.lease.session)
            elif self.lease.is_over:
                _log.warning("%s: session %d is over", self.name, self.lease.session)
                await self._let_all_go()
                await self.lease.end()
                self._is_dirty = True
            await self.step()
            await asyncio.sleep(STEP_S)

    async def _guard(self) -> None:
        """Close the lines before the lease has run out; only then is the kernel's timer called off."""
        is_armed = False
        while True:
            if self._may_poll:
                is_armed = True
            elif is_armed:
                self._reconcile()
                if not self.polled and not self._at_work:
                    is_armed = False
                    self.mastership.end()
                    _log.warning("%s: the lease was not renewed in time; no line is polled", self.name)
            await asyncio.sleep(GUARD_LOOK_S)

    async def _home(self) -> None:
        """Bring leaders home; one gateway does it, the first by name."""
        while True:
            await asyncio.sleep(HOME_S)
            if self.lease.is_valid and min(self.observer.sessions(), default="") == self.name:
                with suppress(FleetError):
                    await bring_leaders_home(self.best())

    # ---- what changes ----

    def _looks(self) -> dict[str, Callable[[], Awaitable[Any]]]:
        looks: dict[str, Callable[[], Awaitable[Any]]] = {names.PLANT: self.plant.look}
        looks |= {name: partial(self.observer.look, path) for path, name in enumerate(names.LEASES)}
        return looks | {name: one.look for name, one in self.owners.items()}

    async def _follow(self, name: str, look: Callable[[], Awaitable[Any]]) -> None:
        while True:
            with suppress(FleetError):
                if await look() or name not in self._looked:
                    self._is_dirty = True
                self._looked.add(name)
            await asyncio.sleep(FOLLOW_S)

    def lines_of_plant(self) -> list[str]:
        return [
            name for name, record in self.plant.records.items() if record.value and "line" in record.value
        ]

    # ---- one step ----

    async def step(self) -> None:
        """Do what is to be done now; nothing here waits for a server, but the ending of dead gateways."""
        if not self.lease.is_valid:
            self._was_valid = False
        elif not self._was_valid:
            self._was_valid = True
            self.observer.begin_anew()
        else:
            await self.observer.end_the_dead()
        await self._share_out()
        now = (self._is_settled, self._may_poll)
        if self._is_dirty or now != self._stepped:
            self._is_dirty, self._stepped = False, now
            if self.lease.is_valid and len(self._looked) == len(names.BUCKETS):
                self._claim_and_release()
            self._reconcile()

    async def _share_out(self) -> None:
        """Make the balance anew where gateways or lines came or went; it takes long: outside of the loop."""
        present = self.observer.sessions()
        gateways = tuple(
            name for name, value in present.items() if not value["draining"] and name != self.name
        )
        if not self.is_draining and self.lease.session:
            gateways = tuple(sorted((*gateways, self.name)))
        lines = tuple(sorted(self.lines_of_plant()))
        if (gateways, lines) == self._balanced:
            return
        loop = asyncio.get_running_loop()
        self.wanted = await loop.run_in_executor(None, self._balance.assign, lines, gateways)
        self._balanced, self._is_dirty = (gateways, lines), True

    def _claim_and_release(self) -> None:
        me = (self.name, self.lease.session)
        lines = {*self.wanted, *self.lines_of_plant()}
        step = decide(
            me,
            lines,
            self.wanted,
            self.record,
            self.observer.is_over,
            is_settled=self._is_settled,
            is_draining=self.is_draining,
        )
        self._releasing = step.releases | {
            line
            for follower in self.owners.values()
            for line, record in follower.records.items()
            if line not in lines and owner_of(record) == me
        }
        for line, revision in step.claims.items():
            if line not in self._at_work:
                self._start(line, self._write_owner(line, self.name, revision))

    def _reconcile(self) -> None:
        """Let go of what is not ours any more, take what is, and give away what was let go."""
        valid = self._may_poll
        mine = {
            line: self.plant.records[line].revision
            for line in self.lines_of_plant()
            if valid and line not in self._releasing and self.is_mine(line)
        }
        now = time.monotonic()
        for line, revision in list(self.polled.items()):
            if mine.get(line) != revision and line not in self._at_work:
                self._start(line, self._let_go(line))
        for line in mine.keys() - self.polled.keys() - self._at_work.keys():
            if now >= self._again_at.get(line, 0.0):
                self._start(line, self._take(line))
        if valid:
            for line in self._releasing - self.polled.keys() - self._at_work.keys():
                record = self.record(line)
                if record and self.is_mine(line):
                    self._start(line, self._write_owner(line, NOBODY, record.revision))

    # ---- one line ----

    def _start(self, line: str, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(work)
        self._at_work[line] = task
        task.add_done_callback(lambda done: self._done(line, done))

    def _done(self, line: str, task: asyncio.Task[None]) -> None:
        self._at_work.pop(line, None)
        self._is_dirty = True
        failure = None if task.cancelled() else task.exception()
        if failure and self._failed and not self._failed.done():
            self._failed.set_exception(failure)  # a line that is not closed for certain: end the process

    async def _write_owner(self, line: str, gateway: str, revision: int) -> None:
        """Claim a line, or give it away; only the server decides, by the revision."""
        bucket = names.owner_bucket(line)
        value = owner_value(gateway, self.lease.session if gateway else 0, time.time_ns() // 1_000_000)
        async with self._claims:
            if not self._may_poll:
                return
            with suppress(Conflict, FleetError):  # what became of it will be read
                stored = await self.owners[bucket].bucket.put(line, value, revision)
                self.owners[bucket].take(Record(line, stored, value))
                self.moves += 1
        if gateway and line in self.plant.records:
            await self._take(line)

    async def _take(self, line: str) -> None:
        record = self.plant.records[line]
        async with self._openings:
            if not (self._may_poll and self.is_mine(line)):
                return
            try:
                await self.lines.take(line, record.value)
            except (OSError, ValueError) as failure:
                self.troubles[line] = str(failure)
                self._again_at[line] = time.monotonic() + TAKE_AGAIN_S
                asyncio.get_running_loop().call_later(1.01 * TAKE_AGAIN_S, self._mark_dirty)
                _log.warning("line %s is not taken, and tried again: %s", line, failure)
            else:
                self.troubles.pop(line, None)
                self.polled[line] = record.revision

    async def _let_go(self, line: str) -> None:
        await self.lines.let_go(line)
        self.polled.pop(line, None)


async def _cancel(tasks: Sequence[asyncio.Task[None]]) -> None:
    """End the tasks: again where one of the libraries below has swallowed it."""
    left = set(tasks)
    while left:
        for task in left:
            task.cancel()
        _, left = await asyncio.wait(left, timeout=CANCEL_S)
