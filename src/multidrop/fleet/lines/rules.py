"""Rules of leases and of ownership. No I/O.

Leases: until when may a gateway send, and when may another gateway end its session?

A session has one record in each of three lease buckets. Its holder must renew two records (`needed`). A
gateway that takes over must end two records (`ended`). So both must write in at least one common bucket,
whose server accepts only one of the two writes.

The holder's lease starts right before it sends a renewal. An observer starts to wait when it first sees a
revision, by its own clock. After the time of a lease it ends the record only if the record still has that
revision. So clocks of different computers are never compared. An ended record stays ended for its session.

Once a session is over, its lines are claimed and opened immediately. The guard time starts then: before its
first request on a line, the engine only listens for at least this time (csrc/line.c).
tests/fleet/test_ownership_model.py checks all interleavings with these functions.

Ownership: which records name a line's master, and when may a gateway write them?

A line has one record in each of three buckets, with one vote each. Its master is the session that at least
two votes name, so no line waits for a bucket without a leader. A record that names a living session is
replaced only by that session, and only at the revision that its gateway has read. So two sessions never have
two votes each.

The very first record of a line has two votes, which shortens the cold start of a large fleet by a second. It
is written in the line's first bucket, where the server accepts only one first record. A gateway that has not
read this record writes nothing in the other buckets.

Records are written only when a line changes its master. A record becomes void when its session is over.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any, NamedTuple

from multidrop.fleet.servers.buckets import NONE_YET, Record

SECOND = 1_000_000_000  # one second in ns
RENEW_S = 0.5  # time between renewals of a lease record
RULES = 2  # version of the rules of ownership below; increment it if those rules change


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


# ---- ownership ----

NOBODY = ""
NEEDED = 2  # number of votes that make a session the master of a line

Owner = tuple[str, int]  # a gateway and its session
# a line's ownership records by bucket, in the order of writing; None: not read yet
LineRecords = Mapping[str, Record | None]


class Claim(NamedTuple):
    """The ownership records that a gateway must write to become the master of a line.

    `first` and `spare` are NATS buckets, each with the revision of the line's record to replace. The records
    in `spare` are written only if a write in `first` gets no answer. Each written record counts as `votes`
    votes for the gateway; a gateway with NEEDED votes is the master.
    """

    first: dict[str, int]
    spare: dict[str, int]
    turn: int
    votes: int = 1


class Step(NamedTuple):
    """The lines that a gateway should claim now, and the lines that it should release now."""

    claims: dict[str, Claim]  # the records to write, by line
    releases: set[str]


def owner_of(record: Record | None) -> Owner:
    """Return the gateway and session that an ownership record names; NOBODY and 0 for a free line."""
    if record is None or not record.value:
        return NOBODY, 0
    return record.value["gateway"], record.value["session"]


def owner_value(owner: Owner, turn: int, now_ms: int, votes: int = 1) -> dict[str, Any]:
    """Return the content of a line's record that names this owner.

    `turn` is the number of claims and releases of the line so far. `turn` and `now_ms` (UTC) are only for
    display.
    """
    return {"gateway": owner[0], "session": owner[1], "votes": votes, "turn": turn, "since": now_ms}


def votes_of(owner: Owner, records: Iterable[Record | None]) -> int:
    return sum(record.value["votes"] for record in records if record and owner_of(record) == owner)


def owner_by(records: LineRecords) -> Record | None:
    """Return the newest ownership record of the owner with enough votes; None without such an owner.

    The owner of a free line is NOBODY.
    """
    known = [record for record in records.values() if record and record.value]
    decided = [record for record in known if votes_of(owner_of(record), known) >= NEEDED]
    return max(decided, key=lambda record: record.value["turn"], default=None)


def turn_of(records: LineRecords) -> int:
    """Return how often the line was claimed or released so far; 0 if it never had a master.

    Each record contains this number as of the time when it was written. The highest one is the newest.
    """
    turn = 0
    for record in records.values():
        if record and record.value and record.value["turn"] > turn:
            turn = record.value["turn"]
    return turn


def claim_of(
    me: Owner,
    records: LineRecords,
    is_over: Callable[[str, int], bool],
    doubted: Collection[str] = (),
    leaderless: Collection[str] = (),
) -> Claim | None:
    """Return the records that this session must write to become the line's master.

    Return None if it is the master already, or cannot become the master now. `doubted` are the buckets in
    which this gateway has released the line without getting an answer. `leaderless` are buckets that may have
    no leader, so the records in them are written last.
    """
    first_bucket, first = next(iter(records.items()), ("", None))
    if not first:
        return None  # this record was not read yet; with two votes in it, another session is the master
    if first.revision == NONE_YET:
        return Claim({first_bucket: NONE_YET}, {}, 1, NEEDED)
    free: dict[str, int] = {}
    needed = NEEDED
    for bucket, record in records.items():
        owner = owner_of(record)
        if owner == me and record and bucket not in doubted:
            needed -= record.value["votes"]
        elif record and (owner == me or owner[0] == NOBODY or is_over(*owner)):
            free[bucket] = record.revision
        elif record and record.value["votes"] >= NEEDED:
            return None  # another living session is the master, with two votes in this record
    if not 0 < needed <= len(free):
        return None
    wanted = {bucket: free[bucket] for bucket in sorted(free, key=leaderless.__contains__)[:needed]}
    spare = {bucket: revision for bucket, revision in free.items() if bucket not in wanted}
    return Claim(wanted, spare, turn_of(records) + 1)


def decide(
    me: Owner,
    lines: Iterable[str],
    wanted: Mapping[str, str],
    records_of: Callable[[str], LineRecords],
    claim_of_line: Callable[[str], Claim | None],
    *,
    is_settled: bool,
    is_draining: bool,
) -> Step:
    """Return which lines to claim and which to release.

    `me` is this gateway's name and session, `wanted` the gateway that each line is assigned to. A line that
    never had a master is claimed only if `is_settled`, which is False in the first seconds of a session.
    Otherwise the first gateway of a starting fleet would take all lines that never had a master.
    """
    step = Step({}, set())
    for line in lines:
        records = records_of(line)
        ours = votes_of(me, records.values())
        if ours and (is_draining or wanted.get(line, me[0]) != me[0]):
            step.releases.add(line)
        elif ours >= NEEDED or wanted.get(line) != me[0] or is_draining:
            continue
        elif (is_settled or turn_of(records)) and (claim := claim_of_line(line)):
            step.claims[line] = claim
    return step
