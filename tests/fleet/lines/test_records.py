"""Ownership records of the lines that a gateway should poll: when it reads them again."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
from fleets import MemoryBucket
from nats_clusters import Cluster, connected_path
from tables import table

from multidrop.fleet.errors import OutcomeUnknown
from multidrop.fleet.lines import records as line_records
from multidrop.fleet.lines.records import Move, Moves, ShareFollower, ShareRecords, move_of
from multidrop.fleet.lines.rules import NEEDED, USUAL, owner_of, owner_value
from multidrop.fleet.servers import buckets, names
from multidrop.fleet.servers.buckets import Bucket, Record

ME, OTHER, NOBODY = (owner_value(who, 1, 0) for who in (("a", 2), ("b", 1), ("", 0)))


def is_mine(record: Record) -> bool:
    return owner_of(record) == ("a", 2)


class Trial:
    """A bucket in memory, and the records that gateway "a" has read from it in its session 2."""

    def __init__(self) -> None:
        self.bucket = MemoryBucket()
        made: Any = self.bucket
        self.had: set[str] = set()
        self.follower = ShareFollower(made, self.note, is_mine, self.had.__contains__)

    def note(self, *_: object) -> None:
        """Determine again which records may change, as ShareRecords does after each record."""
        self.follower.recompute()

    def looked(self) -> list[str]:
        """Read once, and return the lines whose records have changed."""
        return [record.key for record in asyncio.run(self.follower.look())]

    def asks(self) -> bool:
        """Return True if a call of `look` sends a request."""
        before = self.bucket.asked
        self.looked()
        return self.bucket.asked > before


def test_gateway_reads_records_of_its_own_and_free_lines_only_once() -> None:
    trial = Trial()
    trial.bucket.store("mine", ME)
    trial.bucket.store("free", NOBODY)
    trial.bucket.store("another share's", OTHER)
    assert not trial.asks()
    trial.follower.want(["mine", "free", "never had"])
    assert trial.looked() == ["free", "mine", "never had"]
    assert trial.follower.records["never had"] == Record("never had", 0, None)
    assert "another share's" not in trial.follower.records
    assert not trial.asks()


@pytest.mark.parametrize("value", [OTHER, owner_value(("a", 1), 1, 0)])
def test_ownership_record_is_read_repeatedly_while_it_names_a_gateway(value: Any) -> None:
    trial = Trial()
    trial.bucket.store("line", value)
    trial.follower.want(["line"])
    assert trial.looked() == ["line"]
    assert trial.asks()
    trial.bucket.store("line", NOBODY)
    assert trial.looked() == ["line"]
    assert not trial.asks()


def test_gateway_stops_reading_the_record_of_a_claimed_line() -> None:
    trial = Trial()
    trial.bucket.store("line", OTHER)
    trial.follower.want(["line"])
    trial.looked()
    assert trial.asks()
    trial.had.add("line")
    trial.follower.recompute()
    assert not trial.asks()


def test_record_is_read_for_30_s_after_an_unanswered_write(monkeypatch: pytest.MonkeyPatch) -> None:
    """The write may still be stored once the bucket has a leader again."""
    now = 1000.0
    monkeypatch.setattr(line_records.time, "monotonic", lambda: now)
    trial = Trial()
    trial.follower.doubt(["line"])
    assert trial.looked() == ["line"]
    now += line_records.DOUBT_S - 1
    trial.bucket.store("line", ME)
    assert trial.looked() == ["line"]
    now += 2
    assert not trial.asks()


def test_an_older_record_from_a_lagging_server_is_ignored() -> None:
    trial = Trial()
    trial.bucket.store("line", OTHER)
    trial.follower.want(["line"])
    trial.looked()
    old = dict(trial.bucket.records)
    trial.follower.take(Record("line", 9, ME))
    trial.follower.doubt(["line"])
    trial.bucket.records = old
    assert trial.looked() == []
    trial.bucket.records = {}
    assert trial.looked() == []
    assert is_mine(trial.follower.records["line"])


async def test_the_record_of_an_added_line_is_read_without_delay() -> None:
    trial = Trial()
    trial.follower.want(["line"])
    await trial.follower.look()
    resting = asyncio.create_task(trial.follower.rest())
    trial.follower.want(["line", "another"])
    for _ in range(5):  # lets other tasks of the event loop run, while no time passes
        await asyncio.sleep(0)
    assert resting.done()


FIRST_BUCKET, SECOND_BUCKET, _ = names.owner_buckets("line")


def followed() -> ShareRecords:
    path: Any = None
    return ShareRecords("a", lambda: path, USUAL, lambda: None, is_mine)


def take(records: ShareRecords, revision: int, value: Any, *buckets: str) -> None:
    for bucket in buckets:
        records.owners[bucket].take(Record("line", revision, value))


def moves_of(records: ShareRecords) -> list[tuple[str | None, str]]:
    return [(move.before, move.after) for move in records.moves.newest(9)]


def test_a_change_of_masters_is_seen_when_two_ownership_records_agree() -> None:
    records = followed()
    take(records, 1, owner_value(("b", 1), 1, 0, NEEDED), FIRST_BUCKET)
    assert moves_of(records) == [("", "b")]
    take(records, 2, owner_value(("a", 2), 2, 0), FIRST_BUCKET)
    assert moves_of(records) == [("", "b")]
    take(records, 3, owner_value(("a", 2), 2, 0), SECOND_BUCKET)
    assert moves_of(records) == [("b", "a"), ("", "b")]


def test_line_is_listed_for_two_gateways_if_records_disagree() -> None:
    records = followed()
    take(records, 1, OTHER, FIRST_BUCKET, SECOND_BUCKET)
    take(records, 2, ME, FIRST_BUCKET)
    assert records.owned_by("a", 2) == records.owned_by("b", 1) == {"line"}
    take(records, 2, ME, SECOND_BUCKET)
    assert records.owned_by("a", 2) == {"line"}
    assert records.owned_by("b", 1) == set()


def test_the_former_master_is_unknown_if_earlier_records_were_not_read() -> None:
    """Gateways have claimed the line in the meantime, and this gateway has not read their records."""
    records = followed()
    take(records, 8, owner_value(("b", 1), 8, 0), FIRST_BUCKET, SECOND_BUCKET)
    assert moves_of(records) == [(None, "b")]
    take(records, 11, owner_value(("a", 2), 11, 0), FIRST_BUCKET, SECOND_BUCKET)
    assert moves_of(records)[0] == (None, "a")
    # this gateway has released the line
    take(records, 12, owner_value(("", 0), 12, 0), FIRST_BUCKET, SECOND_BUCKET)
    assert moves_of(records)[0] == ("a", "")


def test_claiming_an_own_line_again_does_not_count_as_a_change() -> None:
    """The master claims its own line again because the outcome of the line's release was unknown."""
    records = followed()
    take(records, 1, owner_value(("a", 2), 1, 0), FIRST_BUCKET, SECOND_BUCKET)
    take(records, 2, owner_value(("a", 2), 2, 0), FIRST_BUCKET, SECOND_BUCKET)
    assert moves_of(records) == [("", "a")]
    take(records, 3, owner_value(("b", 1), 3, 0), FIRST_BUCKET, SECOND_BUCKET)
    assert moves_of(records) == [("a", "b"), ("", "a")]


