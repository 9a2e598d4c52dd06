"""LineKeeper: a gateway claims, opens and releases lines, with ownership records in memory."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from fleets import GatedBucket, Hall, HandClock, MemoryBucket, RecordingLines, RecordingMastership

from multidrop.fleet.lines import line_keeper
from multidrop.fleet.lines.lease import Lease
from multidrop.fleet.lines.line_keeper import LineKeeper, PortLoss
from multidrop.fleet.lines.records import ShareRecords
from multidrop.fleet.lines.rules import SECOND, USUAL, owner_of, owner_value
from multidrop.fleet.servers import names
from multidrop.fleet.servers.buckets import Record


async def until(condition: Callable[[], bool]) -> None:
    for _ in range(1000):
        if condition():
            return
        await asyncio.sleep(0)
    raise AssertionError("it does not come")


class Trial:
    """Gateway "a" with a lease, and a plant with the line "hall"."""

    def __init__(self) -> None:
        self.clock = HandClock()
        self.mastership = RecordingMastership(self.clock)
        self.lines = RecordingLines("a", self.mastership, Hall())
        leases: list[Any] = [MemoryBucket(name) for name in names.LEASES]
        self.lease = Lease("a", leases, self.mastership, clock=self.clock)
        nowhere: Any = None
        self.records = ShareRecords("a", lambda: nowhere, USUAL, lambda: None, self._is_mine)
        for name in names.OWNERS:
            bucket: Any = GatedBucket(name)
            self.records.owners[name].bucket = bucket
        self.buckets: list[Any] = [self.records.owners[name].bucket for name in names.owner_buckets("hall")]
        self.records.plant.take(Record("hall", 1, {"line": {"name": "hall"}}))
        self.keeper = LineKeeper(self.lines, self.lease, self.records, lambda: None)

    def _is_mine(self, record: Record) -> bool:
        return owner_of(record) == ("a", self.lease.session)

    async def read(self) -> None:
        """Read the line's ownership records from the buckets."""
        self.records.want(["hall"])
        for follower in self.records.owners.values():
            await follower.look()

    async def read_and_begin(self) -> None:
        assert await self.lease.try_to_begin()
        await self.read()

    async def claim(self) -> None:
        await self.read_and_begin()
        self.claim_now()
        await until(lambda: "hall" in self.keeper.polled and not self.keeper._tasks)

    async def is_polled(self) -> None:
        while "hall" not in self.keeper.polled or self.keeper._at_work:
            await asyncio.sleep(0.001)

    async def is_at_rest(self) -> None:
        while self.keeper._at_work:
            await asyncio.sleep(0.001)

    async def let_the_first_lag(self) -> None:
        """Renew all lease records except the one on the server of the line's first bucket."""
        self.clock.pass_s(1.001)
        for path, name in enumerate(names.OWNERS):
            if name != self.buckets[0].name:
                await self.lease.renew_once(path)

    async def until_polled(self) -> None:
        await until(lambda: "hall" in self.keeper.polled and not self.keeper._at_work)

    async def reconcile(self) -> None:
        """Reconcile the line with its records, and wait until it is neither open nor being opened."""
        self.keeper.reconcile()
        await until(lambda: self.keeper.is_silent)

    def are_down(self, *, is_so: bool = True) -> None:
        for bucket in self.buckets:
            bucket.is_down = is_so

    def claim_now(self) -> None:
        claim = self.keeper.claim_of("hall")
        assert claim
        self.keeper.claim({"hall": claim})

    def owner(self) -> tuple[str, int] | None:
        """Return the line's owner according to the ownership records that the gateway has read."""
        record = self.records.owner("hall")
        return owner_of(record) if record else None

    def is_taken_by_another(self, *places: int) -> None:
        """Let the gateway read ownership records in these buckets that name gateway "b"."""
        for place in places:
            bucket = names.owner_buckets("hall")[place]
            known = self.records.of("hall")[bucket]
            revision = known.revision + 1 if known else 1
            self.records.owners[bucket].take(Record("hall", revision, owner_value(("b", 1), 9, 0)))


