"""Drives are attached and detached on any thread: their calls are cancelled, and their stops awaited."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from time import sleep
from typing import Any
from weakref import ref

import pytest
from lines import until
from simulated_bus import SimulatedBus, che_drives, one

from multidrop.core import Message
from multidrop.drive import Drive
from multidrop.errors import CancelledByStop, NotAttached, PortLost
from multidrop.families import InvtCHE
from multidrop.sim import simulated
from multidrop.transport.aside_log import flush_log


class RunningPair:
    """A simulated bus with two drives whose motors turn."""

    def __init__(self) -> None:
        self.line, self.drives, self.sims = che_drives(2, runs_s=10)
        self.bus = self.line.bus
        self.line.frames.clear()

    @property
    def turning(self) -> list[bool]:
        return [bool(sim.motor.goal) for sim in self.sims]


@pytest.fixture
def pair() -> Iterator[RunningPair]:
    made = RunningPair()
    yield made
    made.bus.close()


def test_a_bus_shows_whether_it_stops_drives_on_exit(pair: RunningPair) -> None:
    assert pair.bus.stops_on_exit is False
    pair.bus.stop_on_exit()
    assert pair.bus.stops_on_exit is True
    line = SimulatedBus(simulated(InvtCHE(1)), stop_on_exit=True)
    assert line.bus.stops_on_exit is True
    line.bus.close()


def test_leave_stops_all_drives_immediately(pair: RunningPair) -> None:
    pair.bus.stop_on_exit()
    pair.bus.leave()
    until(lambda: pair.turning == [False, False])


def test_leave_sends_no_stop_by_default(pair: RunningPair) -> None:
    pair.bus.leave()
    pair.bus.part()
    assert pair.turning == [True, True]
    assert pair.line.frames == []


def test_detached_drives_are_stopped_if_stop_on_exit_was_called(
    pair: RunningPair, caplog: pytest.LogCaptureFixture
) -> None:
    first, second = pair.drives
    begun = [drive.begin_call("start", drive.stops_called[0]) for drive in pair.drives]
    pair.bus.part_with([first], [first])
    assert pair.line.frames == []
    assert [call.permit.is_good for call in begun] == [False, True]
    pair.bus.stop_on_exit()
    pair.bus.part_with([first], [])
    assert pair.line.frames == []
    pair.bus.part_with([first], [first])
    assert pair.turning == [False, True]
    for act in (first.start, first.jog, lambda: first.set_frequency(10)):
        with pytest.raises(CancelledByStop, match="the drive was taken off the bus"):
            act()
    assert [record for record in caplog.records if record.levelno >= logging.WARNING] == []

    pair.line.fails = lambda request: PortLost("hall", "there is no such port")
    pair.bus.part_with([second], [second])
    flush_log(60)
    told = [record.getMessage() for record in caplog.records if record.name == "multidrop.bus"]
    assert len(told) == 1
    assert told[0].startswith("invt-che@2: failed after 30")  # the port was lost, so no stop was sent
    pair.line.fails = lambda request: None


def test_a_start_is_cancelled_while_the_drive_is_being_detached(pair: RunningPair) -> None:
    """The drive's start is called at the moment when the first request of its stop is sent."""
    pair.bus.stop_on_exit()
    first = pair.drives[0]
    permits: list[bool] = []

    def note(request: Message) -> bytes | None:
        permits.append(first.begin_call("start", first.stops_called[0]).permit.is_good)
        return None

    pair.line.answers = note
    pair.bus.part_with([first], [first])
    permits.append(first.begin_call("start", first.stops_called[0]).permit.is_good)
    assert set(permits) == {False}
    assert pair.turning == [False, True]
    pair.line.answers = lambda request: None


def test_detaching_drives_waits_for_their_stops(pair: RunningPair, monkeypatch: pytest.MonkeyPatch) -> None:
    waited: list[list[Any]] = []
    monkeypatch.setattr(pair.bus._latches, "await_stops", lambda *drives: waited.append([*drives]))
    pair.bus.part_with(pair.drives, [])
    assert waited == [[pair.drives]]


@pytest.mark.parametrize("is_cut_short", [False, True])
def test_closing_a_bus_waits_for_stops_unless_repeated_signals_end_the_wait(
    pair: RunningPair, monkeypatch: pytest.MonkeyPatch, is_cut_short: bool
) -> None:
    pair.bus.stop_on_exit()
    waited: list[object] = []
    monkeypatch.setattr(pair.bus._latches, "await_stops", lambda *drives: waited.append(drives))
    task = pair.bus._leaving._exit_task
    assert task is not None
    until_over = task.finish

    def finish() -> None:
        until_over()
        task.is_cut_short = is_cut_short

    monkeypatch.setattr(task, "finish", finish)
    pair.bus.part()
    assert pair.turning == [False, False]
    assert waited == ([] if is_cut_short else [()])


