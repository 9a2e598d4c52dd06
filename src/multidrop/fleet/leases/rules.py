"""The rules of leases: until when a gateway may send, and when another may end its session. Pure.

A session stands in one record on each of three paths. The holder renews all three; whoever takes over ends
them. `needed` and `ended` are more than half of the paths each: the two sets share a path, and its server
decides. The holder counts from the moment before it sent a renewal. An observer counts from the moment at
which it first saw a revision, by its own clock, and ends that very revision after the time of a lease. So no
clocks of two machines are compared. An ended path stays ended for this session, whatever comes.

Once a session is over its lines are claimed and opened at once. The guard begins then: the engine listens for
so long at least before the first request on a line (csrc/line.c).
tests/fleet/test_lease_model.py tries all interleavings with these functions.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

SECOND = 1_000_000_000  # ns
PATHS = 3
RENEW_S = 0.5  # between renewals of a path
RULES = 2  # the number of those by which a line is owned (ownership.py): a change of them counts it up


class Terms(NamedTuple):
    """The terms of a lease; all of a fleet's gateways have the same. Times in ns."""

    lease: int = 2_300_000_000
    guard: int = 700_000_000  # from the end of a session to the first request of the next master
    needed: int = 2  # paths that the holder must have renewed
    ended: int = 2  # paths that a taker must have ended


USUAL = Terms()


class SeenRevision(NamedTuple):
    """A revision of a record, and when this observer saw it first (its own CLOCK_BOOTTIME, ns)."""

    revision: int
    since: int


def deadline(sent: Iterable[int | None], terms: Terms) -> int:
    """Return the time (ns) until which the holder may send; 0 where too few paths are renewed.

    `sent` has a time for each path: right before its newest acknowledged renewal was sent.
    """
    latest = sorted((moment for moment in sent if moment is not None), reverse=True)
    return latest[terms.needed - 1] + terms.lease if len(latest) >= terms.needed else 0


def may_send(now: int, until: int) -> bool:
    """Say whether the holder may send now; the engine looks the same way right before each write."""
    return now < until


def watch(before: SeenRevision | None, revision: int, now: int) -> SeenRevision:
    """Return what is known of a record after it was read."""
    return before if before is not None and before.revision == revision else SeenRevision(revision, now)


def is_stale(watched: SeenRevision, now: int, terms: Terms) -> bool:
    """Say whether this very revision may be ended: it was not renewed for the time of a lease."""
    return now - watched.since >= terms.lease


def is_over(ended: int, terms: Terms) -> bool:
    """Say whether a session with so many ended paths has no master any more."""
    return ended >= terms.ended
