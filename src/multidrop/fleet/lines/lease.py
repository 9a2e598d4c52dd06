"""Lease: a gateway's own session, which it renews on three NATS servers, and its deadline for sending.

LifeLock proves to a gateway that the previous process with the same folder is dead.
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
from multidrop.fleet.lines import rules as lease_rules
from multidrop.fleet.lines.rules import RENEW_S, SECOND, SeenRevision, Terms
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
    """This gateway's lease record in one of the three lease buckets."""

    revision: int
    sent: int  # when the gateway sent the renewal that wrote this revision (CLOCK_BOOTTIME, ns)


class Lease:
    """The lease of one gateway: a session, which is recorded in three lease buckets.

    Each bucket is written over its own server connection. `until` is the deadline for sending on lines
    (CLOCK_BOOTTIME, ns). `note` returns further fields of the record, for other gateways and for display.
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
        self.session = 0  # number of the present session; 0 without a session
        self.until = 0
        self.trouble = ""  # reason why no session can start
        self.began_ms = 0  # start of the session, UTC in ms
        self.held: list[HeldRecord | None] = [None] * len(buckets)
        self._buckets = buckets
        self._mastership = mastership
        self._lock = lock
        self.clock = clock
        self._note = note
        self._nonce = uuid.uuid4().hex
        self._watched: list[SeenRevision | None] = [None] * len(buckets)
        # highest session number that this process has used; later sessions get higher numbers
        self._newest = 0
        # numbers of the lease buckets in which another gateway has ended this session
        self._ended: set[int] = set()

    # ---- state ----

    @property
    def is_valid(self) -> bool:
        return bool(self.session) and lease_rules.may_send(self.clock(), self.until)

    @property
    def left_s(self) -> float:
        """Return for how many more seconds this gateway may send; negative after the deadline."""
        return (self.until - self.clock()) / SECOND

    @property
    def best(self) -> int:
        """Return the number of the connection with the newest renewal: its server has the newest records."""
        return max(range(len(self.held)), key=lambda path: held.sent if (held := self.held[path]) else 0)

    @property
    def is_over(self) -> bool:
        """Return True if too few lease records are left to renew the session."""
        return sum(path is not None for path in self.held) < self.terms.needed

    @property
    def is_weak(self) -> bool:
        """Return True if other gateways have ended one of this session's three lease records.

        If they end one more, the session is over.
        """
        return bool(self.session and self._ended)

    async def could_be_whole(self) -> bool:
        """Return True if all servers answer, so that a new session could write all three lease records."""
        records = await asyncio.gather(*(self._read(path) for path in range(len(self._buckets))))
        return None not in records

    # ---- start ----

    async def begin(self) -> None:
        """Wait until all earlier sessions of this gateway are over, then start a session."""
        reported = ""
        while not await self.try_to_begin():
            if self.trouble != reported:
                _log.warning("%s polls no lines yet: %s", self.name, self.trouble)
            reported = self.trouble
            await asyncio.sleep(JOIN_S)

    async def try_to_begin(self) -> bool:
        """Start a session by writing the free lease records.

        Return False if too few records are free; the caller tries again later.
        """
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
        """Return True if a new session may replace this lease record.

        The record's session was ended, its process has died, or the record was not renewed for the time of a
        lease.
        """
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
        """Renew one of the three lease records forever. There is a task for each record.

        A failed renewal is repeated soon, because the bucket may get a leader at any moment. Two renewed
        records are enough to poll.
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
            pass  # the renewal was not delivered, or not permitted
        else:
            if nonce == self._nonce:  # otherwise the answer belongs to an earlier session
                self.held[path] = HeldRecord(revision, sent)
                self._extend()

    async def _look_again(self, path: int, nonce: str, held: HeldRecord) -> None:
        """Read the lease record again after a renewal that failed, or whose outcome is unknown."""
        record = await self._read(path)
        if record is None or nonce != self._nonce:
            return
        value = record.value
        if value and value["nonce"] == nonce and not value["ended"]:
            # This renewal may be stored or not. So the lease still counts from `held.sent`, the time of the
            # last confirmed renewal: it never becomes too long.
            self.held[path] = HeldRecord(record.revision, held.sent)
        elif record.revision > held.revision:
            self._lose(path)

    def _lose(self, path: int) -> None:
        self.held[path] = None
        self._ended.add(path)
        _log.warning(
            "gateway %s: another gateway ended lease record %d of 3 (session %d)",
            self.name,
            path + 1,
            self.session,
        )

    async def _take_late(self, path: int) -> None:
        """Write the lease record in a bucket that was not available when the session started.

        A record of an earlier session of this gateway is replaced. That session is over, because this session
        has already replaced its other two records. If this session is over itself, write nothing: the record
        may belong to another process of the same name.
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
            with suppress(ValueError):  # raised if this process was suspended after it had read the clock
                self._mastership.extend(until)
                self.until = until

    # ---- end ----

    async def end(self) -> None:
        """Stop sending, and mark this session's records as ended, so that other gateways need not wait."""
        self._mastership.end()
        self.until = 0
        held, value = self.held, self._value(ended=True)
        self.session, self.held, self._ended = 0, [None] * len(held), set()
        self._nonce = ""  # answers to renewals in flight are ignored from now on
        self._watched = [None] * len(held)

        async def write(path: int, revision: int) -> None:
            with suppress(Conflict, FleetError):
                await put_end(self._buckets[path], Record(self.name, revision, value))

        await asyncio.gather(*(write(path, mine.revision) for path, mine in enumerate(held) if mine))


def _least_session(record: Record) -> int:
    """Return the session number in a lease record.

    For an invalid record, return the record's revision, which is at least as high as its session number.
    """
    return int(record.value["session"]) if record.value else record.revision


async def put_end(bucket: Bucket, end: Record) -> None:
    """Replace this gateway's own lease record by `end`, which marks the session as ended.

    If a cancelled renewal was stored in the meantime, replace that record too. Raises the errors of
    `Bucket.put`.
    """
    try:
        await bucket.put(end.key, end.value, end.revision)
    except Conflict:
        newest = await bucket.get(end.key)
        if not newest.value or newest.value["ended"] or newest.value["nonce"] != end.value["nonce"]:
            raise
        await bucket.put(end.key, end.value, newest.revision)


class LifeLock:
    """A lock on a local file, which this process holds until it ends.

    A process that gets the lock knows that the previous holder is dead. The file holds a random id, because
    containers may share the machine id and the path. Raises FleetError if another process of this computer
    holds the lock.
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
        """Return True if the process that wrote this record is dead: this process holds its lock now."""
        mine = (str(self.path), self.id, machine_id())
        return "" not in mine and (value.get("lock"), value.get("lock_id"), value.get("machine")) == mine

    def close(self) -> None:
        self._lock.close()


def machine_id() -> str:
    """Return an id of this computer's present boot; "" if it is unknown.

    Computers with copies of one disk have the same machine id and lock file, but different boot ids.
    """
    with suppress(OSError):
        ids = [path.read_text("utf-8", "replace").strip() for path in IDS]
        return ".".join(ids) if all(ids) else ""
    return ""
