"""Lease: a gateway's own session, which is renewed on three paths, and the deadline for sending.

LifeLock lets a gateway prove that the earlier process which used its folder is dead.
"""

from __future__ import annotations

import asyncio
import logging
import os
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from multidrop.core import Mastership
from multidrop.fleet.errors import Conflict, FleetError, OutcomeUnknown
from multidrop.fleet.leases import rules as lease_rules
from multidrop.fleet.leases.rules import RENEW_S, SECOND, SeenRevision, Terms
from multidrop.fleet.servers.buckets import NONE_YET, Bucket, Record
from multidrop.recording import FileLock

_log = logging.getLogger("multidrop.fleet")

JOIN_S = 0.25  # pause between attempts to start a session
AGAIN_S = 0.1  # pause before a failed renewal is repeated
IDS = (Path("/etc/machine-id"), Path("/proc/sys/kernel/random/boot_id"))


def boottime_ns() -> int:
    """Return CLOCK_BOOTTIME in ns: this clock also runs while the computer sleeps, and cannot be set."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


class HeldRecord(NamedTuple):
    """Our lease record on one path."""

    revision: int
    sent: int  # when its renewal was sent (CLOCK_BOOTTIME, ns)


class Lease:
    """The lease of one gateway: a session, recorded on three paths.

    `until` is the deadline for sending (CLOCK_BOOTTIME, ns). `note` returns further fields of the record, for
    other gateways and for display.
    """

    def __init__(
        self,
        name: str,
        buckets: Sequence[Bucket],
        mastership: Mastership,
        *,
        lock: LifeLock | None = None,
        terms: Terms = lease_rules.USUAL,
        clock: Callable[[], int] = boottime_ns,
        note: Callable[[], Mapping[str, Any]] = dict,
    ) -> None:
        self.name = name
        self.terms = terms
        self.session = 0  # number of the present session; 0 between sessions
        self.until = 0
        self.trouble = ""  # why the session cannot start
        self.began_ms = 0  # start of the session, UTC in ms
        self.held: list[HeldRecord | None] = [None] * len(buckets)
        self._buckets = buckets
        self._mastership = mastership
        self._lock = lock
        self.clock = clock
        self._note = note
        self._nonce = uuid.uuid4().hex
        self._watched: list[SeenRevision | None] = [None] * len(buckets)
        self._newest = 0  # newest session number of this process; later sessions get higher numbers
        self._ended: set[int] = set()  # paths on which other gateways have ended this session's record

    # ---- state ----

    @property
    def is_valid(self) -> bool:
        return bool(self.session) and lease_rules.may_send(self.clock(), self.until)

    @property
    def left_s(self) -> float:
        """Return how many seconds this gateway may still send; negative after the deadline."""
        return (self.until - self.clock()) / SECOND

    @property
    def best(self) -> int:
        """Return the path of the newest renewal, because that path's server has the newest records."""
        return max(range(len(self.held)), key=lambda path: held.sent if (held := self.held[path]) else 0)

    @property
    def is_over(self) -> bool:
        """Return True if the session cannot be renewed, because we hold too few of its records."""
        return sum(path is not None for path in self.held) < self.terms.needed

    @property
    def is_weak(self) -> bool:
        """Return True if other gateways have ended one of our three records: one more ends the session."""
        return bool(self.session and self._ended)

    async def could_be_whole(self) -> bool:
        """Return True if all paths answer, so that a new session would hold all three records."""
        records = await asyncio.gather(*(self._read(path) for path in range(len(self._buckets))))
        return None not in records

    # ---- start ----

    async def begin(self) -> None:
        """Start a session as soon as all earlier sessions of this gateway are over."""
        reported = ""
        while not await self.try_to_begin():
            if self.trouble != reported:
                _log.warning("%s polls no lines yet: %s", self.name, self.trouble)
            reported = self.trouble
            await asyncio.sleep(JOIN_S)

    async def try_to_begin(self) -> bool:
        """Start a session by taking the free records. Return False if too few are free; call again later."""
        paths = range(len(self._buckets))
        records = await asyncio.gather(*(self._read(path) for path in paths))
        known = {path: record for path, record in enumerate(records) if record is not None}
        if len(known) < self.terms.needed:
            self.trouble = (
                f"{len(known)} of {len(paths)} lease records can be read, {self.terms.needed} are needed"
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
            self.trouble = f"another gateway called {self.name} started at the same time"
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
        """Return True if the record's session was ended, its process died, or the record is stale."""
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
        return f"a gateway called {self.name} runs on {host}; waiting until its lease expires"

    async def _take(self, path: int, record: Record) -> None:
        sent, nonce = self.clock(), self._nonce
        try:
            revision = await self._buckets[path].put(self.name, self._value(), record.revision)
        except (Conflict, FleetError):
            return
        if nonce == self._nonce:  # otherwise the answer belongs to an earlier session
            self.held[path] = HeldRecord(revision, sent)

    def _value(self, *, ended: bool = False) -> dict[str, Any]:
        return {
            **self._note(),
            "rules": lease_rules.RULES,
            "session": self.session,
            "nonce": self._nonce,
            "ended": ended,
            "began": self.began_ms,
            "host": os.uname().nodename,
            "machine": machine_id(),
            "lock": str(self._lock.path) if self._lock else "",
            "lock_id": self._lock.id if self._lock else "",
            "pid": os.getpid(),
        }

    # ---- renewal ----

    async def renew(self, path: int) -> None:
        """Renew the record on one path forever. Each path has its own task, so no path waits for another.

        A failed renewal is repeated soon, because the bucket may get a leader at any moment. Renewals on two
        paths are enough to poll.
        """
        while True:
            begun, before = self.clock(), self.held[path]
            if self.session:
                await self.renew_once(path)
            has_failed = self.session and self.held[path] is before
            rest = 0 if has_failed else RENEW_S - (self.clock() - begun) / SECOND
            await asyncio.sleep(max(rest, AGAIN_S))

    async def renew_once(self, path: int) -> None:
        held, nonce, sent = self.held[path], self._nonce, self.clock()
        if held is None:
            if path not in self._ended:
                await self._take_late(path)
            return
        try:
            revision = await self._buckets[path].put(self.name, self._value(), held.revision)
        except (Conflict, OutcomeUnknown):
            await self._look_again(path, nonce, held)
        except FleetError:
            pass  # not delivered, or not permitted
        else:
            if nonce == self._nonce:  # otherwise the answer belongs to an earlier session
                self.held[path] = HeldRecord(revision, sent)
                self._extend()

    async def _look_again(self, path: int, nonce: str, held: HeldRecord) -> None:
        """Read the record again after a renewal that failed, or whose outcome is unknown."""
        record = await self._read(path)
        if record is None or nonce != self._nonce:
            return
        value = record.value
        if value and value["nonce"] == nonce and not value["ended"]:
            # This renewal or an earlier one stored the record. The earlier one's time is safe in both cases.
            self.held[path] = HeldRecord(record.revision, held.sent)
        elif record.revision > held.revision:
            self._lose(path)

    def _lose(self, path: int) -> None:
        self.held[path] = None
        self._ended.add(path)
        _log.warning(
            "%s: another gateway ended lease record %d of 3 (session %d)", self.name, path + 1, self.session
        )

    async def _take_late(self, path: int) -> None:
        """Take the record on a path that was not available when the session started.

        That record's session ended when we took its records on the other paths. While we hold too few
        records, another gateway of this name may still need this one.
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
            self.held[path] = HeldRecord(record.revision, 0)
        else:
            self._lose(path)

    def _extend(self) -> None:
        until = lease_rules.deadline([held.sent if held else None for held in self.held], self.terms)
        if until > self.until and lease_rules.may_send(self.clock(), until):
            with suppress(ValueError):  # raised if this process was suspended after the clock was read
                self._mastership.extend(until)
                self.until = until

    # ---- end ----

    async def end(self) -> None:
        """Stop sending, and mark this session's records as ended, so that other gateways need not wait."""
        self._mastership.end()
        self.until = 0
        held, value = self.held, self._value(ended=True)
        self.session, self.held, self._ended = 0, [None] * len(held), set()
        self._nonce = ""  # ignore answers to renewals in flight
        self._watched = [None] * len(held)

        async def write(path: int, revision: int) -> None:
            with suppress(Conflict, FleetError):
                await put_end(self._buckets[path], Record(self.name, revision, value))

        await asyncio.gather(*(write(path, mine.revision) for path, mine in enumerate(held) if mine))


def _least_session(record: Record) -> int:
    """Return the session in a record; for an invalid record its revision, which is at least as high."""
    return int(record.value["session"]) if record.value else record.revision


async def put_end(bucket: Bucket, end: Record) -> None:
    """Replace our own record by `end`, which marks our session as ended. Raises the errors of `Bucket.put`.

    If a cancelled renewal was stored in the meantime, replace that record too.
    """
    try:
        await bucket.put(end.key, end.value, end.revision)
    except Conflict:
        newest = await bucket.get(end.key)
        if not newest.value or newest.value["ended"] or newest.value["nonce"] != end.value["nonce"]:
            raise
        await bucket.put(end.key, end.value, newest.revision)


class LifeLock:
    """A lock on a local file, held until the process ends: its next holder knows that this process is dead.

    The file holds a random id, because containers may share the machine id and the path. Raises FleetError if
    another process of this computer holds the lock.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.resolve()
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            self._lock = FileLock(path)
        except BlockingIOError:
            sentence = f"another gateway of this machine uses {path}; stop that one first"
            raise FleetError(sentence) from None
        self.id = path.read_text("ascii", "replace").strip()
        if not self.id:
            self.id = uuid.uuid4().hex
            with path.open("w", encoding="ascii") as file:
                file.write(self.id)
                file.flush()
                os.fsync(file.fileno())

    def proves_death(self, value: Mapping[str, Any]) -> bool:
        """Return True if the process that wrote this record is dead: it held the lock that we hold now."""
        mine = (str(self.path), self.id, machine_id())
        return "" not in mine and (value.get("lock"), value.get("lock_id"), value.get("machine")) == mine

    def close(self) -> None:
        self._lock.close()


def machine_id() -> str:
    """Return an id of this computer's present boot; "" if unknown: then no process can be proved to be dead.

    Computers with copies of one disk have the same machine id and lock file, but different boot ids.
    """
    with suppress(OSError):
        ids = [path.read_text("utf-8", "replace").strip() for path in IDS]
        return ".".join(ids) if all(ids) else ""
    return ""
