"""Lease: a gateway's own session, renewed on three paths, and until when the gateway may send."""

from __future__ import annotations

import asyncio
import logging
import os
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple, Protocol

from multidrop.fleet import file_lock
from multidrop.fleet.errors import Conflict, FleetError, Unsure
from multidrop.fleet.file_lock import LifeLock
from multidrop.fleet.leases import rules as lease_rules
from multidrop.fleet.leases.rules import RENEW_S, SECOND, SeenRevision, Terms
from multidrop.fleet.servers.buckets import NONE_YET, Bucket, Record

_log = logging.getLogger("multidrop.fleet")

JOIN_S = 0.25  # between tries to begin a session
AGAIN_S = 0.1  # after a renewal that failed


def boottime_ns() -> int:
    """Return CLOCK_BOOTTIME: it runs on while the machine sleeps, and nobody sets it."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


class MayPoll(Protocol):
    """The engine's right to send; `multidrop.core.Mastership` is one."""

    def extend(self, until_ns: int) -> object:
        """Let the engine send until then, and put the kernel's timer off.

        Raises ValueError for a time that is past: then nothing has changed.
        """

    def end(self) -> object:
        """Send nothing more, and call the timer off."""


class Held(NamedTuple):
    """Our record on one path: its revision, and when the renewal that made it was about to be sent (ns)."""

    revision: int
    sent: int


