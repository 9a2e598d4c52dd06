"""Member: the state machine of one gateway of a fleet.

    NO_LEASE  No session, or its lease expired: no line is polled. Ends when two of three records are renewed.
    STARTING  The first 3 s: the gateway takes lines that were released or whose master is dead. Lines that
              never had a master wait, so that in a cold start each gateway takes only its own share.
    WORKING   The gateway claims and polls every line of its share.
    DRAINING  The gateway releases all lines and claims none.

A kernel timer kills this process half of the guard time after the lease has expired. The timer is cancelled
if all lines were closed before the lease expires. The engine sends no byte after the deadline, even if ports
are open. But a port that is still open may hold unsent bytes in the system's buffers, and only closing
discards them. So the timer must kill a process that was suspended before it has closed its ports.

A session continues if it is renewed before another gateway has ended it.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Coroutine, Iterable, Mapping, Sequence
from contextlib import suppress
from enum import StrEnum
from functools import partial
from typing import Any

from multidrop.core import Mastership
from multidrop.fleet.lines.lease import Lease, LifeLock
from multidrop.fleet.lines.line_keeper import LineKeeper, Lines, TakenLine
from multidrop.fleet.lines.observer import Observer
from multidrop.fleet.lines.records import ShareRecords
from multidrop.fleet.lines.rules import RULES, SECOND, USUAL, Terms, decide, owner_of
from multidrop.fleet.lines.shares import Sharers, Shares
from multidrop.fleet.servers import names
from multidrop.fleet.servers.buckets import LeaseBucket, Record
from multidrop.fleet.servers.connections import ServerPath
from multidrop.fleet.servers.leaders import SILENT_SERVER_S, Releases, have_leaders, keep_leaders
from multidrop.supervisor import Ended, end_tasks, supervisor

_log = logging.getLogger("multidrop.fleet")

GUARD_LOOK_S = 0.02
STEP_S = 0.05  # pause between two steps of the state machine while no record changes
LEAST_STEP_S = 0.01  # least pause between two steps
TIDY_NS = SECOND // 2  # time between checks of this gateway's lines if no change was reported
SETTLE_S = 3.0
# A gateway ends the sessions of other gateways only if its own lease is valid for at least this many seconds.
# If less is left, the servers may be failing for all gateways.
SOUND_S = 1.0
WEAK_LOOK_S = 1.0
# A session that has lost one of its three lease records is replaced by a new session. But it is kept for at
# least this time after the gateway's state was STARTING.
WEAK_NS = 10 * SECOND


class IncompatibleGateways:
    """Detects gateways with incompatible rules of ownership. While one is alive, this gateway claims no line.

    So while a fleet is updated, gateways of the new version wait until those of the old version are stopped.
    """

    def __init__(self, me: str, observer: Observer) -> None:
        self.gateways: frozenset[str] = frozenset()
        self._me = me
        self._observer = observer

    def look(self, present: Mapping[str, Mapping[str, Any]]) -> None:
        """Update the set of incompatible gateways from the sessions in `present`; ignore expired sessions."""
        others = {name for name, value in present.items() if value.get("rules") != RULES}
        found = frozenset(others - {self._me} - self._observer.dead(others).keys())
        if found != self.gateways:
            self.gateways = found
            _log.warning("%s", self.trouble or "no gateway of an incompatible version is left")

    @property
    def trouble(self) -> str:
        if not self.gateways:
            return ""
        others = ", ".join(sorted(self.gateways))
        return f"incompatible version of multidrop in this fleet: no line is taken while it runs on {others}"


class MemberState(StrEnum):
    """The state of a gateway, as `fleet status` shows it."""

    NO_LEASE = "no lease"
    STARTING = "starting"
    WORKING = "working"
    DRAINING = "draining"


class Member:
    """One gateway of a fleet: its lease, its lines, and its knowledge of the other gateways."""

    def __init__(
        self,
        name: str,
        paths: Sequence[ServerPath],
        lines: Lines,
        mastership: Mastership,
        *,
        lock: LifeLock | None = None,
        terms: Terms = USUAL,
    ) -> None:
        self.name = names.checked_name("gateway", name)
        self.paths = paths
        self.mastership = mastership
        self.is_draining = False
        own = [
            LeaseBucket(bucket, partial(paths.__getitem__, at), name)
            for at, bucket in enumerate(names.LEASES)
        ]
        self.lease = Lease(name, own, mastership, lock=lock, terms=terms, note=self._note)
        self.records = ShareRecords(name, self.best, terms, self._wake, self._is_mine)
        self.keeper = LineKeeper(lines, self.lease, self.records, self._mark_dirty)
        self._shares = Shares()
        self._share: set[str] = set()  # the lines that this gateway should poll
        self._releases = Releases(self.best, self._mark_dirty)
        self._settled_at = 0
        self._is_dirty = True
        self._woken = asyncio.Event()
        self._was_valid = False
        self._is_too_weak = False
        self._incompatible = IncompatibleGateways(name, self.records.observer)
        self._stepped: tuple[Any, ...] = ()
        self._over = asyncio.Event()

    # ---- state ----

    @property
    def state(self) -> MemberState:
        if not self.lease.is_valid:
            return MemberState.NO_LEASE
        if self.is_draining:
            return MemberState.DRAINING
        return MemberState.WORKING if self._is_settled else MemberState.STARTING

    @property
    def trouble(self) -> str:
        """Return why the lease is missing or at risk; "" if neither is the case."""
        weak = "another gateway ended one of its three lease records; a new lease starts soon"
        return self._incompatible.trouble or self.lease.trouble or (weak if self.lease.is_weak else "")

    @property
    def polled(self) -> Mapping[str, TakenLine]:
        return self.keeper.polled

    @property
    def wanted(self) -> Mapping[str, str]:
        """The gateway to which each line is assigned."""
        return self._shares.wanted

    @property
    def _is_settled(self) -> bool:
        return self.lease.clock() >= self._settled_at

    def best(self) -> ServerPath:
        """Return the connection that renewed the lease last; without a lease, return any open connection."""
        path = self.paths[self.lease.best]
        return path if path.is_open else next((one for one in self.paths if one.is_open), path)

    def _mark_dirty(self) -> None:
        self._is_dirty = True

    def _wake(self) -> None:
        """Let the state machine take its next step immediately."""
        self._is_dirty = True
        self._woken.set()

    def drain(self) -> None:
        self.is_draining = self._is_dirty = True

    def _is_mine(self, record: Record) -> bool:
        return owner_of(record) == (self.name, self.lease.session)

    def _note(self) -> dict[str, Any]:
        return {
            "draining": self.is_draining,
            "lines": len(self.polled),
            "unopened": sorted(self.keeper.unopened.named()),
            "at_ms": time.time_ns() // 1_000_000,  # UTC, only for display
            "margin_ms": max(0, round(1000 * self.lease.left_s)),
        }

    # ---- run ----

    async def run(self) -> None:
        """Work until `end` is called or this is cancelled; then release all lines and end the session.

        Raises Ended, after the same cleanup, if one of its tasks has ended by itself.
        """
        works = {f"{self.name}: {name}": work for name, work in self._works().items()}
        tasks = {name: supervisor().keep(name, work) for name, work in works.items()}
        over = asyncio.ensure_future(self._over.wait())
        ended: set[asyncio.Task[Any]] = set()
        try:
            ended, _ = await asyncio.wait([over, *tasks.values()], return_when=asyncio.FIRST_COMPLETED)
        finally:
            for name in tasks:
                supervisor().let_go(name)
            await end_tasks(over, *tasks.values())
            await self._leave()
        ended.discard(over)
        for task in ended:
            failure = None if task.cancelled() else task.exception()
            raise Ended(f"{task.get_name()} has ended: {supervisor().dead[task.get_name()]}") from failure

    def end(self) -> None:
        """Make `run` return; further calls have no effect."""
        self._over.set()

    def _works(self) -> dict[str, Coroutine[Any, Any, None]]:
        records = {f"records {at}": work for at, work in enumerate(self.records.works(), 1)}
        return {
            **{f"path {at}": path.keep() for at, path in enumerate(self.paths, 1)},
            **{f"lease {at + 1}": self.lease.renew(at) for at in range(len(self.paths))},
            **records,
            "guard": self._guard(),
            "leaders": keep_leaders(self.best, self._keeps_leaders),
            "weak session": self._watch_weakness(),
            "releases": self._releases.watch(),
            "steps": self._live(),
            "lines": self.keeper.fail(),
        }

    async def _leave(self) -> None:
        """Release all lines and end the session, so that other gateways take over immediately."""
        await self.keeper.let_all_go()
        await self.lease.end()

    async def _live(self) -> None:
        while True:
            if not self.lease.session:
                await self._prepare()
                await self.lease.begin()
                self._settled_at = self.lease.clock() + int(SETTLE_S * SECOND)
                self._shares.reset()
                self._is_dirty = True
                _log.info("%s: the lease began (session %d)", self.name, self.lease.session)
            elif self.lease.is_over or self._is_too_weak:
                what = "is over" if self.lease.is_over else "lost one of three records; a new one starts"
                _log.warning("%s: the lease %s (session %d)", self.name, what, self.lease.session)
                await self._leave()
                self._is_dirty, self._is_too_weak = True, False
            self._woken.clear()
            await self.step()
            await asyncio.sleep(LEAST_STEP_S)
            with suppress(TimeoutError):
                await asyncio.wait_for(self._woken.wait(), STEP_S - LEAST_STEP_S)

    async def _prepare(self) -> None:
        """Wait until all records are read, and no incompatible gateway is alive.

        Reading may take longer than a lease is valid.
        """
        while True:
            self._note_others(self.records.observer.sessions())
            if self.records.is_complete and not self._incompatible.gateways:
                break
            await asyncio.sleep(STEP_S)

    async def _guard(self) -> None:
        """Close the lines before the lease expires; then cancel the timer that would kill this process."""
        is_armed = was_late = False
        while True:
            if self.keeper.may_poll:
                if was_late:
                    _log.warning("%s: the lease is valid again", self.name)
                is_armed, was_late = True, False
            elif is_armed:
                self.keeper.reconcile()
                if self.keeper.is_silent:
                    is_armed, was_late = False, True
                    self.mastership.end()
                    _log.warning("%s: the lease was not renewed in time; all lines are closed", self.name)
            await asyncio.sleep(GUARD_LOOK_S)

    async def _watch_weakness(self) -> None:
        """Start a new session if other gateways have ended one of this session's three lease records.

        With two records, the session would be over as soon as one more server fails. Between two sessions
        the gateway's lines have no master for a moment. So only one gateway of the fleet does this at a time,
        and only while all three records could be written.
        """
        while True:
            await asyncio.sleep(WEAK_LOOK_S)
            lease = self.lease
            if not (lease.is_weak and lease.is_valid) or lease.clock() < self._settled_at + WEAK_NS:
                continue
            if self.records.observer.weak()[:1] == [self.name]:
                self._is_too_weak = await have_leaders(self.best()) and await lease.could_be_whole()

    def _keeps_leaders(self) -> bool:
        """Return True if this gateway manages the buckets' leaders.

        Of all living gateways, the one whose name is first in the alphabet does this.
        """
        return self.lease.is_valid and min(self.records.observer.sessions(), default="") == self.name

    # ---- one step ----

    async def step(self) -> None:
        """Take one step of the state machine.

        A step waits for the servers in one case only: when it ends the session of a dead gateway.
        """
        observer = self.records.observer
        present = observer.sessions()
        if not self.lease.is_valid:
            self._was_valid = False
        elif not self._was_valid:
            self._was_valid = True
            observer.restart_waits()
        elif self.lease.left_s > SOUND_S and await observer.end_the_dead(present):
            present = observer.sessions()
        await self._share_out(present)
        sessions = tuple((name, value["session"]) for name, value in present.items())
        now = (self._is_settled, self.keeper.may_poll, sessions, self.lease.clock() // TIDY_NS)
        if self._is_dirty or now != self._stepped:
            self._is_dirty, self._stepped = False, now
            if self.lease.is_valid:
                self._claim_and_release()
            self.keeper.reconcile()

    def _note_others(self, present: Mapping[str, Mapping[str, Any]]) -> set[str]:
        """Return the other gateways that may poll lines."""
        self._incompatible.look(present)
        self.keeper.may_claim = not self._incompatible.gateways
        others = {name for name, value in present.items() if not value["draining"]}
        others -= {self.name} | self._incompatible.gateways
        self._shares.note_others(frozenset(others), self.lease.clock())
        return others

    async def _share_out(self, present: Mapping[str, Mapping[str, Any]]) -> None:
        sharing = self._note_others(present)
        if not self.is_draining and self.lease.session:
            sharing.add(self.name)
        lines = self.records.lines()
        sharers = Sharers(tuple(sorted(sharing)), lines, self._unopened(present, sharing, lines))
        if await self._shares.make(sharers, self.lease.clock(), is_settled=self._is_settled):
            self._share = self._shares.of(self.name)
            self.keeper.unopened.home = frozenset(
                line for line, name in self._shares.home.items() if name == self.name
            )
            self.records.want(self._share)
            self._is_dirty = True

    def _unopened(
        self, present: Mapping[str, Mapping[str, Any]], sharing: Iterable[str], lines: Iterable[str]
    ) -> tuple[tuple[str, frozenset[str]], ...]:
        """Return, for each gateway, the lines whose ports it could not open.

        Gateways write these lines into their lease records, the records that they renew to stay alive. A
        gateway whose record has no such list is left out.
        """
        unopened = {name: value.get("unopened") for name, value in present.items()}
        unopened[self.name] = list(self.keeper.unopened.named())
        known = {name: said for name in sorted(sharing) if isinstance(said := unopened.get(name), list)}
        if not any(known.values()):
            return ()
        there = frozenset(lines)
        found = {
            name: there.intersection(one for one in said if isinstance(one, str))
            for name, said in known.items()
        }
        self.keeper.unopened.hopeless = there.intersection(*found.values())
        return tuple(found.items())

    def _claim_and_release(self) -> None:
        me = (self.name, self.lease.session)
        owned = self.records.owned_by(*me)
        step = decide(
            me,
            self._share | owned,
            self.wanted,
            self.records.of,
            self.keeper.claim_of,
            is_settled=self._is_settled,
            is_draining=self.is_draining,
        )
        gone = {line for line in owned if not self.records.is_in_plant(line)}
        self.keeper.releasing = gone | self._releases.due(
            step.releases, 0 if self.is_draining else SILENT_SERVER_S
        )
        self.keeper.claim(step.claims)
