"""Ownership: the records that say whose a line is, and who may write them when. Pure.

A line has a record in each of three buckets, with one vote each, and its master is the session with two: so
a bucket without a leader holds nobody up. A record that names a session which is not over is replaced by that
session alone, at the revision that it knows; so no two sessions ever have two votes.

The first record of all that a line gets has two votes, and saves a large fleet's cold start a second. It is
written in the line's first bucket, where the server stores one such alone; and nothing is written in the
others by who has not seen it.

Records are written only when a line changes hands. Once the session that one names is over, it is void.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any, NamedTuple

from multidrop.fleet.servers.buckets import NONE_YET, Record

NOBODY = ""
NEEDED = 2  # votes

Owner = tuple[str, int]  # a gateway and its session
LineRecords = Mapping[str, Record | None]  # by bucket, in the order in which they are written; None: not read


class Claim(NamedTuple):
    """The records of a line that are to name us: the revision of each, by bucket.

    `spare` has those that are written where one of the `first` is not answered. Each gets so many `votes`.
    """

    first: dict[str, int]
    spare: dict[str, int]
    turn: int
    votes: int = 1


class Step(NamedTuple):
    """The lines that a gateway is to claim, and those that it is to give away."""

    claims: dict[str, Claim]  # by line
    releases: set[str]


def owner_of(record: Record | None) -> Owner:
    """Return gateway and session that a record names; a free line's has neither."""
    if record is None or not record.value:
        return NOBODY, 0
    return record.value["gateway"], record.value["session"]


def owner_value(owner: Owner, turn: int, now_ms: int, votes: int = 1) -> dict[str, Any]:
    """Return a line's record.

    `turn` counts how often the line was claimed and given away; it and `now_ms` (UTC) are for people alone.
    """
    return {"gateway": owner[0], "session": owner[1], "votes": votes, "turn": turn, "since": now_ms}


def votes_of(owner: Owner, records: Iterable[Record | None]) -> int:
    """Return how many votes an owner has by these records."""
    return sum(record.value["votes"] for record in records if record and owner_of(record) == owner)


def owner_by(records: LineRecords) -> Record | None:
    """Return the newest record of an owner with enough votes, who may be nobody; None where nobody has."""
    told = [record for record in records.values() if record and record.value]
    decided = [record for record in told if votes_of(owner_of(record), told) >= NEEDED]
    return max(decided, key=lambda record: record.value["turn"], default=None)


def turn_of(records: LineRecords) -> int:
    """Return the newest turn of these; 0 where nobody ever had the line."""
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
    """Return which records to write for us to have enough votes; None where that cannot be, or is so.

    `doubted` are the buckets where ours was given away, and nobody knows whether that was stored; those that
    are `leaderless`, perhaps, are written last.
    """
    first_bucket, first = next(iter(records.items()), ("", None))
    if not first:
        return None  # it may have two votes
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
            return None  # its master lives, and needs no other
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
    """Return which lines to claim and which to give away.

    `me` is our name and session, `wanted` the gateway of each line by the balance. A line that nobody ever
    had is claimed only when we are settled: else the first gateway of a cold start would take all of them.
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
