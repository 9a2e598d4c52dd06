"""Start, renewal and end of a session, with records in memory and a clock that the tests set."""

from __future__ import annotations

import asyncio
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from controlled_loop import run_controlled
from fleets import GatedBucket, HandClock, MemoryBucket, RecordingMastership
from tables import table

from multidrop.fleet.errors import FleetError, OutcomeUnknown
from multidrop.fleet.lines import lease as leases
from multidrop.fleet.lines.lease import Lease, LifeLock
from multidrop.fleet.lines.observer import Observer
from multidrop.fleet.lines.rules import SECOND, USUAL


class Trial:
    """Three lease buckets and a clock. `lease` and `observer` create gateways."""

    def __init__(self) -> None:
        self.clock = HandClock()
        self.buckets = [MemoryBucket(f"lease_{path}") for path in range(3)]
        self.masterships: list[RecordingMastership] = []

    def lease(self, name: str = "a", lock: LifeLock | None = None) -> Lease:
        self.masterships.append(RecordingMastership(self.clock))
        buckets: Any = self.buckets
        return Lease(name, buckets, self.masterships[-1], lock=lock, clock=self.clock)

    def observer(self, name: str = "b") -> Observer:
        buckets: Any = self.buckets
        return Observer(name, buckets, USUAL, self.clock)

    def values(self, name: str = "a") -> list[Any]:
        return [bucket.records[name].value for bucket in self.buckets]

    def store_ends(self, **more: int) -> None:
        """Let another gateway end the session of gateway "a" in all three buckets."""
        for bucket in self.buckets:
            bucket.store("a", {**bucket.records["a"].value, **more, "ended": True, "by": "rogue"})

    def pass_lease(self) -> None:
        """Let as much time pass as a lease is valid."""
        self.clock.pass_s(USUAL.lease / SECOND)


async def renew(lease: Lease) -> None:
    for path in range(3):
        await lease.renew_once(path)


async def look(observer: Observer) -> None:
    for path in range(3):
        await observer.look(path)


async def begun() -> tuple[Trial, Lease]:
    """Return a trial, and a lease whose first session has just started."""
    trial = Trial()
    lease = trial.lease()
    assert await lease.try_to_begin()
    return trial, lease


async def watched() -> tuple[Trial, Lease, Observer]:
    """Return a trial, a lease with a session, and an observer that has read the session's records."""
    trial, lease = await begun()
    observer = trial.observer()
    await look(observer)
    return trial, lease, observer


async def test_new_lease_starts_when_the_request_is_sent() -> None:
    trial = Trial()
    for bucket in trial.buckets:
        bucket.before_put = lambda key: trial.clock.pass_s(0.25)  # the request takes 0.25 s
    lease, began = trial.lease(), trial.clock.now
    assert await lease.try_to_begin()
    assert lease.session == 1
    # the lease needs two records; the second request was sent after 0.25 s
    assert lease.until <= began + 0.25 * SECOND + USUAL.lease
    assert trial.masterships[0].until == lease.until


async def test_renewed_lease_starts_when_the_renewal_is_sent() -> None:
    trial, lease = await begun()
    trial.clock.pass_s(1)
    sent = trial.clock.now
    for bucket in trial.buckets:
        bucket.before_put = lambda key: trial.clock.pass_s(0.25)
    await lease.renew_once(0)
    await lease.renew_once(1)
    assert lease.until == trial.masterships[0].until == sent + USUAL.lease


async def test_unanswered_lease_record_counts_after_the_next_renewal() -> None:
    """The answer to a request was lost, so the lease does not know which request wrote the lease record."""
    trial = Trial()
    trial.buckets[2].loses_answers = True
    lease, began = trial.lease(), trial.clock.now
    assert await lease.try_to_begin()
    trial.buckets[2].loses_answers = False
    trial.clock.pass_s(1)
    await lease.renew_once(2)  # reads the record that the unanswered request has stored
    assert lease.held[2] is not None
    trial.clock.pass_s(0.5)
    await lease.renew_once(1)
    assert lease.until == began + USUAL.lease
    await lease.renew_once(2)
    assert lease.until == began + 1.5 * SECOND + USUAL.lease


