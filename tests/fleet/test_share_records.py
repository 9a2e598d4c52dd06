"""Records of a share's lines: what is asked of them, when, and that nothing is missed for good."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from typing import Any

import pytest
from fleets import MemoryBucket
from nats_clusters import Cluster, cluster
from peers import require_module

require_module("nats")

from multidrop.fleet import buckets, names, share_records  # noqa: E402
from multidrop.fleet.buckets import Bucket, Record  # noqa: E402
from multidrop.fleet.errors import Unsure  # noqa: E402
from multidrop.fleet.lease_rules import USUAL  # noqa: E402
from multidrop.fleet.ownership import owner_of, owner_value  # noqa: E402
from multidrop.fleet.servers import paths_of  # noqa: E402
from multidrop.fleet.setup import set_up  # noqa: E402
from multidrop.fleet.share_records import ShareFollower, ShareRecords  # noqa: E402

ME, OTHER, NOBODY = (owner_value(*who, 0) for who in (("a", 2), ("b", 1), ("", 0)))


def is_mine(record: Record) -> bool:
    return owner_of(record) == ("a", 2)


class Trial:
    """A bucket in memory, and what gateway a, in its session 2, knows of it."""

    def __init__(self) -> None:
        self.bucket = MemoryBucket()
        made: Any = self.bucket
        self.follower = ShareFollower(made, lambda *_: None, is_mine)

    def looked(self) -> list[str]:
        """Look once, and return the lines that changed."""
        return [record.key for record in asyncio.run(self.follower.look())]

    def asks(self) -> bool:
        """Say whether a look asks anything."""
        before = self.bucket.asked
        self.looked()
        return self.bucket.asked > before


def test_of_lines_that_are_free_or_ours_nothing_is_asked_again() -> None:
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


@pytest.mark.parametrize("value", [OTHER, owner_value("a", 1, 0)])
def test_a_line_of_another_session_is_asked_for_until_it_is_not(value: Any) -> None:
    trial = Trial()
    trial.bucket.store("line", value)
    trial.follower.want(["line"])
    assert trial.looked() == ["line"]
    assert trial.asks()
    trial.bucket.store("line", NOBODY)
    assert trial.looked() == ["line"]
    assert not trial.asks()


def test_a_doubted_line_is_asked_for_again_and_again_though_it_has_left_the_share(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The write that nobody answered may still be stored, when the bucket has a leader again."""
    now = 1000.0
    monkeypatch.setattr(share_records.time, "monotonic", lambda: now)
    trial = Trial()
    trial.follower.doubt(["line"])
    assert trial.looked() == ["line"]
    now += share_records.DOUBT_S - 1
    trial.bucket.store("line", ME)
    assert trial.looked() == ["line"]
    now += 2
    assert not trial.asks()


def test_an_older_record_of_a_server_that_is_behind_changes_nothing() -> None:
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


def test_a_larger_share_is_asked_for_at_once() -> None:
    async def main() -> None:
        trial = Trial()
        trial.follower.want(["line"])
        await trial.follower.look()
        resting = asyncio.create_task(trial.follower.rest())
        trial.follower.want(["line", "another"])
        for _ in range(5):  # turns of the loop, and no time
            await asyncio.sleep(0)
        assert resting.done()

    asyncio.run(main())


def test_moves_into_a_share_are_told_with_the_master_before() -> None:
    path: Any = None
    records = ShareRecords("a", lambda: path, USUAL, lambda: None, is_mine)
    bucket = MemoryBucket()
    records.owners[names.owner_bucket("line")].bucket = bucket  # type: ignore[assignment]
    bucket.store("line", OTHER)
    records.want(["line"])
    asyncio.run(records.owners[names.owner_bucket("line")].look())
    assert [move.before for move in records.moves.newest(9)] == [None]
    records.owners[names.owner_bucket("line")].take(Record("line", 9, ME))
    assert [(move.before, move.after) for move in records.moves.newest(1)] == [("b", "a")]
    assert records.owned_by("a", 2) == {"line"}
    assert records.owned_by("b", 1) == set()


@pytest.mark.parametrize("known", [None, OTHER])
def test_who_did_not_follow_a_line_does_not_say_whose_it_was(known: Any) -> None:
    """It was asked for in a cold start, or an hour ago, and was others' since then."""
    path: Any = None
    records = ShareRecords("a", lambda: path, USUAL, lambda: None, is_mine)
    follower = records.owners[names.owner_bucket("line")]
    follower.take(Record("line", 5 if known else 0, known))
    follower.take(Record("line", 8, NOBODY))
    follower.take(Record("line", 9, ME))
    [move] = [move for move in records.moves.newest(9) if move.revision == 9]
    assert (move.before, move.released) == (None, 8)
    follower.take(Record("line", 10, NOBODY))  # we gave it away
    assert [move.before for move in records.moves.newest(9) if move.revision == 10] == ["a"]


def test_of_sessions_that_have_no_line_any_more_nothing_is_kept() -> None:
    path: Any = None
    records = ShareRecords("a", lambda: path, USUAL, lambda: None, is_mine)
    follower = records.owners[names.owner_bucket("line")]
    for session in range(1, 1000):
        follower.take(Record("line", session, owner_value("b", session, 0)))
    follower.take(Record("line", 1000, owner_value("b", 999, 0)))
    assert records.owned_by("b", 999) == {"line"}
    assert len(records._owned) == 1


def test_lines_that_were_read_before_a_failure_are_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """The lines fill whole batches, and a server does not say that there are no more."""
    monkeypatch.setattr(buckets, "BATCH", 2)
    path: Any = None
    records = ShareRecords("a", lambda: path, USUAL, lambda: None, is_mine)
    bucket = MemoryBucket(names.PLANT)
    records.plant.bucket = bucket  # type: ignore[assignment]
    for name in ("line-1", "line-2"):
        bucket.store(name, {"line": {"name": name}, "files": {}})
    changes = bucket.changes

    async def fail_at_the_end(after: int) -> list[Record]:
        if after == 2:
            raise Unsure("no answer")
        return await changes(after)

    bucket.changes = fail_at_the_end  # type: ignore[method-assign]
    with pytest.raises(Unsure):
        asyncio.run(records._look_at_plant())
    assert records.lines() == ("line-1", "line-2")


@pytest.fixture(scope="module")
def one(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    with cluster(tmp_path_factory.mktemp("nats"), 1) as running:
        yield running


@pytest.mark.long
def test_servers_give_the_newest_records_of_many_lines(one: Cluster) -> None:
    async def main() -> None:
        path = paths_of(one.urls)[0]
        await path.open()
        await set_up([path])
        bucket = Bucket("own_0", lambda: path)
        lines = [f"line-{at}" for at in range(1200)]
        stored = await bucket.put_all([Record(line, 0, OTHER) for line in lines])
        again = await bucket.put_all([record._replace(value=NOBODY) for record in stored[:10]])
        follower = ShareFollower(bucket, lambda *_: None, is_mine)
        follower.want([*lines[:1100], "never had"])
        changed = await asyncio.wait_for(follower.look(), 60)
        newest = {record.key: record for record in (*stored[:1100], *again)}
        assert follower.records == {**newest, "never had": Record("never had", 0, None)}
        assert len(changed) == 1101
        assert len(await follower.look()) == 0
        await path.close()

    asyncio.run(main())