async def claimed() -> Trial:
    """Return a trial whose gateway polls the line."""
    trial = Trial()
    await trial.claim()
    return trial


class DeadTrial(Trial):
    """A trial whose line had a master, which has ended."""

    def __init__(self) -> None:
        super().__init__()
        for bucket in self.buckets[:2]:
            bucket.store("hall", owner_value(("", 0), 1, 0))

    async def claim_without_the_first(self) -> None:
        """Claim the line while its first bucket delays writes."""
        await self.read_and_begin()
        self.buckets[0].shut()
        self.claim_now()
        await asyncio.wait_for(self.is_polled(), 10)


async def test_a_new_master_accepts_stops_immediately_but_commands_after_the_guard_time() -> None:
    trial = await claimed()
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


async def test_a_line_of_another_gateway_accepts_neither_stops_nor_commands() -> None:
    """The gateway is about to close the line. The line's new master answers instead."""
    trial = await claimed()
    trial.clock.pass_s(1)
    assert trial.keeper.may_command("hall")
    trial.is_taken_by_another(0)
    assert "hall" in trial.keeper.polled
    assert not trial.keeper.may_stop("hall")
    assert not trial.keeper.may_command("hall")


async def test_lines_are_closed_half_a_second_before_the_lease_expires() -> None:
    trial = await claimed()
    trial.clock.pass_s(USUAL.lease / SECOND - line_keeper.SILENT_S - 0.001)
    trial.keeper.reconcile()
    assert trial.keeper.polled
    assert not trial.keeper._at_work
    trial.clock.pass_s(0.001)
    assert trial.lease.is_valid
    await trial.reconcile()
    assert trial.lines.taken == set()


async def test_delayed_claim_or_opening_does_nothing_after_the_lease_expired() -> None:
    trial = Trial()
    bucket = trial.buckets[0]
    writing = trial.keeper._owners._writing[bucket.name] = asyncio.Semaphore(0)
    openings = trial.keeper._openings = asyncio.Semaphore(0)
    await trial.read_and_begin()
    trial.claim_now()
    await asyncio.sleep(0)
    trial.clock.pass_s(USUAL.lease / SECOND)
    writing.release()
    await until(lambda: trial.keeper.is_silent)
    assert bucket.records == {}
    for path in range(3):
        await trial.lease.renew_once(path)
    trial.claim_now()
    await until(lambda: bool(trial.records.owner("hall")))
    trial.clock.pass_s(USUAL.lease / SECOND)
    openings.release()
    await until(lambda: trial.keeper.is_silent)
    assert trial.lines.taken == set()


async def test_line_is_not_opened_if_another_gateway_claims_it_first() -> None:
    trial = Trial()
    openings = trial.keeper._openings = asyncio.Semaphore(0)
    await trial.read_and_begin()
    trial.claim_now()
    await until(lambda: bool(trial.records.owner("hall")))
    trial.is_taken_by_another(0)
    openings.release()
    await until(lambda: trial.keeper.is_silent)
    assert trial.lines.taken == set()


async def test_line_closed_for_release_accepts_no_stops() -> None:
    trial = await claimed()
    trial.keeper.releasing = {"hall"}
    await trial.reconcile()
    assert trial.keeper.is_mine("hall")
    assert not trial.keeper.may_stop("hall")


async def test_gateway_closes_a_line_before_releasing_ownership() -> None:
    trial = await claimed()
    trial.keeper.releasing = {"hall"}
    trial.keeper.reconcile()
    assert trial.owner() == ("a", 1)
    await until(lambda: trial.keeper.is_silent)
    assert trial.lines.taken == set()
    assert trial.owner() == ("a", 1)
    await trial.reconcile()
    assert trial.owner() == ("", 0)