async def test_lease_counts_from_the_second_newest_of_three_renewals() -> None:
    trial, lease = await begun()
    began = trial.clock.now
    trial.clock.pass_s(1)
    await lease.renew_once(0)
    assert lease.until == began + USUAL.lease
    trial.clock.pass_s(1)
    await lease.renew_once(1)
    assert lease.until == began + SECOND + USUAL.lease


async def test_lease_survives_one_lost_server_but_not_two() -> None:
    trial, lease = await begun()
    trial.buckets[1].is_down = True
    for _ in range(20):
        trial.clock.pass_s(0.5)
        await renew(lease)
        assert lease.is_valid
    trial.buckets[2].is_down = True
    for _ in range(6):
        trial.clock.pass_s(0.5)
        await renew(lease)
    assert not lease.is_valid
    trial.buckets[1].is_down = False  # no gateway has ended this lease record, so the session continues
    await renew(lease)
    assert lease.is_valid
    assert lease.session == 1


def test_a_failed_renewal_is_retried_soon() -> None:
    """A lease record is renewed as soon as its bucket has a leader again."""

    async def main() -> None:
        loop = asyncio.get_running_loop()
        trial = Trial()
        lease = trial.lease()
        assert await lease.try_to_begin()
        lease.clock = lambda: round(loop.time() * SECOND)
        tried: list[float] = []
        begun = loop.time()
        trial.buckets[0].before_put = lambda key: tried.append(round(loop.time() - begun, 3))
        renewing = asyncio.create_task(lease.renew(0))
        await asyncio.sleep(0.7)
        trial.buckets[0].is_down = True
        await asyncio.sleep(0.55)
        trial.buckets[0].is_down = False
        await asyncio.sleep(0.8)
        renewing.cancel()
        assert tried == [0.0, 0.5, 1.0, 1.1, 1.2, 1.3, 1.8]

    run_controlled(main())


async def test_an_unanswered_renewal_does_not_extend_the_lease() -> None:
    trial, lease = await begun()
    until = lease.until
    for bucket in trial.buckets:
        bucket.loses_answers = True
    trial.clock.pass_s(1)
    for _ in range(2):
        await renew(lease)
        lease._extend()  # called after each successful renewal
        assert lease.until == until
    for bucket in trial.buckets:
        bucket.loses_answers = False
    await renew(lease)
    assert lease.until == until + SECOND


async def test_a_late_answer_to_an_earlier_session_does_not_extend_the_lease() -> None:
    trial, lease = await begun()
    trial.clock.pass_s(1)

    async def end_meanwhile() -> None:
        trial.buckets[0].before_put = lambda key: None
        await lease.end()

    ending: list[asyncio.Task[None]] = []
    trial.buckets[0].before_put = lambda key: ending.append(asyncio.ensure_future(end_meanwhile()))
    await lease.renew_once(0)
    await ending[0]
    assert lease.until == 0
    assert not lease.is_valid


async def test_session_ends_even_if_the_last_renewal_is_stored_late() -> None:
    """If the late renewal prevented the end, other gateways would wait until the lease expires."""
    trial, lease = await begun()
    for bucket, value in zip(trial.buckets, trial.values(), strict=True):
        bucket.store("a", value)
    await lease.end()
    assert [value["ended"] for value in trial.values()] == [True, True, True]
    assert await trial.lease().try_to_begin()


@pytest.mark.parametrize("later", [{"nonce": "another's"}, {"ended": True, "by": "b"}])
async def test_ending_a_session_keeps_records_written_by_others(later: dict[str, Any]) -> None:
    trial, lease = await begun()
    trial.buckets[0].store("a", {**trial.values()[0], **later})
    await lease.end()
    assert [value["ended"] for value in trial.values()] == [later.get("ended", False), True, True]
    assert trial.buckets[0].records["a"].value.get("by") == later.get("by")


