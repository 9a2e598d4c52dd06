"""Lease rules: until when a gateway may send, and when another gateway may end its session. No I/O.

A session has one record in each of three lease buckets. Its holder must renew two of them (`needed`). A
gateway that takes over must end two of them (`ended`). So both must write in at least one common bucket,
whose server accepts only one of the two writes.

The holder's lease starts right before it sends a renewal. An observer starts to wait when it first sees a
revision, by its own clock. After the time of a lease it ends the record only if the record still has that
revision. So clocks of different computers are never compared. An ended record stays ended for its session.

Once a session is over, its lines are claimed and opened immediately. The guard time starts then: before its
first request on a line, the engine only listens for at least this time (csrc/line.c).
tests/fleet/test_ownership_model.py checks all interleavings with these functions.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

SECOND = 1_000_000_000  # one second in ns
RENEW_S = 0.5  # time between renewals of a lease record


class Terms(NamedTuple):
    """The constants of leases, the same for all gateways of a fleet. Times are in ns."""

    lease: int = 2_300_000_000  # duration of a lease after a renewal
    guard: int = 700_000_000  # time from the end of a session to the first request of the line's next master
    needed: int = 2  # number of lease records that the holder must renew
    ended: int = 2  # number of lease records that another gateway must end to take over


USUAL = Terms()


class SeenRevision(NamedTuple):
    """A revision of a lease record, and when this process first saw it."""

    revision: int
    since: int  # by this process's own CLOCK_BOOTTIME, in ns


def deadline(sent: Iterable[int | None], terms: Terms) -> int:
    """Return the deadline for sending (ns); 0 if too few lease records were renewed.

    `sent` has an entry for each record: when its newest acknowledged renewal was sent, or None.
    """
    latest = sorted((moment for moment in sent if moment is not None), reverse=True)
    return latest[terms.needed - 1] + terms.lease if len(latest) >= terms.needed else 0


def may_send(now: int, until: int) -> bool:
    """Return True if the lease's holder may send now.

    The C engine makes the same comparison before each write.
    """
    return now < until


def watch(before: SeenRevision | None, revision: int, now: int) -> SeenRevision:
    """Return the newest observation of a lease record: `before`, unless the revision is new."""
    return before if before is not None and before.revision == revision else SeenRevision(revision, now)


def is_stale(watched: SeenRevision, now: int, terms: Terms) -> bool:
    """Return True if this lease record may be ended: no newer revision was seen for the time of a lease."""
    return now - watched.since >= terms.lease


def is_over(ended: int, terms: Terms) -> bool:
    """Return True if a session is over after this many of its lease records were ended."""
    return ended >= terms.ended
