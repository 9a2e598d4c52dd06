"""Closing a bus or removing drives: calls that end, stops that are sent and awaited, and the report."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from lines import until
from simulated_bus import SimulatedBus

from multidrop.core import Message
from multidrop.errors import CancelledByStop, PortLost
from multidrop.families import InvtCHE
from multidrop.sim import simulated
from multidrop.transport.aside_log import flush


class RunningPair:
    """A simulated bus with two drives whose motors turn."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.sims: list[Any] = [simulated(InvtCHE(address, maximum_frequency=50)) for address in (1, 2)]
        self.line = SimulatedBus(monkeypatch, *self.sims)
        self.bus = self.line.bus
        self.drives = [self.line.attach(sim.drive) for sim in self.sims]
        for drive in self.drives:
            drive.set_frequency(20)
            drive.start()
        self.line.sleep(10)
        self.line.frames.clear()

    @property
    def turning(self) -> list[bool]:
        return [bool(sim.motor.goal) for sim in self.sims]


@pytest.fixture
def pair(monkeypatch: pytest.MonkeyPatch) -> Iterator[RunningPair]:
    made = RunningPair(monkeypatch)
    yield made
    made.bus.close()


def test_a_bus_says_whether_it_stops_its_drives_at_the_end(pair: RunningPair) -> None:
    assert pair.bus.stops_on_exit is False
    pair.bus.stop_on_exit()
    assert pair.bus.stops_on_exit is True


def test_leaving_a_bus_starts_its_stops_at_once(pair: RunningPair) -> None:
    pair.bus.stop_on_exit()
    pair.bus.leave()
    until(lambda: pair.turning == [False, False])


def test_leaving_a_bus_sends_no_stop_by_default(pair: RunningPair) -> None:
    pair.bus.leave()
    pair.bus.part()
    assert pair.turning == [True, True]
    assert pair.line.frames == []


def test_detached_drives_are_stopped_with_stop_on_exit(
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

    def lose(request: Message) -> bytes | None:
        raise PortLost("hall", "there is no such port")

    pair.line.answers = lose
    pair.bus.part_with([second], [second])
    flush(60)
    told = [record.getMessage() for record in caplog.records if record.name == "multidrop.bus"]
    assert len(told) == 1
    assert told[0].startswith("invt-che@2: failed after 30")  # nothing left for it, nor for all
    pair.line.answers = lambda request: None


def test_a_drive_being_detached_cannot_be_started_after_its_stop(pair: RunningPair) -> None:
    """Its start is called while its stop is under way, as the stop's first request leaves."""
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


def test_detaching_waits_for_other_stops_of_the_drives(
    pair: RunningPair, monkeypatch: pytest.MonkeyPatch
) -> None:
    waited: list[list[Any]] = []
    monkeypatch.setattr(pair.bus._latches, "await_stops", lambda *drives: waited.append([*drives]))
    pair.bus.part_with(pair.drives, [])
    assert waited == [[pair.drives]]


@pytest.mark.parametrize("is_cut_short", [False, True])
def test_a_bus_waits_for_all_stops_unless_they_are_cut_short(
    pair: RunningPair, monkeypatch: pytest.MonkeyPatch, is_cut_short: bool
) -> None:
    pair.bus.stop_on_exit()
    waited: list[object] = []
    monkeypatch.setattr(pair.bus._latches, "await_stops", lambda *drives: waited.append(drives))
    act = pair.bus._leaving._last_act
    assert act is not None
    until_over = act.finish

    def finish() -> None:
        until_over()
        act.is_cut_short = is_cut_short

    monkeypatch.setattr(act, "finish", finish)
    pair.bus.part()
    assert pair.turning == [False, False]
    assert waited == ([] if is_cut_short else [()])


def test_a_bus_that_stops_on_exit_is_made_so(monkeypatch: pytest.MonkeyPatch) -> None:
    line = SimulatedBus(monkeypatch, simulated(InvtCHE(1)), stop_on_exit=True)
    assert line.bus.stops_on_exit
    line.bus.close()


def test_only_the_main_thread_makes_a_bus_that_stops_on_exit(monkeypatch: pytest.MonkeyPatch) -> None:
    closed: list[bool] = []
    monkeypatch.setattr(SimulatedBus, "close", lambda self: closed.append(True))
    with ThreadPoolExecutor(1) as threads:
        made = threads.submit(SimulatedBus, monkeypatch, simulated(InvtCHE(1)), stop_on_exit=True)
        with pytest.raises(ValueError, match="main thread"):
            made.result()
    assert closed