async def test_an_unanswered_renewal_does_not_extend_an_ended_session() -> None:
    """If the lease were extended, the engine might send again, and the kernel's timer would run."""
    trial = Trial()
    gates = [GatedBucket(f"lease_{path}", answers=True) for path in range(3)]
    trial.buckets = [*gates]
    lease = trial.lease()
    assert await lease.try_to_begin()
    trial.clock.pass_s(1)
    for bucket in gates:
        bucket.shut()
    renewals = [asyncio.create_task(lease.renew_once(path)) for path in range(3)]
    await asyncio.gather(*(bucket.arrived.wait() for bucket in gates))
    await lease.end()
    for bucket in gates:
        bucket.open()
    await asyncio.gather(*renewals)
    assert (lease.until, lease.held) == (0, [None, None, None])
    assert trial.masterships[0].events == ["extend", "end"]


async def test_a_late_answer_to_an_ended_session_does_not_extend_the_next_session() -> None:
    trial = Trial()
    late = GatedBucket("lease_2", answers=True)
    trial.buckets[2] = late
    late.is_down = True
    lease = trial.lease()
    assert await lease.try_to_begin()
    late.is_down = False
    late.shut()
    taking = asyncio.create_task(lease.renew_once(2))
    await late.arrived.wait()
    await lease.end()
    assert await lease.try_to_begin()
    before = lease.held[2]
    late.open()
    await taking
    assert trial.values()[2]["session"] == 1
    assert before is None
    assert lease.held[2] is None


async def test_lease_is_invalid_if_the_timer_deadline_has_already_passed() -> None:
    """The engine refuses a timer whose deadline has passed, because it would kill the process."""

    class StandingStill(RecordingMastership):
        def extend(self, until_ns: int) -> None:
            self.clock.pass_s(3)
            raise ValueError("past")

    trial = Trial()
    lease = trial.lease()
    lease._mastership = StandingStill(trial.clock)
    assert await lease.try_to_begin()
    await renew(lease)
    assert lease.until == 0
    assert not lease.is_valid


async def test_session_numbers_continue_from_the_lease_record_after_a_reboot() -> None:
    """A clock would give lower numbers after a reboot, because CLOCK_BOOTTIME restarts."""
    trial, lease = await begun()
    await lease.end()
    trial.clock.now = 3 * SECOND
    after = trial.lease()
    assert await after.try_to_begin()
    assert after.session == 2
    assert [value["session"] for value in trial.values()] == [2, 2, 2]


async def test_no_session_number_is_reused_even_if_lease_records_are_wrong() -> None:
    """If a number were reused, other gateways could claim lines that the new session polls."""
    trial = Trial()
    lease = trial.lease()
    for number in (1, 2, 3):
        assert await lease.try_to_begin()
        assert lease.session == number
        old = trial.values()[0]
        await lease.end()
    for bucket in trial.buckets:
        bucket.store("a", {**old, "session": 1, "ended": True})
    assert await lease.try_to_begin()
    assert lease.session == 4
    await lease.end()
    for bucket in trial.buckets:
        bucket.store("a", None)  # an invalid record is read as None
    after, newest = trial.lease(), trial.buckets[0].last  # the lease of a restarted process
    assert not await after.try_to_begin()
    trial.pass_lease()
    assert await after.try_to_begin()
    assert after.session == newest + 1 > 4


async def test_a_second_gateway_with_the_same_name_waits_until_the_first_lease_expires() -> None:
    trial, first = await begun()
    second = trial.lease()
    for _ in range(10):
        trial.clock.pass_s(0.5)
        await renew(first)
        assert not await second.try_to_begin()
    assert "a gateway called a runs on" in second.trouble
    assert not await second.try_to_begin()
    trial.clock.pass_s(USUAL.lease / SECOND - 0.01)
    assert not await second.try_to_begin()
    trial.clock.pass_s(0.02)
    assert not first.is_valid
    assert await second.try_to_begin()
    assert second.session == 2
    await renew(first)
    assert first.is_over
    assert not first.is_valid