def test_session_without_lines_is_forgotten() -> None:
    records = followed()
    for session in range(1, 1000):
        take(records, session, owner_value(("b", session), session, 0), FIRST_BUCKET, SECOND_BUCKET)
    take(records, 1000, owner_value(("b", 999), 1000, 0), FIRST_BUCKET, SECOND_BUCKET)
    assert records.owned_by("b", 999) == {"line"}
    assert len(records._owned) == 1


def test_plant_lines_read_before_a_failure_are_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two reads return all lines. The last read, which would return no further lines, fails."""
    monkeypatch.setattr(buckets, "BATCH", 2)
    path: Any = None
    records = ShareRecords("a", lambda: path, USUAL, lambda: None, is_mine)
    bucket = MemoryBucket(names.PLANT)
    records.plant.bucket = bucket
    for name in ("line-1", "line-2"):
        bucket.store(name, {"line": {"name": name}, "files": {}})
    changes = bucket.changes

    async def fail_at_the_end(after: int) -> list[Record]:
        if after == 2:
            raise OutcomeUnknown("no answer")
        return await changes(after)

    bucket.changes = fail_at_the_end
    with pytest.raises(OutcomeUnknown):
        asyncio.run(records._look_at_plant())
    assert records.lines() == ("line-1", "line-2")


@pytest.mark.long
async def test_real_servers_return_the_newest_records_of_many_lines(one: Cluster) -> None:
    async with connected_path(one) as path:
        bucket = Bucket("own_0", lambda: path)
        lines = [f"line-{at}" for at in range(1200)]
        stored, _ = await bucket.put_all([Record(line, 0, OTHER) for line in lines])
        some = [record._replace(value=NOBODY) for record in stored[:10]]
        again, refused = await bucket.put_all([*some, Record("line-20", 0, NOBODY)])
        assert refused == {"line-20"}
        follower = ShareFollower(bucket, lambda *_: follower.recompute(), is_mine, lambda line: False)
        follower.want([*lines[:1100], "never had"])
        changed = await asyncio.wait_for(follower.look(), 60)
        newest = {record.key: record for record in (*stored[:1100], *again)}
        assert follower.records == {**newest, "never had": Record("never had", 0, None)}
        assert len(changed) == 1101
        assert len(await follower.look()) == 0


# ---- changes of lines' masters: a former master is reported only if its record was read ----


def told(*moves: Move) -> list[tuple[str | None, str]]:
    """Return the former and the new master in each change that is listed after these reports."""
    found = Moves()
    found.add(moves)
    return [(move.before, move.after) for move in found.newest(100)]


def move(turn: int, before: str | None, after: str, line: str = "hall-1") -> Move:
    return Move(line, turn, 1000 * turn, before, after)


FIRST, RELEASE, CLAIM = move(1, "", "gw-1"), move(2, "gw-1", ""), move(3, "", "gw-2")
MOVED, UNKNOWN_FORMER = move(2, "gw-1", "gw-2"), move(2, None, "gw-2")
MOVED_ONCE = [("gw-1", "gw-2"), ("", "gw-1")]


@table(
    ("moves", "shown"),
    [
        ([FIRST, MOVED], MOVED_ONCE),
        ([FIRST, RELEASE, CLAIM], MOVED_ONCE),
        ([CLAIM, RELEASE, FIRST], MOVED_ONCE),
        ([FIRST, RELEASE], [("gw-1", ""), ("", "gw-1")]),  # the line has no new master yet
        ([UNKNOWN_FORMER, MOVED], [("gw-1", "gw-2")]),
        ([MOVED, UNKNOWN_FORMER], [("gw-1", "gw-2")]),
        ([RELEASE, CLAIM._replace(line="hall-2")], [("", "gw-2"), ("gw-1", "")]),
    ],
)
def test_changes_of_masters_are_listed_newest_first(moves: list[Move], shown: list[tuple[str, str]]) -> None:
    """A release and the following claim of the same line are listed as one change."""
    assert told(*moves) == shown


def test_release_and_following_claim_are_listed_as_one_change() -> None:
    """One gateway reports only the release, the other only the claim."""
    giver, taker = [FIRST, RELEASE], [move(2, None, ""), CLAIM]
    sent = [*giver, *taker, *giver]
    back = [move_of(one.as_json()) for one in sent]
    assert back == sent
    assert told(*back) == MOVED_ONCE


def test_only_the_newest_changes_of_masters_are_kept() -> None:
    moves = Moves(most=10)
    # in descending order: buckets are read independently, so older changes may be added later
    for turn in range(1000, 0, -1):
        moves.add([move(turn, None, "gw-1", f"line-{turn}")])
    assert [one.turn for one in moves.newest(10)] == list(range(1000, 990, -1))
    assert len(moves.newest(1000)) <= 40
