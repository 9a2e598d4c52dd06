"""Member: the state machine of one gateway of a fleet.

    OUTSIDE   no session, or a lease that ran out. No line is polled. Ends with one on two of three paths.
    SETTLING  3 s from then on: lines of dead gateways and lines that others give away are taken, but none
              that nobody had, so that in a cold start each gateway takes its own share.
    WORKING   every line that the balance gives us is claimed, and polled from then on.
    DRAINING  every line is given away and none is claimed.

When the last line is closed, as in every state before the lease runs out, the kernel's timer is called off.
(The engine sends nothing after the deadline, closed or not. Closing takes back what the system was given and
could not send; so a process that stands still before that must die.) A session that is renewed before anybody
has ended it goes on.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Coroutine, Iterable, Mapping, Sequence
from contextlib import suppress
from enum import StrEnum
from functools import partial
from typing import Any

from multidrop.fleet.file_lock import LifeLock
from multidrop.fleet.leases.lease import Lease, MayPoll
from multidrop.fleet.leases.observer import Observer
from multidrop.fleet.leases.rules import RULES, SECOND, USUAL, Terms
from multidrop.fleet.lines.line_keeper import LineKeeper, Lines, PortLoss, TakenLine, no_loss
from multidrop.fleet.lines.ownership import decide, owner_of
from multidrop.fleet.lines.records import ShareRecords
from multidrop.fleet.lines.releases import WAIT_S, Releases
from multidrop.fleet.lines.shares import Sharers, Shares
from multidrop.fleet.lines.unopened_lines import UnopenedLines
from multidrop.fleet.servers import names
from multidrop.fleet.servers.buckets import LeaseBucket, Record
from multidrop.fleet.servers.connections import ServerPath
from multidrop.fleet.servers.leaders import have_leaders, keep_leaders
from multidrop.supervisor import Ended, end_tasks, supervisor

_log = logging.getLogger("multidrop.fleet")

WEAK_LOOK_S = 1.0
WEAK_NS = 10 * SECOND  # for which it goes on first, from when its gateway has settled


class WeakSession:
    """Watches our own session; `is_too_weak` while it is to be given up."""

    def __init__(self, lease: Lease, observer: Observer, path: Callable[[], ServerPath]) -> None:
        self.is_too_weak = False
        self._lease = lease
        self._observer = observer
        self._path = path

    async def watch(self, settled_at: Callable[[], int]) -> None:
        """Look at it for ever.

        Its lines are others' for a moment, so one gateway at a time gives up, once all paths answer and lines
        can be claimed.
        """
        while True:
            await asyncio.sleep(WEAK_LOOK_S)
            lease = self._lease
            if not (lease.is_weak and lease.is_valid) or lease.clock() < settled_at() + WEAK_NS:
                continue
            if self._observer.weak()[:1] == [lease.name]:
                self.is_too_weak = await have_leaders(self._path()) and await lease.could_be_whole()


UNSAID = 1  # the rules of who says none


class OtherRules:
    """The other `gateways` that live by other rules than ours, by what their sessions say."""

    def __init__(self, me: str, observer: Observer) -> None:
        self.gateways: frozenset[str] = frozenset()
        self._me = me
        self._observer = observer

    def look(self, present: Mapping[str, Mapping[str, Any]]) -> None:
        """Note who there is of those with a session.

        One that is renewed no more does not count, though nobody may have ended it yet.
        """
        others = {name for name, value in present.items() if value.get("rules", UNSAID) != RULES}
        found = frozenset(others - {self._me} - self._observer.dead(others).keys())
        if found != self.gateways:
            self.gateways = found
            _log.warning("%s", self.trouble or "no gateway with other rules is left")

    @property
    def trouble(self) -> str:
        """Return the sentence about them; "" where there are none."""
        if not self.gateways:
            return ""
        names = ", ".join(sorted(self.gateways))
        return f"another version of multidrop runs in this fleet: no line is taken until {names} is stopped"


GUARD_LOOK_S = 0.02
STEP_S = 0.05  # between steps; at once where records have changed
LEAST_STEP_S = 0.01  # between any two
TIDY_NS = SECOND // 2  # between looks at all lines of the share, where nothing is known to have changed
SETTLE_S = 3.0
SOUND_S = 1.0  # of our lease, to end others': where less is left the servers may fail all of us alike


class MemberState(StrEnum):
    OUTSIDE = "outside"
    SETTLING = "settling"
    WORKING = "working"
    DRAINING = "draining"


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
        port_loss: Callable[[str], PortLoss | None] = no_loss,
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
        self.unopened = UnopenedLines(lambda: self.lease.clock())
        self.keeper = LineKeeper(
            lines, self.lease, self.records, self._mark_dirty, unopened=self.unopened, port_loss=port_loss
        )
        self._shares = Shares()
        self._share: set[str] = set()  # the lines that should be ours
        self._releases = Releases(self.best, self._mark_dirty)
        self._settled_at = 0
        self._is_dirty = True
        self._woken = asyncio.Event()
        self._was_valid = False
        self._weak = WeakSession(self.lease, self.records.observer, self.best)
        self._other_rules = OtherRules(name, self.records.observer)
        self._stepped: tuple[Any, ...] = ()
        self._over = asyncio.Event()

    # ---- what others ask ----

    @property
    def state(self) -> MemberState:
        if not self.lease.is_valid:
            return MemberState.OUTSIDE
        if self.is_draining:
            return MemberState.DRAINING
        return MemberState.WORKING if self._is_settled else MemberState.SETTLING

    @property
    def trouble(self) -> str:
        """Return what is not well with the lease, or hinders it; "" for nothing."""
        weak = "others have ended one path of its lease; a new session begins soon"
        return self._other_rules.trouble or self.lease.trouble or (weak if self.lease.is_weak else "")

    @property
    def polled(self) -> Mapping[str, TakenLine]:
        """Return the lines that are polled."""
        return self.keeper.polled

    @property
    def wanted(self) -> Mapping[str, str]:
        """Return each line's gateway, by the balance."""
        return self._shares.wanted

    @property
    def _is_settled(self) -> bool:
        return self.lease.clock() >= self._settled_at

    def best(self) -> ServerPath:
        """Return the path whose lease was renewed last; before there is a lease, any open path."""
        path = self.paths[self.lease.best]
        return path if path.is_open else next((one for one in self.paths if one.is_open), path)

    def _mark_dirty(self) -> None:
        self._is_dirty = True

    def _wake(self) -> None:
        """Take the next step at once."""
        self._is_dirty = True
        self._woken.set()

    def drain(self) -> None:
        """Give all lines away, and take none from now on."""
        self.is_draining = self._is_dirty = True

    def _is_mine(self, record: Record) -> bool:
        return owner_of(record) == (self.name, self.lease.session)

    def _note(self) -> dict[str, Any]:
        return {
            "draining": self.is_draining,
            "lines": len(self.polled),
            "unopened": sorted(self.unopened.named()),
            "at_ms": time.time_ns() // 1_000_000,  # UTC, for people alone
            "margin_ms": max(0, round(1000 * self.lease.left_s)),
        }

    # ---- life ----

    async def run(self) -> None:
        """Live until `end` is called, or this is cancelled; then give all lines away and end the session.

        Raises Ended, after the same, if a part of this has ended by itself.
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
        """Let `run` come to its end; called again, it disturbs nothing."""
        self._over.set()

    def _works(self) -> dict[str, Coroutine[Any, Any, None]]:
        """Return what must go on, by name."""
        records = {f"records {at}": work for at, work in enumerate(self.records.works(), 1)}
        return {
            **{f"path {at}": path.keep() for at, path in enumerate(self.paths, 1)},
            **{f"lease {at + 1}": self.lease.renew(at) for at in range(len(self.paths))},
            **records,
            "guard": self._guard(),
            "leaders": keep_leaders(self.best, self._keeps_leaders),
            "weak session": self._weak.watch(lambda: self._settled_at),
            "releases": self._releases.watch(),
            "steps": self._live(),
            "lines": self.keeper.fail(),
        }

    async def _leave(self) -> None:
        """Let all lines go, and end the session: others take over at once."""
        await self.keeper.let_all_go()
        await self.lease.end()

    async def _live(self) -> None:
        while True:
            if not self.lease.session:
                await self._prepare()
                await self.lease.begin()
                self._settled_at = self.lease.clock() + int(SETTLE_S * SECOND)
                self._shares.begin_anew()
                self._is_dirty = True
                _log.info("%s: session %d began", self.name, self.lease.session)
            elif self.lease.is_over or self._weak.is_too_weak:
                what = "is over" if self.lease.is_over else "lost a path; a new one begins"
                _log.warning("%s: session %d %s", self.name, self.lease.session, what)
                await self._leave()
                self._is_dirty, self._weak.is_too_weak = True, False
            self._woken.clear()
            await self.step()
            await asyncio.sleep(LEAST_STEP_S)
            with suppress(TimeoutError):
                await asyncio.wait_for(self._woken.wait(), STEP_S - LEAST_STEP_S)

    async def _prepare(self) -> None:
        """Wait until all was read: a large plant takes seconds, in which no lease could be renewed.

        Wait for the end of gateways with other rules too.
        """
        while True:
            self._see(self.records.observer.sessions())
            if self.records.is_complete and not self._other_rules.gateways:
                break
            await asyncio.sleep(STEP_S)

    async def _guard(self) -> None:
        """Close the lines before the lease has run out; only then is the kernel's timer called off."""
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
                    _log.warning("%s: the lease was not renewed in time; no line is polled", self.name)
            await asyncio.sleep(GUARD_LOOK_S)

    def _keeps_leaders(self) -> bool:
        """Say whether leaders are ours to keep: one gateway does it, the first by name."""
        return self.lease.is_valid and min(self.records.observer.sessions(), default="") == self.name

    # ---- one step ----

    async def step(self) -> None:
        """Do what is due now. Only the ending of dead gateways waits for a server."""
        observer = self.records.observer
        present = observer.sessions()
        if not self.lease.is_valid:
            self._was_valid = False
        elif not self._was_valid:
            self._was_valid = True
            observer.begin_anew()
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

    def _see(self, present: Mapping[str, Mapping[str, Any]]) -> set[str]:
        """Return the other gateways that take lines; since when they are the same is noted."""
        self._other_rules.look(present)
        self.keeper.may_claim = not self._other_rules.gateways
        others = {name for name, value in present.items() if not value["draining"]}
        others -= {self.name} | self._other_rules.gateways
        self._shares.see(frozenset(others), self.lease.clock())
        return others

    async def _share_out(self, present: Mapping[str, Mapping[str, Any]]) -> None:
        """Make the shares anew where gateways or lines came or went."""
        sharing = self._see(present)
        if not self.is_draining and self.lease.session:
            sharing.add(self.name)
        lines = self.records.lines()
        sharers = Sharers(tuple(sorted(sharing)), lines, self._unopened(present, sharing, lines))
        if await self._shares.make(sharers, self.lease.clock(), is_settled=self._is_settled):
            self._share = self._shares.of(self.name)
            self.unopened.home = frozenset(
                line for line, name in self._shares.home.items() if name == self.name
            )
            self.records.want(self._share)
            self._is_dirty = True

    def _unopened(
        self, present: Mapping[str, Mapping[str, Any]], sharing: Iterable[str], lines: Iterable[str]
    ) -> tuple[tuple[str, frozenset[str]], ...]:
        """Return the lines that each gateway could not open; none of versions that do not say so.

        Those would not take what is given away for them.
        """
        told = {name: value.get("unopened") for name, value in present.items()}
        told[self.name] = list(self.unopened.named())
        known = {name: said for name in sorted(sharing) if isinstance(said := told.get(name), list)}
        if not any(known.values()):
            return ()
        there = frozenset(lines)
        found = {
            name: there.intersection(one for one in said if isinstance(one, str))
            for name, said in known.items()
        }
        self.unopened.hopeless = there.intersection(*found.values())
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
        self.keeper.releasing = gone | self._releases.due(step.releases, 0 if self.is_draining else WAIT_S)
        self.keeper.claim(step.claims)