async def test_no_session_starts_if_only_one_lease_record_is_free() -> None:
    """A waiting gateway of the same name must not take one lease record after another."""
    trial, first = await begun()
    second = trial.lease()
    for _ in range(8):
        assert not await second.try_to_begin()
        trial.clock.pass_s(0.5)
        await first.renew_once(0)
        await first.renew_once(2)
    assert [value["nonce"] for value in trial.values()] == [first._nonce] * 3
    assert first.is_valid


async def test_only_one_of_two_simultaneous_sessions_is_valid() -> None:
    trial = Trial()
    first, second = trial.lease(), trial.lease()
    begun = await asyncio.gather(first.try_to_begin(), second.try_to_begin())
    assert sum(begun) == 1
    assert [first.is_valid, second.is_valid] == begun


async def test_a_starting_session_replaces_no_record_of_a_living_session() -> None:
    """The first session renews lease record 2, and record 0 right before the second session replaces it."""
    trial = Trial()
    gate = trial.buckets[0] = GatedBucket("lease_0")
    first, second = trial.lease(), trial.lease()
    assert await first.try_to_begin()
    for _ in range(5):
        assert not await second.try_to_begin()
        trial.clock.pass_s(0.5)
        await first.renew_once(2)
    assert not first.is_valid
    gate.shut()
    beginning = asyncio.create_task(second.try_to_begin())
    await gate.arrived.wait()
    await first.renew_once(0)
    await second.renew_once(2)
    gate.open()
    assert not await beginning
    assert first.is_valid
    await renew(first)
    assert first.is_valid
    assert not second.is_valid


