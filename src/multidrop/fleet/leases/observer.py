"""Observer: watches the sessions of all gateways, and ends those that nobody renews.

An end that a gateway wrote of its own session counts at once. One that another gateway wrote counts when the
last renewal that we read is a lease old by our own clock too: nobody's haste or wrong clock makes a second
master. Malice could, by an end right behind a renewal that followed a long silence and that we never read.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any

from multidrop.fleet.errors import Conflict, FleetError
from multidrop.fleet.leases import rules as lease_rules
from multidrop.fleet.leases.lease import boottime_ns
from multidrop.fleet.leases.rules import SeenRevision, Terms
from multidrop.fleet.servers.buckets import Bucket, Follower, Record
from multidrop.supervisor import end_tasks

BELIEVING = lease_rules.USUAL._replace(lease=0, guard=0)  # for who only looks: every end counts at once

LOOK_S = 0.1  # between looks at a path: the silence of a dead gateway's lines is longer by it
ENDING_S = 0.1  # for the answers, when a session is ended; later ones are read

_log = logging.getLogger("multidrop.fleet")


class Observer:
    """The lease records on all paths, as this machine saw them change."""

    def __init__(
        self, me: str, buckets: Sequence[Bucket], terms: Terms, clock: Callable[[], int] = boottime_ns
    ) -> None:
        self.me = me
        self.terms = terms
        self.paths = [Follower(bucket) for bucket in buckets]
        self.ended = 0  # sessions that this one ended
        self._watched: list[dict[str, SeenRevision]] = [{} for _ in buckets]
        self._looked = [0] * len(self.paths)  # when the newest look that had an answer began
        self._over: dict[str, int] = {}  # each gateway's newest session that is over for certain
        self._clock = clock

    def begin_anew(self) -> None:
        """Count from now on: while we were cut off we saw nothing of the others.

        What was over before that stays over: nobody renews it.
        """
        now = self._clock()
        for seen in self._watched:
            seen.update({name: one._replace(since=now) for name, one in seen.items()})

    async def look(self, path: int) -> bool:
        """Read what changed on a path. Raises FleetError where it is not reached.

        Return True where a session has ended, or may be ended now.
        """
        begun = self._clock()
        found = await self.paths[path].look()
        for record in found:
            self._note(path, record)
        self._looked[path] = begun
        return any(record.value and record.value["ended"] for record in found) or bool(self.dead())

    async def rest(self, path: int) -> None:
        """Wait until the next look: until a record may be stale, if that comes first."""
        begins = self._clock() - self.terms.lease
        due = ((one.since - begins) / lease_rules.SECOND for one in self._watched[path].values())
        await asyncio.sleep(min([LOOK_S, *(left for left in due if left > 0)]))

    def _note(self, path: int, record: Record) -> None:
        watched = self._watched[path]
        before = watched.get(record.key)
        if before is not None and is_ended_by_another(record):  # it was not renewed: its time runs on
            watched[record.key] = before._replace(revision=record.revision)
        else:
            watched[record.key] = lease_rules.watch(before, record.revision, self._clock())

    def records(self, gateway: str) -> list[Record | None]:
        return [follower.records.get(gateway) for follower in self.paths]

    def is_over(self, gateway: str, session: int) -> bool:
        """Say whether this session was ended on as many paths as it takes."""
        if session <= self._over.get(gateway, 0):
            return True
        now = self._clock()
        ended = [self._has_ended(path, record, session, now) for path, record in self._of(gateway)]
        return lease_rules.is_over(sum(ended), self.terms)

    def sessions(self) -> dict[str, dict[str, Any]]:
        """Return each gateway that has a session that is not over, with its newest record."""
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
        """Return each gateway whose newest session others have ended, with its record: it did not leave."""
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
        """Return the gateways whose session others have ended on a path, and which go on by the rest."""
        return [
            name
            for name, value in self.sessions().items()
            if any(
                is_ended_by_another(record) and record.value["session"] == value["session"]
                for _, record in self._of(name)
            )
        ]

    def _of(self, gateway: str) -> list[tuple[int, Record]]:
        """Return the records of a gateway, with their paths, but for those that are removed or strange."""
        records = enumerate(self.records(gateway))
        return [(path, record) for path, record in records if record and record.value is not None]

    def _has_ended(self, path: int, record: Record, session: int, now: int) -> bool:
        value = record.value
        if value["session"] < session or (value["session"] == session and not value["ended"]):
            return False
        return not is_ended_by_another(record) or self._is_stale(path, record, now)

    def unseen_s(self, gateway: str) -> float:
        """Return for how long (s) no renewal was seen on two of the paths, as many as must be renewed."""
        seen = [watched[gateway].since for watched in self._watched if gateway in watched]
        latest = sorted(seen, reverse=True)[: self.terms.needed]
        return (self._clock() - latest[-1]) / lease_rules.SECOND if latest else 0.0

    # ---- dead gateways ----

    def dead(self, present: Iterable[str] | None = None) -> dict[str, dict[int, Record]]:
        """Return who may be ended, with the very records that were watched for so long, by path.

        What was not looked at since may have been renewed: a server that stands still answers nobody.
        `present` are the names in `sessions`, where the caller has just asked for them.
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
            if lease_rules.is_over(len(stale), self.terms):  # fewer: it lives, and would only be weakened
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
        """End the sessions that nobody renews: each record at the revision that was judged, or not at all.

        Return True where one was ended.
        """
        before = self.ended
        self._keep_what_is_over()
        for name, records in self.dead(present).items():
            session = max(record.value["session"] for record in records.values())
            if await self._end_enough(records):
                self.ended += 1
                _log.warning("session %d of %s has run out; ended by %s", session, name, self.me)
        return self.ended > before

    def _keep_what_is_over(self) -> None:
        """Keep which sessions are over, as they were judged without a gap in what we saw."""
        for name in {name for follower in self.paths for name in follower.records}:
            session = max((record.value["session"] for _, record in self._of(name)), default=0)
            if self.is_over(name, session):
                self._over[name] = max(session, self._over.get(name, 0))

    async def _end_enough(self, records: Mapping[int, Record]) -> bool:
        """End them all at once, and wait for as many answers as it takes: a path may have no leader.

        Return True where any has ended. Another gateway may have ended the others: the next look tells.
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
            pass  # the others are judged anew, with what was seen meanwhile
        finally:
            await end_tasks(*ends)  # what was sent may still be stored, and is read then
        return any(answers)

    async def _end(self, path: int, record: Record) -> bool:
        """End a record, unless it has changed. Raises FleetError where nobody says whether it was."""
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
    """Say whether somebody else than the gateway itself has written the end of its session."""
    return bool(record.value and record.value["ended"] and record.value.get("by", record.key) != record.key)