async def test_line_is_not_polled_while_an_unanswered_release_is_pending() -> None:
    """The unanswered write of the release may be stored at any later time, until a newer record exists."""
    trial = await claimed()
    bucket = trial.buckets[0]
    trial.keeper.releasing = {"hall"}
    await trial.reconcile()
    trial.are_down()
    trial.keeper.reconcile()  # the line's release is sent, but not answered
    await until(lambda: trial.keeper.is_silent)
    trial.keeper.releasing = set()  # the line is assigned to this gateway again
    for _ in range(3):
        await trial.reconcile()
        assert trial.lines.taken == set()
    trial.are_down(is_so=False)
    trial.keeper.reconcile()
    await trial.until_polled()
    assert owner_of(bucket.records["hall"]) == ("a", 1)
    # The delayed release would replace revision 1. The new record has revision 2, so the server refuses it.
    assert bucket.revision("hall") == 2


def owners(trial: Trial) -> list[tuple[str, int]]:
    """Return the owner in each stored ownership record, in the order in which records are written."""
    return [owner_of(bucket.records.get("hall")) for bucket in trial.buckets]


ME, NOBODY = ("a", 1), ("", 0)


async def test_a_new_line_is_claimed_by_writing_one_record() -> None:
    trial = await claimed()
    assert owners(trial) == [ME, NOBODY, NOBODY]
    assert trial.keeper.moves == 1


async def test_a_line_of_a_dead_master_is_claimed_by_writing_two_records() -> None:
    trial = DeadTrial()
    await trial.claim()
    assert owners(trial) == [ME, ME, NOBODY]
    assert trial.keeper.moves == 1


@pytest.mark.parametrize("place", [0, 1])
async def test_line_is_claimed_even_if_one_nats_bucket_has_no_leader(place: int) -> None:
    trial = DeadTrial()
    await trial.read_and_begin()
    trial.buckets[place].is_down = True
    trial.claim_now()
    await trial.until_polled()
    assert owners(trial)[place] == NOBODY
    assert owners(trial).count(ME) == 2