def test_a_bus_with_stop_on_exit_can_only_be_made_on_the_main_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    closed: list[bool] = []
    monkeypatch.setattr(SimulatedBus, "close", lambda self: closed.append(True))
    with ThreadPoolExecutor(1) as threads:
        made = threads.submit(SimulatedBus, simulated(InvtCHE(1)), stop_on_exit=True)
        with pytest.raises(ValueError, match="main thread"):
            made.result()
    assert closed


def test_attaching_a_drive_of_another_open_bus_raises() -> None:
    line, drive, _ = one(InvtCHE(1))
    other = SimulatedBus()
    with pytest.raises(ValueError, match=r"invt-che@1 is on the bus at hall: detach it there first"):
        other.attach(drive)
    assert other.bus.drives == []
    drive.state()  # the drive still uses the first bus
    line.bus.detach(drive)
    other.attach(drive)
    other.bus.close()
    line.attach(drive)  # closing the other bus has detached the drive


def test_a_drive_can_be_attached_to_a_new_bus_before_the_old_closes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Once the first bus is closed completely, the drive is still attached to the second bus."""
    line, drive, sim = one(InvtCHE(1, maximum_frequency=50))
    before = line.bus
    free = before._attached.free
    monkeypatch.setattr(before._attached, "free", lambda: None)
    before.close()
    after = SimulatedBus(sim)
    after.attach(drive)
    free()
    assert drive.bus is after.bus
    with pytest.raises(ValueError, match="is on the bus at hall: detach it there first"):
        SimulatedBus().attach(drive)
    drive.stop()
    assert line.written == []
    assert len(after.written) == 1


def test_a_drive_detached_by_another_thread_is_not_detached_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, _ = one(InvtCHE(1))
    latches = line.bus._latches
    await_stops = latches.await_stops

    def detach_meanwhile(drives: Any = None) -> None:
        monkeypatch.setattr(latches, "await_stops", await_stops)
        line.bus.detach(drive)

    monkeypatch.setattr(latches, "await_stops", detach_meanwhile)
    with pytest.raises(NotAttached, match="is not attached"):
        line.bus.detach(drive)
    line.attach(drive)


def test_closing_a_bus_releases_its_drives() -> None:
    line, drive, _ = one(InvtCHE(1))
    line.bus.close()
    assert drive.bus is None


def test_drives_attached_by_concurrent_threads_are_added_one_at_a_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    line = SimulatedBus()
    together = threading.Barrier(8)
    add, inside, most = line.bus._exchanges.peers.add, set[str](), 0

    def slow(drive: Drive) -> None:
        nonlocal most
        inside.add(drive.name)
        most = max(most, len(inside))
        sleep(0.001)  # lets the other threads run
        inside.discard(drive.name)
        add(drive)

    monkeypatch.setattr(line.bus._exchanges.peers, "add", slow)
    outcomes: list[str] = []

    def attach(address: int) -> None:
        together.wait(120)
        try:
            line.attach(InvtCHE(address))
            outcomes.append("attached")
        except ValueError:
            outcomes.append("taken")

    for _ in range(20):
        outcomes.clear()
        threads = [threading.Thread(target=attach, args=[1 + number % 4]) for number in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(120)
        assert sorted(outcomes) == ["attached"] * 4 + ["taken"] * 4
        assert sorted(drive.address for drive in line.bus.drives) == [1, 2, 3, 4]
        for drive in line.bus.drives:
            line.bus.detach(drive)
    assert most == 1


def test_a_thread_does_not_wait_for_its_own_interrupted_stop() -> None:
    """Otherwise the exit from a `with` block, by an exception of a signal handler, would never end."""
    line, drive, _ = one(InvtCHE(1))
    latches, stop = line.bus._latches, object()
    latches.begin(stop, [drive])
    latches.await_stops()
    waiting = threading.Thread(target=latches.await_stops, args=[[drive]])
    waiting.start()
    waiting.join(0.05)
    assert waiting.is_alive()
    for _ in range(2):
        latches.over(stop)
    waiting.join(60)
    assert not waiting.is_alive()
    assert latches.latch(drive).permit().is_good


def test_a_drive_attached_after_leave_cannot_be_started() -> None:
    """After `leave`, the process is ending, and could not stop the motor."""
    line, drive, sim = one(InvtCHE(1, maximum_frequency=50))
    line.bus.leave()
    line.bus.detach(drive)
    line.attach(drive)
    for call in (drive.start, drive.jog, lambda: drive.set_frequency(20)):
        with pytest.raises(CancelledByStop, match="the bus was closed"):
            call()
    assert line.written == []
    drive.stop()
    assert line.written != []
    assert not sim.motor.energised


def test_the_memory_of_a_detached_drive_is_freed_immediately() -> None:
    """Memory does not grow if drives change for years, even without a garbage collection."""
    line, drive, _ = one(InvtCHE(1, maximum_frequency=50))
    drive.set_frequency(20)
    drive.stop()
    line.bus.detach(drive)
    assert not line.bus.knows_identity(drive)
    line.sims = ()
    line.frames.clear()
    known = ref(drive)
    del drive, _
    assert known() is None