class Lease:
    """The session of one gateway.

    `until` is the time (CLOCK_BOOTTIME, ns) until which it may send. `note` returns what else stands in the
    record, for others to see.
    """

    def __init__(
        self,
        name: str,
        buckets: Sequence[Bucket],
        mastership: MayPoll,
        *,
        lock: LifeLock | None = None,
        terms: Terms = lease_rules.USUAL,
        clock: Callable[[], int] = boottime_ns,
        note: Callable[[], Mapping[str, Any]] = dict,
    ) -> None:
        self.name = name
        self.terms = terms
        self.session = 0  # 0: none
        self.until = 0
        self.trouble = ""  # why there is no session
        self.began_ms = 0  # UTC
        self.held: list[Held | None] = [None] * len(buckets)
        self._buckets = buckets
        self._mastership = mastership
        self._lock = lock
        self.clock = clock
        self._note = note
        self._nonce = uuid.uuid4().hex
        self._watched: list[SeenRevision | None] = [None] * len(buckets)
        self._newest = 0  # session of this process: no number is used twice, whatever others write
        self._ended: set[int] = set()  # paths that others have ended in this session, for good

    # ---- what others ask ----

    @property
    def is_valid(self) -> bool:
        return bool(self.session) and lease_rules.may_send(self.clock(), self.until)

    @property
    def left_s(self) -> float:
        """Return for how long (s) it may still send; negative: since when it may not."""
        return (self.until - self.clock()) / SECOND

    @property
    def best(self) -> int:
        """Return the path that was renewed last: what is asked there is newest."""
        return max(range(len(self.held)), key=lambda path: held.sent if (held := self.held[path]) else 0)

    @property
    def is_over(self) -> bool:
        """Say whether too few paths are left to this session, ever."""
        return sum(path is not None for path in self.held) < self.terms.needed

    @property
    def is_weak(self) -> bool:
        """Say whether others have ended one of its paths for good: one more, and it is over."""
        return bool(self.session and self._ended)

    async def could_be_whole(self) -> bool:
        """Say whether all paths answer, so that a session that began now would have each of them."""
        records = await asyncio.gather(*(self._read(path) for path in range(len(self._buckets))))
        return None not in records

    # ---- a session begins ----

    async def begin(self) -> None:
        """Begin a session, as soon as every one before it is over."""
        told = ""
        while not await self.try_to_begin():
            if self.trouble != told:
                _log.warning("%s does not poll: %s", self.name, self.trouble)
            told = self.trouble
            await asyncio.sleep(JOIN_S)

    async def try_to_begin(self) -> bool:
        """Take the records that may be taken. Return False where it must be tried again."""
        paths = range(len(self._buckets))
        records = await asyncio.gather(*(self._read(path) for path in paths))
        known = {path: record for path, record in enumerate(records) if record is not None}
        if len(known) < self.terms.needed:
            self.trouble = (
                f"{len(known)} of {len(paths)} lease buckets answer, {self.terms.needed} are needed"
            )
            return False
        free = {path: record for path, record in known.items() if self._is_free(path, record)}
        if len(free) < self.terms.needed:
            self.trouble = self._rival(known)
            return False
        session = 1 + max(self._newest, *(map(_least_session, known.values())))
        self._nonce, self._ended = uuid.uuid4().hex, set()
        self.session = self._newest = session
        self.began_ms = time.time_ns() // 1_000_000
        await asyncio.gather(*(self._take(path, record) for path, record in free.items()))
        if self.is_over:
            await self.end()
            self.trouble = f"another gateway called {self.name} began at the same time"
            return False
        self.trouble = ""
        self._extend()
        return True

    async def _read(self, path: int) -> Record | None:
        try:
            return await self._buckets[path].get(self.name)
        except FleetError:
            return None

    def _is_free(self, path: int, record: Record) -> bool:
        """Say whether the session in this record is over, or its end may be written at this revision."""
        value = record.value
        if record.revision == NONE_YET or (value and value["ended"] and "by" not in value):
            return True
        if value and self._lock is not None and self._lock.proves_death(value):
            return True
        now = self.clock()
        watched = self._watched[path] = lease_rules.watch(self._watched[path], record.revision, now)
        return lease_rules.is_stale(watched, now, self.terms)

    def _rival(self, known: Mapping[int, Record]) -> str:
        others = [record.value for record in known.values() if record.value]
        host = others[0].get("host", "?") if others else "?"
        return f"a gateway called {self.name} is registered on {host}; waiting until its lease has run out"

    async def _take(self, path: int, record: Record) -> None:
        sent, nonce = self.clock(), self._nonce
        try:
            revision = await self._buckets[path].put(self.name, self._value(), record.revision)
        except (Conflict, FleetError):
            return
        if nonce == self._nonce:  # else the answer is to a session before
            self.held[path] = Held(revision, sent)

    def _value(self, *, ended: bool = False) -> dict[str, Any]:
        return {
            **self._note(),
            "rules": lease_rules.RULES,
            "session": self.session,
            "nonce": self._nonce,
            "ended": ended,
            "began": self.began_ms,
            "host": os.uname().nodename,
            "machine": file_lock.machine_id(),
            "lock": str(self._lock.path) if self._lock else "",
            "lock_id": self._lock.id if self._lock else "",
            "pid": os.getpid(),
        }

    # ---- and goes on ----

    async def renew(self, path: int) -> None:
        """Renew one path, for ever; one task for each, so that none waits for another.

        What failed is tried again soon: a bucket may get a leader at any moment, and two of them may be all
        that the lines wait for.
        """
        while True:
            begun, before = self.clock(), self.held[path]
            if self.session:
                await self.renew_once(path)
            has_failed = self.session and self.held[path] is before
            rest = 0 if has_failed else RENEW_S - (self.clock() - begun) / SECOND
            await asyncio.sleep(max(rest, AGAIN_S))

    async def renew_once(self, path: int) -> None:
        """Renew one path. What is counted is the moment before the request was sent."""
        held, nonce, sent = self.held[path], self._nonce, self.clock()
        if held is None:
            if path not in self._ended:
                await self._take_late(path)
            return
        try:
            revision = await self._buckets[path].put(self.name, self._value(), held.revision)
        except Conflict:
            await self._look_again(path, nonce, held)
        except FleetError as failure:
            if isinstance(failure, Unsure):
                await self._look_again(path, nonce, held)
        else:
            if nonce == self._nonce:  # else the answer is to a session before
                self.held[path] = Held(revision, sent)
                self._extend()

    async def _look_again(self, path: int, nonce: str, held: Held) -> None:
        """Learn what became of a renewal: it may have been stored without our knowing."""
        record = await self._read(path)
        if record is None or nonce != self._nonce:
            return
        value = record.value
        if value and value["nonce"] == nonce and not value["ended"]:
            self.held[path] = Held(record.revision, held.sent)  # an older time than it could be
        elif record.revision > held.revision:
            self._lose(path)

    def _lose(self, path: int) -> None:
        self.held[path] = None
        self._ended.add(path)
        _log.warning("%s: path %d of session %d was ended by another", self.name, path, self.session)

    async def _take_late(self, path: int) -> None:
        """Take a path that could not be had when the session began.

        What stands there is over by the other paths, once we hold them. While we only try to, another gateway
        of this name may live by it.
        """
        nonce = self._nonce
        record = await self._read(path)
        if record is None or nonce != self._nonce or self.is_over:
            return
        value = record.value
        if value is None or (value["session"] <= self.session and value["nonce"] != nonce):
            await self._take(path, record)
            self._extend()
        elif value["nonce"] == nonce and not value["ended"]:
            self.held[path] = Held(record.revision, 0)
        else:
            self._lose(path)

    def _extend(self) -> None:
        until = lease_rules.deadline([held.sent if held else None for held in self.held], self.terms)
        if until > self.until and lease_rules.may_send(self.clock(), until):
            with suppress(ValueError):  # we stood still since that look at the clock
                self._mastership.extend(until)
                self.until = until

    # ---- and ends ----

    async def end(self) -> None:
        """Write the end of this session, so that nobody has to wait for it; nothing may be sent any more."""
        self._mastership.end()
        self.until = 0
        held, value = self.held, self._value(ended=True)
        self.session, self.held, self._ended = 0, [None] * len(held), set()
        self._nonce = ""  # answers to renewals that are under way are not counted
        self._watched = [None] * len(held)

        async def write(path: int, revision: int) -> None:
            with suppress(Conflict, FleetError):
                await put_end(self._buckets[path], Record(self.name, revision, value))

        await asyncio.gather(*(write(path, mine.revision) for path, mine in enumerate(held) if mine))


def _least_session(record: Record) -> int:
    """Return a number that no session before was above, also where somebody has written nonsense."""
    return int(record.value["session"]) if record.value else record.revision


async def put_end(bucket: Bucket, end: Record) -> None:
    """Replace our own record by this end of its session. Raises Conflict and FleetError as `put` does.

    A renewal whose answer nobody waited for any more may have been stored meanwhile. It is replaced too.
    """
    try:
        await bucket.put(end.key, end.value, end.revision)
    except Conflict:
        newest = await bucket.get(end.key)
        if not newest.value or newest.value["ended"] or newest.value["nonce"] != end.value["nonce"]:
            raise
        await bucket.put(end.key, end.value, newest.revision)
