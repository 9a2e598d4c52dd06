"""Observer: watches the sessions of all gateways, and ends the sessions that are no longer renewed.

If a gateway has ended its own session, this process treats the session as over immediately. If another
gateway has ended it, this process first waits until, by its own clock, the last renewal that it has read is
older than a lease. So neither a hasty gateway nor a wrong clock can create a second master. A malicious
gateway could create one in one case: a session is renewed after a long silence, and the malicious end is
stored before this process has read that renewal.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any

from multidrop.fleet.errors import Conflict, FleetError
from multidrop.fleet.lines import rules as lease_rules
from multidrop.fleet.lines.lease import boottime_ns
from multidrop.fleet.lines.rules import SeenRevision, Terms
from multidrop.fleet.servers.buckets import Bucket, Follower, Record
from multidrop.supervisor import end_tasks

# lease terms for viewers: they treat a session as over as soon as any gateway has ended it
BELIEVING = lease_rules.USUAL._replace(lease=0, guard=0)

LOOK_S = 0.1  # pause between two reads of a lease bucket; it delays a takeover by at most this time
# How long to wait for the servers' answers when this process ends another session. If a server stores the
# end later, the next read shows it.
ENDING_S = 0.1

_log = logging.getLogger("multidrop.fleet")


class Observer:
    """The lease records of all gateways in three buckets, and when this process saw each record change."""

    def __init__(
        self, me: str, buckets: Sequence[Bucket], terms: Terms, clock: Callable[[], int] = boottime_ns
    ) -> None:
        self.me = me
        self.terms = terms
        self.paths = [Follower(bucket) for bucket in buckets]
        self.ended = 0  # number of sessions that this process ended
        self._watched: list[dict[str, SeenRevision]] = [{} for _ in buckets]
        self._looked = [0] * len(self.paths)  # when the newest answered read of each bucket started (ns)
        # number of the newest session that is known to be over, by gateway
        self._over: dict[str, int] = {}
        self._clock = clock

    def restart_waits(self) -> None:
        """Restart the waiting times for all lease records, because this gateway may have missed renewals.

        A session that is already over stays over, because it cannot be renewed.
        """
        now = self._clock()
        for seen in self._watched:
            seen.update({name: one._replace(since=now) for name, one in seen.items()})

    async def look(self, path: int) -> bool:
        """Read the changes in one lease bucket; return True if a session has ended or has expired.

        An expired session ends when a gateway marks its records as ended. Raises FleetError if no server can
        be reached over this connection.
        """
        begun = self._clock()
        found = await self.paths[path].look()
        for record in found:
            self._note(path, record)
        self._looked[path] = begun
        return any(record.value and record.value["ended"] for record in found) or bool(self.dead())

    async def rest(self, path: int) -> None:
        """Wait until the next read is due, or until a lease record may have expired."""
        begins = self._clock() - self.terms.lease
        due = ((one.since - begins) / lease_rules.SECOND for one in self._watched[path].values())
        await asyncio.sleep(min([LOOK_S, *(left for left in due if left > 0)]))

    def _note(self, path: int, record: Record) -> None:
        watched = self._watched[path]
        before = watched.get(record.key)
        # a record that another gateway marked as ended is not a renewal: keep the time of the last renewal
        if before is not None and is_ended_by_another(record):
            watched[record.key] = before._replace(revision=record.revision)
        else:
            watched[record.key] = lease_rules.watch(before, record.revision, self._clock())

    def records(self, gateway: str) -> list[Record | None]:
        return [follower.records.get(gateway) for follower in self.paths]

    def is_over(self, gateway: str, session: int) -> bool:
        """Return True if this session is over because enough of its lease records were ended."""
        if session <= self._over.get(gateway, 0):
            return True
        now = self._clock()
        ended = [self._has_ended(path, record, session, now) for path, record in self._of(gateway)]
        return lease_rules.is_over(sum(ended), self.terms)

    def sessions(self) -> dict[str, dict[str, Any]]:
        """Return the newest lease record of each gateway whose session is not over."""
        found = {}
        now = self._clock()
        for name in sorted({name for follower in self.paths for name in follower.records}):
            records = self._of(name)
            session = max((record.value["session"] for _, record in records), default=0)
            present = [
                record.value
                for path, record in records
                if record.value["session"] == session and not self._has_ended(path, record, session, now)
            ]
            if len(present) >= self.terms.needed and not self.is_over(name, session):
                found[name] = present[0]
        return found

    def missing(self) -> dict[str, dict[str, Any]]:
        """Return the gateways that other gateways have declared dead, with their lease records.

        A gateway that has ended its own session is not among them.
        """
        present = self.sessions()
        found = {}
        for name in sorted({name for follower in self.paths for name in follower.records} - present.keys()):
            newest = max((record.value["session"] for _, record in self._of(name)), default=0)
            of_it = [record for _, record in self._of(name) if record.value["session"] == newest]
            by_others = [record for record in of_it if is_ended_by_another(record)]
            has_left = any(record.value["ended"] for record in of_it if record not in by_others)
            if by_others and not has_left:
                found[name] = by_others[0].value
        return found

    def weak(self) -> list[str]:
        """Return the gateways that have only two valid lease records, because others have ended the third."""
        return [
            name
            for name, value in self.sessions().items()
            if any(
                is_ended_by_another(record) and record.value["session"] == value["session"]
                for _, record in self._of(name)
            )
        ]

    def _of(self, gateway: str) -> list[tuple[int, Record]]:
        records = enumerate(self.records(gateway))
        return [(path, record) for path, record in records if record and record.value is not None]

    def _has_ended(self, path: int, record: Record, session: int, now: int) -> bool:
        value = record.value
        if value["session"] < session or (value["session"] == session and not value["ended"]):
            return False
        return not is_ended_by_another(record) or self._is_stale(path, record, now)

    def unseen_s(self, gateway: str) -> float:
        """Return the age in s of the gateway's lease: the time since two of its records were seen renewed."""
        seen = [watched[gateway].since for watched in self._watched if gateway in watched]
        latest = sorted(seen, reverse=True)[: self.terms.needed]
        return (self._clock() - latest[-1]) / lease_rules.SECOND if latest else 0.0

    # ---- dead gateways ----

    def dead(self, present: Iterable[str] | None = None) -> dict[str, dict[int, Record]]:
        """Return the gateways whose sessions this process may end, each with its expired records by bucket.

        A record has expired if no renewal was seen for the duration of a lease. That time must have passed
        before the newest answered read of its bucket was started, since renewals after it were not seen.
        `present` are the names in `sessions`, if the caller already has them.
        """
        found = {}
        for name in self.sessions() if present is None else present:
            if name == self.me:
                continue
            stale = {
                path: record
                for path, record in enumerate(self.records(name))
                if record
                and record.value
                and not record.value["ended"]
                and self._is_stale(path, record, self._looked[path])
            }
            if lease_rules.is_over(len(stale), self.terms):  # enough records to end the session
                found[name] = stale
        return found

    def _is_stale(self, path: int, record: Record, now: int) -> bool:
        watched = self._watched[path].get(record.key)
        return (
            watched is not None
            and watched.revision == record.revision
            and lease_rules.is_stale(watched, now, self.terms)
        )

    async def end_the_dead(self, present: Iterable[str] | None = None) -> bool:
        """End the sessions that are no longer renewed; return True if one was ended.

        A record is replaced only if it still has the revision that has expired.
        """
        before = self.ended
        self._remember_ended_sessions()
        for name, records in self.dead(present).items():
            session = max(record.value["session"] for record in records.values())
            if await self._end_enough(records):
                self.ended += 1
                _log.warning("the lease of %s (session %d) expired; %s ended it", name, session, self.me)
        return self.ended > before

    def _remember_ended_sessions(self) -> None:
        """Remember the sessions that are over, so that `restart_waits` does not make them alive again."""
        for name in {name for follower in self.paths for name in follower.records}:
            session = max((record.value["session"] for _, record in self._of(name)), default=0)
            if self.is_over(name, session):
                self._over[name] = max(session, self._over.get(name, 0))

    async def _end_enough(self, records: Mapping[int, Record]) -> bool:
        """End these lease records concurrently; return True if this call has ended one.

        A session is over once two of its three records are ended. So wait for two answers, not for the third:
        a bucket without a leader never answers.
        """
        ends = [asyncio.create_task(self._end(path, record)) for path, record in records.items()]
        answers: list[bool] = []
        try:
            for done in asyncio.as_completed(ends, timeout=ENDING_S):
                with suppress(FleetError):
                    answers.append(await done)
                if len(answers) >= self.terms.ended:
                    break
        except TimeoutError:
            pass  # the next step of the gateway decides again, with newer records
        finally:  # a cancelled request may still be stored; the next read shows whether it was
            await end_tasks(*ends)
        return any(answers)

    async def _end(self, path: int, record: Record) -> bool:
        """End a lease record; return False if it has changed since it was read.

        Raises FleetError if the outcome is unknown.
        """
        value = {**record.value, "ended": True, "by": self.me}
        try:
            revision = await self.paths[path].bucket.put(record.key, value, record.revision)
        except Conflict:
            return False
        ended = Record(record.key, revision, value)
        self.paths[path].take(ended)
        self._note(path, ended)
        return True


def is_ended_by_another(record: Record) -> bool:
    """Return True if this lease record ends a session, and was written by another gateway."""
    return bool(record.value and record.value["ended"] and record.value.get("by", record.key) != record.key)
