"""Observer: watches the sessions of all gateways, and ends those that nobody renews."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

from multidrop.fleet import lease_rules
from multidrop.fleet.buckets import Bucket, Follower, Record
from multidrop.fleet.errors import Conflict, FleetError
from multidrop.fleet.lease import boottime_ns
from multidrop.fleet.lease_rules import SeenRevision, Terms

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
        self._clock = clock

    def begin_anew(self) -> None:
        """Count from now on: whoever was cut off itself knows nothing of the others meanwhile."""
        now = self._clock()
        for seen in self._watched:
            seen.update({name: one._replace(since=now) for name, one in seen.items()})

    async def look(self, path: int) -> None:
        """Read what changed on a path. Raises FleetError where it is not reached."""
        for record in await self.paths[path].look():
            self._note(path, record)

    def _note(self, path: int, record: Record) -> None:
        watched = self._watched[path]
        watched[record.key] = lease_rules.watch(watched.get(record.key), record.revision, self._clock())

    def records(self, gateway: str) -> list[Record | None]:
        return [follower.records.get(gateway) for follower in self.paths]

    def is_over(self, gateway: str, session: int) -> bool:
        """Say whether this session was ended on as many paths as it takes."""
        return lease_rules.is_over(
            sum(_has_ended(record, session) for record in self.records(gateway)), self.terms
        )

    def sessions(self) -> dict[str, dict[str, Any]]:
        """Return each gateway that has a session that is not over, with its newest record."""
        names = {name for follower in self.paths for name in follower.records}
        found = {}
        for name in sorted(names):
            values = [record.value for record in self.records(name) if record and record.value]
            session = max((value["session"] for value in values), default=0)
            present = [value for value in values if value["session"] == session and not value["ended"]]
            if len(present) >= self.terms.needed and not self.is_over(name, session):
                found[name] = present[0]
        return found

    # ---- dead gateways ----

    def dead(self) -> dict[str, dict[int, Record]]:
        """Return who may be ended, with the very records that were watched for so long, by path."""
        now = self._clock()
        found = {}
        for name in self.sessions():
            if name == self.me:
                continue
            stale = {
                path: record
                for path, record in enumerate(self.records(name))
                if record and record.value and not record.value["ended"] and self._is_stale(path, record, now)
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

    async def end_the_dead(self) -> None:
        """End the sessions that nobody renews: each record at the revision that was judged, or not at all."""
        for name, records in self.dead().items():
            session = max(record.value["session"] for record in records.values())
            done = await asyncio.gather(*(self._end(path, record) for path, record in records.items()))
            if any(done):
                self.ended += 1
                _log.warning("session %d of %s has run out; ended by %s", session, name, self.me)

    async def _end(self, path: int, record: Record) -> bool:
        value = {**record.value, "ended": True, "by": self.me}
        with suppress(Conflict, FleetError):
            revision = await self.paths[path].bucket.put(record.key, value, record.revision)
            ended = Record(record.key, revision, value)
            self.paths[path].take(ended)
            self._note(path, ended)
            return True
        return False


def _has_ended(record: Record | None, session: int) -> bool:
    if record is None or record.value is None:
        return False
    found = record.value["session"]
    return bool(found > session or (found == session and record.value["ended"]))