async def test_line_is_claimed_even_if_one_bucket_answers_late(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(line_keeper, "SPARE_S", 0.0)
    trial = DeadTrial()
    await trial.claim_without_the_first()
    assert owners(trial) == [NOBODY, ME, ME]
    trial.buckets[0].open()
    await until(lambda: not trial.keeper._tasks)
    assert owners(trial) == [ME, ME, ME]
    assert trial.keeper.moves == 1


async def test_a_refused_claim_does_not_wait_for_a_late_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    """A server that is cut off may answer late. The claim must be repeated with newer records before that."""
    monkeypatch.setattr(line_keeper, "SPARE_S", 100.0)
    trial = DeadTrial()
    await trial.read_and_begin()
    trial.buckets[1].store("hall", owner_value(("", 0), 2, 0))
    trial.buckets[0].shut()
    trial.claim_now()
    await asyncio.wait_for(trial.is_at_rest(), 10)
    assert owners(trial) == [NOBODY, NOBODY, NOBODY]
    assert all(trial.records.owners[bucket.name]._doubted for bucket in trial.buckets[:2])
    await trial.read()
    trial.buckets[0].open()
    trial.claim_now()
    await asyncio.wait_for(trial.is_polled(), 10)
    assert owners(trial) == [ME, ME, NOBODY]


async def test_claim_is_written_last_to_a_possibly_failed_server() -> None:
    trial = DeadTrial()
    await trial.read_and_begin()
    await trial.let_the_first_lag()
    trial.claim_now()
    await trial.until_polled()
    assert owners(trial) == [NOBODY, ME, ME]


async def test_claim_keeps_the_usual_server_order_if_all_are_slow() -> None:
    """If all lease records are renewed late, the servers are busy, and probably none has failed."""
    trial = DeadTrial()
    await trial.read_and_begin()
    trial.clock.pass_s(1.5)
    await trial.lease.renew_once(names.OWNERS.index(trial.buckets[2].name))
    trial.claim_now()
    await trial.until_polled()
    assert owners(trial) == [ME, ME, NOBODY]


async def test_claim_does_not_wait_for_a_failed_server(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The first record of a new line must be in this bucket. Its server does not answer."""
    monkeypatch.setattr(line_keeper, "SPARE_S", 0.0)
    trial = Trial()
    await trial.read_and_begin()
    await trial.let_the_first_lag()
    trial.buckets[0].shut()
    trial.claim_now()
    await asyncio.wait_for(trial.is_at_rest(), 10)
    trial.buckets[0].open()
    trial.claim_now()
    await asyncio.wait_for(trial.is_polled(), 10)


async def test_a_claim_of_a_line_fails_if_another_gateway_was_faster() -> None:
    trial = DeadTrial()
    await trial.read_and_begin()
    trial.buckets[1].store("hall", owner_value(("b", 1), 2, 0))
    trial.claim_now()
    await until(lambda: not trial.keeper._tasks)
    assert owners(trial) == [ME, ("b", 1), NOBODY]
    assert not trial.keeper.polled


async def test_line_stays_closed_if_a_claim_is_answered_during_the_release(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The line must stay closed while the records of its release are being written."""
    monkeypatch.setattr(line_keeper, "SPARE_S", 0.0)
    trial = DeadTrial()
    await trial.claim_without_the_first()
    trial.keeper.releasing = {"hall"}
    trial.keeper.reconcile()
    await until(lambda: not trial.keeper.polled and not trial.keeper._at_work)
    writers = trial.keeper._owners._writing[trial.buckets[1].name]
    async with writers, writers:  # takes all permits to write in this bucket
        trial.keeper.reconcile()
        await until(lambda: owners(trial) == [NOBODY, ME, NOBODY])
        trial.buckets[0].open()
        await until(lambda: owners(trial)[0] == ME)
        for _ in range(100):
            await asyncio.sleep(0)
        assert not trial.keeper.is_mine("hall")
        assert trial.lines.taken == set()
    await until(lambda: not trial.keeper._tasks)
    assert trial.lines.taken == set()
    assert owners(trial) == [ME, NOBODY, NOBODY]
    trial.keeper.reconcile()
    await until(lambda: owners(trial) == [NOBODY] * 3)


async def test_released_line_stays_released_after_a_late_claim_answer() -> None:
    """The gateway reads its stored claim, then releases the line, and gets the answer to its claim last."""
    trial = Trial()
    await trial.read_and_begin()
    bucket = trial.buckets[0] = GatedBucket(trial.buckets[0].name, answers=True)
    trial.records.owners[bucket.name].bucket = bucket
    bucket.shut()
    trial.claim_now()
    await asyncio.wait_for(bucket.arrived.wait(), 10)
    trial.records.doubt(bucket.name, ["hall"])
    await trial.read()
    assert trial.keeper.is_mine("hall")
    bucket.is_down = True
    await trial.keeper._owners.give_away(["hall"])
    bucket.open()
    await until(lambda: not trial.keeper._tasks)
    assert not trial.keeper.is_mine("hall")
    assert trial.lines.taken == set()


async def test_unanswered_release_is_undone_only_if_claims_are_allowed() -> None:
    trial = await claimed()
    trial.are_down()
    trial.keeper.releasing = {"hall"}
    for _ in range(2):  # the first call closes the line, the second call releases it
        trial.keeper.reconcile()
        await until(lambda: not trial.keeper._tasks)
    assert not trial.keeper.is_mine("hall")
    trial.are_down(is_so=False)
    trial.keeper.releasing, trial.keeper.may_claim = set(), False
    trial.keeper.reconcile()
    await until(lambda: not trial.keeper._tasks)
    assert not trial.keeper.is_mine("hall")
    trial.keeper.may_claim = True
    trial.keeper.reconcile()
    await until(lambda: "hall" in trial.keeper.polled)


async def test_gateway_ends_if_a_line_cannot_be_closed() -> None:
    """The line may still be open, so the gateway does not end its session. Others wait for its lease."""
    trial = await claimed()

    async def fail(line: str) -> None:
        raise RuntimeError("the port is stuck")

    trial.lines.let_go = fail
    failing = asyncio.create_task(trial.keeper.fail())
    with pytest.raises(RuntimeError, match="the port is stuck"):
        await asyncio.wait_for(trial.keeper.let_all_go(), 10)
    with pytest.raises(RuntimeError, match="the port is stuck"):
        await asyncio.wait_for(failing, 10)
    assert trial.keeper.polled


async def test_failure_to_open_one_line_does_not_affect_other_lines(caplog: pytest.LogCaptureFixture) -> None:
    """The failure is an exception, as from a user's drive class."""
    trial = Trial()
    take, failures = trial.lines.take, [ZeroDivisionError("of a user's class")]

    async def fail(line: str, description: Any) -> None:
        if failures:
            raise failures.pop()
        await take(line, description)

    trial.lines.take = fail
    await trial.read_and_begin()
    trial.claim_now()
    await until(lambda: bool(trial.keeper.troubles))
    assert trial.keeper.troubles == {"hall": "ZeroDivisionError: of a user's class"}
    assert (trial.keeper.lost, trial.keeper._failure) == ({}, None)
    await until(lambda: not trial.keeper._tasks)
    trial.keeper._again_at["hall"] = 0.0
    trial.keeper.reconcile()
    await until(lambda: "hall" in trial.keeper.polled)
    assert trial.keeper.troubles == {}
    assert "Traceback" in caplog.text


class BrokenLines(RecordingLines):
    """Lines whose ports cannot be opened for the reason `why`; "" allows opening them."""

    why = "nothing listens there"

    async def take(self, line: str, description: Any) -> None:
        if self.why:
            raise OSError(self.why)
        await super().take(line, description)


class BrokenTrial(Trial):
    """A trial with a port that cannot be opened."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        super().__init__()
        self.now = 1000.0
        clock = SimpleNamespace(monotonic=lambda: self.now, time_ns=lambda: 0)
        monkeypatch.setattr(line_keeper, "time", clock)
        self.broken = BrokenLines("a", self.mastership, Hall())
        self.keeper.lines = self.broken

    async def claim(self) -> None:
        await self.read_and_begin()
        self.claim_now()
        await until(lambda: "hall" in self.keeper.troubles and not self.keeper._at_work)

    async def try_again(self) -> None:
        self.keeper.reconcile()
        assert self.keeper.is_silent, "it is too early"
        self.now += line_keeper.TAKE_AGAIN_S
        self.keeper.reconcile()
        assert not self.keeper.is_silent
        await until(lambda: not self.keeper._at_work)


async def test_failure_to_open_a_line_is_logged_once_per_reason(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
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
    assert [message for message in caplog.messages if "line hall" in message] == [
        "line hall cannot be opened; retrying: nothing listens there",
        "line hall cannot be opened; retrying: no route to host",
        "line hall is open now",
    ]


async def test_line_error_is_forgotten_when_the_line_is_released(monkeypatch: pytest.MonkeyPatch) -> None:
    trial = BrokenTrial(monkeypatch)
    await trial.claim()
    trial.keeper.releasing = {"hall"}
    trial.keeper.reconcile()
    assert trial.keeper.troubles == {}
    await until(lambda: trial.keeper.is_silent)
    assert trial.owner() == ("", 0)


@pytest.mark.parametrize(
    ("loss", "reported"),
    [
        (PortLoss(None, None), None),
        (PortLoss(None, SECOND), None),
        (PortLoss(None, 3 * SECOND), "it is being reopened"),
        (PortLoss("no route to host", SECOND), "no route to host"),
    ],
)
async def test_lost_port_is_reported_if_reopening_fails_or_takes_long(
    loss: PortLoss, reported: str | None
) -> None:
    trial = await claimed()
    await until(lambda: "hall" in trial.keeper.polled)
    await until(lambda: not trial.keeper._at_work)
    trial.lines.port_loss = lambda line: loss
    trial.keeper._look_at_ports()
    assert trial.keeper.lost.get("hall") == reported