async def test_released_lock_file_shows_that_the_process_died(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(leases, "machine_id", lambda: "this machine")
    trial = Trial()
    lock = LifeLock(tmp_path / "a.lock")
    assert await trial.lease(lock=lock).try_to_begin()
    with pytest.raises(FleetError, match="another gateway of this machine uses"):
        LifeLock(tmp_path / "a.lock")
    lock.close()  # the kernel does this when a process is killed
    with closing(LifeLock(tmp_path / "a.lock")) as lock:
        again = trial.lease(lock=lock)
        assert await again.try_to_begin()
        assert again.session == 2


@pytest.mark.parametrize(
    ("before", "after", "is_copied"),
    [
        ("this machine", "another machine", True),
        ("this machine", "", True),
        ("", "", True),
        # the same machine, but another lock file at this path, as in two containers
        ("this machine", "this machine", False),
    ],
)
async def test_a_new_or_copied_lock_file_does_not_prove_that_a_process_died(
    before: str, after: str, is_copied: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trial = Trial()
    monkeypatch.setattr(leases, "machine_id", lambda: before)
    with closing(LifeLock(tmp_path / "a.lock")) as lock:
        assert await trial.lease(lock=lock).try_to_begin()
    monkeypatch.setattr(leases, "machine_id", lambda: after)
    if not is_copied:
        (tmp_path / "a.lock").unlink()
    with closing(LifeLock(tmp_path / "a.lock")) as lock:
        assert not await trial.lease(lock=lock).try_to_begin()


async def test_a_lock_of_another_boot_does_not_prove_that_a_process_died(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A copied disk has the same machine id, path and lock id, but not the same boot id of the kernel."""
    trial = Trial()
    machine, boot = tmp_path / "machine-id", tmp_path / "boot_id"
    machine.write_text("copied\n", "utf-8")
    boot.write_text("first\n", "utf-8")
    monkeypatch.setattr(leases, "IDS", (machine, boot))
    lock = LifeLock(tmp_path / "a.lock")
    assert await trial.lease(lock=lock).try_to_begin()
    lock.close()
    boot.write_text("second\n", "utf-8")
    with closing(LifeLock(tmp_path / "a.lock")) as lock:
        assert not await trial.lease(lock=lock).try_to_begin()
        boot.write_text("first\n", "utf-8")
        assert await trial.lease(lock=lock).try_to_begin()


@pytest.mark.parametrize("empty", [0, 1])
def test_machine_id_is_empty_without_a_boot_id(
    empty: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ids = (tmp_path / "machine-id", tmp_path / "boot_id")
    for path in ids:
        path.write_text("something\n", "utf-8")
    monkeypatch.setattr(leases, "IDS", ids)
    assert leases.machine_id() == "something.something"
    ids[empty].write_text("\n", "utf-8")
    assert leases.machine_id() == ""
    ids[empty].unlink()
    assert leases.machine_id() == ""


async def test_observer_ends_a_dead_session_by_the_observers_own_clock() -> None:
    trial, _ = await begun()
    observer = trial.observer()
    trial.clock.pass_s(100)  # an observer that starts late cannot know when the lease record was written
    await look(observer)
    assert observer.dead() == {}
    trial.pass_lease()
    await look(observer)
    await observer.end_the_dead()
    assert observer.is_over("a", 1)
    assert [value["ended"] for value in trial.values()] == [True, True, True]
    assert observer.sessions() == {}


@pytest.mark.parametrize("has_rival", [False, True])
async def test_dead_session_is_ended_even_if_one_bucket_has_no_leader(has_rival: bool) -> None:
    """The server of the third lease record may have died with the gateway."""
    trial, _lease, observer = await watched()
    trial.pass_lease()
    await look(observer)
    asked: list[str] = []

    async def give_no_answer(key: str, value: Any, revision: int) -> int:
        asked.append(key)
        await asyncio.Event().wait()
        return 0

    trial.buckets[0].put = give_no_answer
    if has_rival:
        trial.buckets[1].store("a", {**trial.values()[1], "ended": True, "by": "c"})
    assert await asyncio.wait_for(observer.end_the_dead(), 10)
    assert asked == ["a"]
    await look(observer)
    assert observer.is_over("a", 1)


async def test_gateway_does_not_end_a_session_renewed_just_before_the_write() -> None:
    """The record is renewed between the decision and the write. Reading it in between makes no difference."""
    trial, lease, observer = await watched()
    trial.pass_lease()
    await look(observer)
    judged = observer.dead()["a"]
    await renew(lease)  # the renewal succeeds just before the end is written
    await look(observer)
    assert lease.is_valid
    for path, record in judged.items():
        assert not await observer._end(path, record)
    await observer.end_the_dead()
    assert not observer.is_over("a", 1)
    await renew(lease)
    assert not lease.is_over


async def test_one_renewed_lease_record_shows_that_a_gateway_is_alive() -> None:
    """The observer may decide before it has read the gateway's new records in all buckets."""
    trial, lease, observer = await watched()
    trial.pass_lease()
    await look(observer)
    assert [*observer.dead()] == ["a"]
    await renew(lease)
    for path in range(2):
        observer.paths[path].take(trial.buckets[path].records["a"])
    assert not observer.dead()
    assert not await observer.end_the_dead()


async def test_gateway_does_not_end_its_own_expired_session() -> None:
    """If it wrote its own end, other gateways would treat the session as over without waiting."""
    trial = Trial()
    lease, observer = trial.lease("b"), trial.observer("b")
    assert await lease.try_to_begin()
    await look(observer)
    trial.clock.pass_s(2 * USUAL.lease / SECOND)
    await look(observer)
    assert not await observer.end_the_dead()
    assert not any(value["ended"] for value in trial.values("b"))


async def test_gateway_does_not_end_sessions_immediately_after_an_outage() -> None:
    """After an outage of the servers, gateways must not end each other's sessions."""
    trial, _lease, observer = await watched()
    trial.clock.pass_s(60)
    observer.restart_waits()
    await look(observer)
    await observer.end_the_dead()
    assert not observer.is_over("a", 1)
    trial.pass_lease()
    await look(observer)
    await observer.end_the_dead()
    assert observer.is_over("a", 1)


async def test_ended_session_stays_ended_after_an_outage() -> None:
    """No line may be assigned to a dead gateway after the outage."""
    trial, _lease, observer = await watched()
    trial.pass_lease()
    await look(observer)
    assert await observer.end_the_dead()
    await observer.end_the_dead()
    trial.clock.pass_s(60)
    observer.restart_waits()
    await look(observer)
    assert observer.is_over("a", 1)
    assert observer.sessions() == {}
    second = trial.lease()
    # a new session must wait, because another gateway ended the old one at an unknown time
    assert not await second.try_to_begin()
    trial.pass_lease()
    assert await second.try_to_begin()
    await look(observer)
    assert not observer.is_over("a", second.session)
    assert observer.sessions().keys() == {"a"}


async def test_session_ended_during_an_outage_counts_as_alive_for_one_lease_period() -> None:
    """The gateway may have renewed its session, unseen, right before another gateway wrote the end."""
    trial, _lease, observer = await watched()
    await observer.end_the_dead()
    trial.clock.pass_s(60)
    trial.store_ends()
    await look(observer)  # this read is the first for 60 s
    observer.restart_waits()
    await observer.end_the_dead()
    assert not observer.is_over("a", 1)
    trial.pass_lease()
    assert observer.is_over("a", 1)


async def test_look_returns_true_if_a_session_has_ended_or_has_expired() -> None:
    trial, lease = await begun()
    observer = trial.observer()
    assert [await observer.look(path) for path in range(3)] == [False, False, False]
    await renew(lease)
    assert [await observer.look(path) for path in range(3)] == [False, False, False]
    trial.pass_lease()
    # the session has expired once two of its three lease records are found expired
    assert [await observer.look(path) for path in range(3)] == [False, True, True]
    await observer.end_the_dead()
    assert [await observer.look(path) for path in range(3)] == [False, False, False]
    other = trial.observer("c")
    assert [await other.look(path) for path in range(3)] == [True, True, True]


@table(("since_s", "rests_s"), [(0.0, 0.1), (2.2, 0.1), (2.27, 0.03), (2.3, 0.1), (60.0, 0.1)])
def test_observer_reads_lease_records_again_when_a_lease_may_have_expired(
    since_s: float, rests_s: float
) -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        trial = Trial()
        assert await trial.lease().try_to_begin()
        buckets: Any = trial.buckets
        observer = Observer("b", buckets, USUAL, lambda: round(loop.time() * SECOND))
        await observer.look(0)
        await asyncio.sleep(since_s)
        begun = loop.time()
        await observer.rest(0)
        assert loop.time() - begun == pytest.approx(rests_s, abs=1e-6)

    run_controlled(main())


async def test_observer_declares_no_gateway_dead_while_servers_are_silent() -> None:
    """The observer cannot read renewals while its server is suspended; gateways renew over other servers."""
    trial, _lease, observer = await watched()
    for bucket in trial.buckets:
        bucket.is_down = True
    for _ in range(60):
        trial.clock.pass_s(0.1)
        for path in range(3):
            with pytest.raises(OutcomeUnknown):
                await observer.look(path)
        assert observer.dead() == {}
    for bucket in trial.buckets:
        bucket.is_down = False
    await observer.look(0)
    assert observer.dead() == {}
    await observer.look(1)
    assert observer.dead().keys() == {"a"}


async def test_session_ended_by_another_gateway_is_over_at_lease_expiry() -> None:
    """The end may be wrong: until the lease expires, the session's own gateway may still send."""
    trial = Trial()
    lease, observer, late = trial.lease(), trial.observer(), trial.observer("c")
    assert await lease.try_to_begin()
    await look(observer)
    trial.store_ends(session=9)
    trial.clock.pass_s(1.0)
    await look(observer)
    await look(late)
    assert lease.is_valid
    assert not observer.is_over("a", 1)
    assert not observer.is_over("a", 9)
    # the lease expires now, counted from when the observer saw the last renewal
    trial.clock.pass_s(USUAL.lease / SECOND - 1.0)
    assert observer.is_over("a", 1)
    assert observer.sessions() == {}
    assert not late.is_over("a", 1)
    trial.clock.pass_s(1.0)
    assert late.is_over("a", 1)


async def test_a_session_is_over_immediately_if_its_own_gateway_ends_it() -> None:
    trial, lease, observer = await watched()
    await lease.end()
    await look(observer)
    assert observer.is_over("a", 1)
    assert await trial.lease().try_to_begin()


async def test_new_session_waits_if_another_gateway_ended_the_previous_session() -> None:
    trial, lease = await begun()
    second = trial.lease()
    trial.store_ends()
    assert not await second.try_to_begin()
    assert lease.is_valid
    trial.pass_lease()
    assert await second.try_to_begin()


async def test_session_is_not_ended_if_only_one_lease_record_expired() -> None:
    """If its expired record were ended, the gateway could not renew it for the rest of the session."""
    trial, lease = await begun()
    observer = trial.observer()
    for _ in range(20):
        await look(observer)
        trial.clock.pass_s(0.5)
        await lease.renew_once(0)
        await lease.renew_once(2)
        await look(observer)
        assert observer.dead() == {}


async def test_an_ended_lease_record_stays_ended_for_the_rest_of_its_session() -> None:
    trial, lease = await begun()
    value = trial.values()[1]
    trial.buckets[1].store("a", {**value, "ended": True})
    for _ in range(3):
        await renew(lease)
    assert lease.held[1] is None
    assert trial.values()[1]["ended"]
    assert lease.is_valid


async def test_a_session_with_only_two_valid_lease_records_is_reported_as_weak() -> None:
    trial, lease, observer = await watched()
    assert (lease.is_weak, observer.weak()) == (False, [])
    trial.buckets[1].store("a", {**trial.values()[1], "ended": True, "by": "b"})
    await renew(lease)
    await look(observer)
    assert lease.is_valid
    assert (lease.is_weak, observer.weak()) == (True, ["a"])
    trial.buckets[1].is_down = True
    assert not await lease.could_be_whole()
    trial.buckets[1].is_down = False
    assert await lease.could_be_whole()
    await lease.end()
    assert await lease.try_to_begin()
    await renew(lease)
    await look(observer)
    assert lease.session == 2
    assert None not in lease.held
    assert (lease.is_weak, observer.weak()) == (False, [])


async def test_missing_lease_record_is_written_when_the_bucket_answers_again() -> None:
    trial = Trial()
    trial.buckets[2].is_down = True
    lease = trial.lease()
    assert await lease.try_to_begin()
    assert lease.held[2] is None
    trial.buckets[2].is_down = False
    await renew(lease)
    assert lease.held[2] is not None


async def test_new_session_replaces_a_dead_sessions_record_of_the_same_number() -> None:
    """Another process of this gateway left the record, and died before it had written a second record."""
    trial = Trial()
    trial.buckets[2].is_down = True
    lease = trial.lease()
    assert await lease.try_to_begin()
    trial.buckets[2].is_down = False
    trial.buckets[2].store("a", {**trial.buckets[0].records["a"].value, "nonce": "of another"})
    await renew(lease)
    assert lease.held[2] is not None
    assert trial.values()[2]["nonce"] == trial.values()[0]["nonce"]


async def test_session_notices_the_end_of_an_unconfirmed_lease_record() -> None:
    trial = Trial()
    trial.buckets[2].loses_answers = True
    lease = trial.lease()
    assert await lease.try_to_begin()
    assert lease.held[2] is None
    trial.buckets[2].loses_answers = False
    trial.buckets[2].store("a", {**trial.values()[2], "ended": True, "by": "b"})
    assert not lease.is_weak
    await renew(lease)
    assert lease.held[2] is None
    assert lease.is_weak


async def test_no_session_starts_without_two_reachable_lease_buckets() -> None:
    trial = Trial()
    trial.buckets[1].is_down = trial.buckets[2].is_down = True
    lease = trial.lease()
    assert not await lease.try_to_begin()
    assert lease.trouble == "1 of 3 lease records can be read, 2 are needed"
