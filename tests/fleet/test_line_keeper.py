"""The work on a gateway's lines, on records in memory."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from fleets import Hall, HandClock, MemoryBucket, NotedLines, NotedMastership
from peers import require_module

require_module("nats")

from multidrop.fleet import line_keeper, names  # noqa: E402
from multidrop.fleet.buckets import Record  # noqa: E402
from multidrop.fleet.lease import Lease  # noqa: E402
from multidrop.fleet.lease_rules import SECOND, USUAL  # noqa: E402
from multidrop.fleet.line_keeper import LineKeeper  # noqa: E402
from multidrop.fleet.ownership import owner_of, owner_value  # noqa: E402
from multidrop.fleet.share_records import ShareRecords  # noqa: E402


async def until(condition: Callable[[], bool]) -> None:
    for _ in range(1000):
        if condition():
            return
        await asyncio.sleep(0)
    raise AssertionError("it does not come")


class Trial:
    """A gateway with a lease and one line of the plant."""

    def __init__(self) -> None:
        self.clock = HandClock()
        self.mastership = NotedMastership(self.clock)
        self.lines = NotedLines("a", self.mastership, Hall())
        leases: list[Any] = [MemoryBucket(name) for name in names.LEASES]
        self.lease = Lease("a", leases, self.mastership, clock=self.clock)
        nowhere: Any = None
        self.records = ShareRecords("a", lambda: nowhere, USUAL, lambda: None, self._is_mine)
        for name in names.OWNERS:
            bucket: Any = MemoryBucket(name)
            self.records.owners[name].bucket = bucket
        self.records.plant.take(Record("hall", 1, {"line": {"name": "hall"}}))
        self.keeper = LineKeeper(self.lines, self.lease, self.records, lambda: None)

    def _is_mine(self, record: Record) -> bool:
        return owner_of(record) == ("a", self.lease.session)

    async def claim(self) -> None:
        assert await self.lease.try_to_begin()
        self.keeper.claim({"hall": 0})
        await until(lambda: "hall" in self.keeper.polled and not self.keeper._at_work)


def test_a_claimed_line_takes_stops_at_once_and_commands_when_the_guard_is_over() -> None:
    async def main() -> None:
        trial = Trial()
        await trial.claim()
        assert trial.lines.taken == {"hall"}

        def may() -> tuple[bool, bool]:
            return trial.keeper.may_stop("hall"), trial.keeper.may_command("hall")

        assert may() == (True, False)
        trial.clock.pass_s(USUAL.guard / SECOND - 0.001)
        assert may() == (True, False)
        trial.clock.pass_s(0.001)
        assert may() == (True, True)
        trial.clock.pass_s(USUAL.lease / SECOND)
        assert may() == (False, False)

    asyncio.run(main())


def test_a_line_that_another_has_by_its_record_takes_neither_stops_nor_commands() -> None:
    """It is about to be let go, and its new master answers."""

    async def main() -> None:
        trial = Trial()
        await trial.claim()
        trial.clock.pass_s(1)
        assert trial.keeper.may_command("hall")
        before = trial.records.owner("hall")
        assert before
        trial.records.owners[names.owner_bucket("hall")].take(
            Record("hall", before.revision + 1, owner_value("b", 1, 0))
        )
        assert "hall" in trial.keeper.polled
        assert not trial.keeper.may_stop("hall")
        assert not trial.keeper.may_command("hall")

    asyncio.run(main())


def test_lines_are_let_go_while_there_is_time_to_close_them() -> None:
    async def main() -> None:
        trial = Trial()
        await trial.claim()
        trial.clock.pass_s(USUAL.lease / SECOND - line_keeper.SILENT_S - 0.001)
        trial.keeper.reconcile()
        assert trial.keeper.polled
        assert not trial.keeper._at_work
        trial.clock.pass_s(0.001)
        assert trial.lease.is_valid
        trial.keeper.reconcile()
        await until(lambda: trial.keeper.is_silent)
        assert trial.lines.taken == set()

    asyncio.run(main())


def test_what_waited_until_the_lease_was_over_is_neither_opened_nor_written() -> None:
    async def main() -> None:
        trial = Trial()
        bucket: Any = trial.records.owners[names.owner_bucket("hall")].bucket
        writing = trial.keeper._writing[bucket.name] = asyncio.Semaphore(0)
        openings = trial.keeper._openings = asyncio.Semaphore(0)
        assert await trial.lease.try_to_begin()
        trial.keeper.claim({"hall": 0})
        await asyncio.sleep(0)
        trial.clock.pass_s(USUAL.lease / SECOND)
        writing.release()
        await until(lambda: trial.keeper.is_silent)
        assert bucket.records == {}
        for path in range(3):
            await trial.lease.renew_once(path)
        trial.keeper.claim({"hall": 0})
        await until(lambda: bool(trial.records.owner("hall")))
        trial.clock.pass_s(USUAL.lease / SECOND)
        openings.release()
        await until(lambda: trial.keeper.is_silent)
        assert trial.lines.taken == set()

    asyncio.run(main())


def test_a_line_that_became_anothers_while_it_waited_is_not_opened() -> None:
    async def main() -> None:
        trial = Trial()
        openings = trial.keeper._openings = asyncio.Semaphore(0)
        assert await trial.lease.try_to_begin()
        trial.keeper.claim({"hall": 0})
        await until(lambda: bool(trial.records.owner("hall")))
        trial.records.owners[names.owner_bucket("hall")].take(Record("hall", 9, owner_value("b", 1, 0)))
        openings.release()
        await until(lambda: trial.keeper.is_silent)
        assert trial.lines.taken == set()

    asyncio.run(main())


def test_a_line_that_is_let_go_takes_no_stops() -> None:
    async def main() -> None:
        trial = Trial()
        await trial.claim()
        trial.keeper.releasing = {"hall"}
        trial.keeper.reconcile()
        await until(lambda: trial.keeper.is_silent)
        assert trial.keeper.is_mine("hall")
        assert not trial.keeper.may_stop("hall")

    asyncio.run(main())


def test_a_line_is_let_go_before_it_is_given_away() -> None:
    async def main() -> None:
        trial = Trial()
        await trial.claim()
        trial.keeper.releasing = {"hall"}
        trial.keeper.reconcile()
        assert owner_of(trial.records.owner("hall")) == ("a", 1)
        await until(lambda: trial.keeper.is_silent)
        assert trial.lines.taken == set()
        assert owner_of(trial.records.owner("hall")) == ("a", 1)
        trial.keeper.reconcile()
        await until(lambda: trial.keeper.is_silent)
        assert owner_of(trial.records.owner("hall")) == ("", 0)

    asyncio.run(main())


def test_a_line_is_not_polled_again_while_it_may_have_been_given_away() -> None:
    """A write that nobody answered may still be stored, at any time, until a newer record rules that out."""

    async def main() -> None:
        trial = Trial()
        await trial.claim()
        bucket: Any = trial.records.owners[names.owner_bucket("hall")].bucket
        trial.keeper.releasing = {"hall"}
        trial.keeper.reconcile()
        await until(lambda: trial.keeper.is_silent)
        bucket.is_down = True
        trial.keeper.reconcile()  # given away, and nobody answers
        await until(lambda: trial.keeper.is_silent)
        trial.keeper.releasing = set()  # it is to stay after all
        for _ in range(3):
            trial.keeper.reconcile()
            await until(lambda: trial.keeper.is_silent)
            assert trial.lines.taken == set()
        bucket.is_down = False
        trial.keeper.reconcile()
        await until(lambda: "hall" in trial.keeper.polled and not trial.keeper._at_work)
        assert owner_of(bucket.records["hall"]) == ("a", 1)
        assert bucket.revision("hall") == 2  # what was given away at 1 can be stored no more

    asyncio.run(main())


def test_a_line_that_is_not_closed_for_certain_ends_the_gateway() -> None:
    """Its session is not ended: the others wait for as long as if it had died."""

    async def main() -> None:
        trial = Trial()
        await trial.claim()

        async def fail(line: str) -> None:
            raise RuntimeError("the port is stuck")

        trial.lines.let_go = fail  # type: ignore[method-assign]
        failing = asyncio.create_task(trial.keeper.fail())
        with pytest.raises(RuntimeError, match="the port is stuck"):
            await asyncio.wait_for(trial.keeper.let_all_go(), 10)
        with pytest.raises(RuntimeError, match="the port is stuck"):
            await asyncio.wait_for(failing, 10)
        assert trial.keeper.polled

    asyncio.run(main())


class BrokenLines(NotedLines):
    """Lines whose port cannot be opened, for this reason; "" for none."""

    why = "nothing listens there"

    async def take(self, line: str, description: Any) -> None:
        if self.why:
            raise OSError(self.why)
        await super().take(line, description)


class BrokenTrial(Trial):
    """The same with a port that cannot be opened."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        super().__init__()
        self.now = 1000.0
        clock = SimpleNamespace(monotonic=lambda: self.now, time_ns=lambda: 0)
        monkeypatch.setattr(line_keeper, "time", clock)
        self.broken = BrokenLines("a", self.mastership, Hall())
        self.keeper.lines = self.broken

    async def claim(self) -> None:
        assert await self.lease.try_to_begin()
        self.keeper.claim({"hall": 0})
        await until(lambda: "hall" in self.keeper.troubles and not self.keeper._at_work)

    async def try_again(self) -> None:
        self.keeper.reconcile()
        assert self.keeper.is_silent, "it is too early"
        self.now += line_keeper.TAKE_AGAIN_S
        self.keeper.reconcile()
        assert not self.keeper.is_silent
        await until(lambda: not self.keeper._at_work)


def test_a_line_that_cannot_be_taken_is_told_once_for_each_reason_and_when_it_is(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)

    async def main() -> None:
        trial = BrokenTrial(monkeypatch)
        await trial.claim()
        await trial.try_again()
        await trial.try_again()
        trial.broken.why = "no route to host"
        await trial.try_again()
        assert trial.keeper.troubles == {"hall": "no route to host"}
        trial.broken.why = ""
        await trial.try_again()
        assert trial.keeper.troubles == {}
        assert "hall" in trial.keeper.polled

    asyncio.run(main())
    assert [message for message in caplog.messages if "line hall" in message] == [
        "line hall is not taken, and tried again and again: nothing listens there",
        "line hall is not taken, and tried again and again: no route to host",
        "line hall is taken now",
    ]


def test_of_a_line_that_another_has_by_now_no_trouble_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    async def main() -> None:
        trial = BrokenTrial(monkeypatch)
        await trial.claim()
        trial.keeper.releasing = {"hall"}
        trial.keeper.reconcile()
        assert trial.keeper.troubles == {}
        await until(lambda: trial.keeper.is_silent)
        assert owner_of(trial.records.owner("hall")) == ("", 0)

    asyncio.run(main())
