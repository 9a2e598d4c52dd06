"""Stops of a silent drive that many call: one is repeated, and each is sent once after its call."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

from controlled_loop import run_controlled
from lines import PATIENCE

from multidrop.control.command_results import CommandOutcome, CommandResult
from multidrop.control.commands import (
    BEGINNING_S,
    REPEATED_S,
    LineStop,
    RepeatedStops,
    Results,
    StopFuture,
    StopWork,
)

STANDS = CommandResult(CommandOutcome.DONE, "stopped")
SILENT = CommandResult(CommandOutcome.UNKNOWN, "no reply")


async def until_met(met: Callable[[], bool]) -> None:
    async with asyncio.timeout(PATIENCE):
        while not met():
            await asyncio.sleep(0.002)


class NotedStops:
    """A drive that notes its stops, each of which lasts until it is let go."""

    name = "pump"

    def __init__(self) -> None:
        self.calls: list[float | None] = []
        self.turns = threading.Semaphore(0)
        self.under_way = {"pump": "no stop was sent yet"}
        self.bus = SimpleNamespace(stops_under_way=lambda: self.under_way)

    def stop(self, seconds: float | None) -> None:
        self.calls.append(seconds)
        assert self.turns.acquire(timeout=PATIENCE)


def stop_noted(drive: Any, seconds: float | None) -> Results:
    drive.stop(seconds)
    return {drive.name: SILENT}


def on_threads(works: Sequence[StopWork]) -> list[StopFuture]:
    return [asyncio.get_running_loop().run_in_executor(None, work, None) for work in works]


def test_a_stop_beside_one_that_is_repeated_is_sent_once_after_its_call() -> None:
    async def live() -> None:
        pump, stops = NotedStops(), RepeatedStops(stop_noted, on_threads)
        drive: Any = pump
        repeated = asyncio.get_running_loop().create_future()
        stops.note([drive], repeated)
        called = [stops.send_once(drive) for _ in range(5)]
        await until_met(lambda: pump.calls == [0.0])  # the first one's; the others wait for it, together
        pump.turns.release()
        await until_met(lambda: pump.calls == [0.0, 0.0])
        called.append(stops.send_once(drive))  # it comes too late for that one
        pump.turns.release(2)
        await until_met(lambda: pump.calls == [0.0, 0.0, 0.0] and not stops._sent)
        await asyncio.sleep(0.05)  # all of them await the one that is repeated
        assert not any(one.done() for one in called)
        called[1].cancel()  # its client is gone
        repeated.set_result({"pump": STANDS})
        assert all([(await one)["pump"].is_done for one in called if one is not called[1]])
        assert stops.of(drive) is None

    asyncio.run(live())


def test_a_stop_is_repeated_on_where_the_one_beside_it_is_given_up() -> None:
    async def live() -> None:
        pump, stops = NotedStops(), RepeatedStops(stop_noted, on_threads)
        drive: Any = pump
        before = asyncio.get_running_loop().create_future()
        stops.note([drive], before)
        pump.turns.release()
        stops.send_once(drive).cancel()  # its client is gone, and it goes on
        called = stops.send_once(drive)
        pump.turns.release()
        await until_met(lambda: len(pump.calls) == 2 and not stops._sent)
        await asyncio.sleep(0.05)
        before.set_result({"pump": SILENT})
        await until_met(lambda: pump.calls[-1] is None)  # repeated as if it had been called alone
        assert pump.calls.count(None) == 1  # for both
        pump.turns.release()
        assert (await called)["pump"].is_done is False

    asyncio.run(live())


def test_a_stop_counts_as_repeated_from_its_call_until_its_drive_stands() -> None:
    async def live() -> None:
        pump, stops = NotedStops(), RepeatedStops(stop_noted, on_threads)
        drive: Any = pump
        assert stops.of(drive) is None
        repeated = asyncio.get_running_loop().create_future()
        pump.under_way = {}
        stops.note([drive], repeated)
        assert stops.of(drive) is repeated  # its thread need not have begun
        await asyncio.sleep(0.9 * BEGINNING_S)
        assert stops.of(drive) is repeated
        await asyncio.sleep(0.2 * BEGINNING_S)
        assert stops.of(drive) is None  # it is over, and others of its line are not
        pump.under_way = {"pump": "no stop was sent yet"}
        await asyncio.sleep(20.0)
        assert stops.of(drive) is repeated
        bus, drive.bus = pump.bus, None
        assert stops.of(drive) is None  # it was taken off
        drive.bus = bus
        repeated.set_result({"pump": STANDS})
        assert stops.of(drive) is None

    run_controlled(live())


def test_drives_are_divided_into_those_that_are_begun_and_those_that_are_sent_once_more() -> None:
    async def live() -> None:
        stops = RepeatedStops(stop_noted, on_threads)
        drives: list[Any] = [NotedStops(), NotedStops(), NotedStops()]
        repeated = asyncio.get_running_loop().create_future()
        stops.note(drives[:2], repeated)
        assert stops.divided(iter(drives)) == ([drives[2]], drives[:2])
        repeated.set_result({})
        assert stops.divided(drives) == (drives, [])
        stops.note([drives[2]], asyncio.get_running_loop().create_future())
        assert set(stops._repeated) == {drives[2]}  # a plant is read anew for years

    run_controlled(live())


def test_a_whole_line_is_stopped_at_once_unless_a_drive_of_it_is_being_stopped() -> None:
    async def live() -> None:
        wholes: list[float | None] = []

        def whole(seconds: float | None) -> Results:
            wholes.append(seconds)
            return {"a": STANDS, "b": STANDS}

        drives: list[Any] = [NotedStops(), NotedStops()]
        for drive, name in zip(drives, "ab", strict=True):
            drive.name = name
            drive.turns.release(9)
        stops = RepeatedStops(stop_noted, on_threads)
        (begun,) = stops.begin([LineStop(drives, whole)])
        assert (await begun)["a"] is STANDS
        stops.note(drives[:1], asyncio.get_running_loop().create_future())
        one, again = stops.begin([LineStop(drives, whole)])
        assert await one == {"b": SILENT}
        assert wholes == [None]
        again.cancel()

    asyncio.run(live())


class TimedStops:
    """Stops of a drive that take some seconds of the loop's; the first that are repeated are given up."""

    def __init__(self, drive: Any, given_up: int) -> None:
        self.stops = RepeatedStops(self._stop, self._begin)
        self.calls: list[float | None] = []
        self._drive = drive
        self._given_up = given_up

    def _stop(self, drive: Any, seconds: float | None) -> Results:
        self.calls.append(seconds)
        is_done = seconds is None and self.calls.count(None) > self._given_up
        return {drive.name: STANDS if is_done else SILENT}

    def _begin(self, works: Sequence[StopWork]) -> list[StopFuture]:
        (work,), ended = works, asyncio.get_running_loop().create_future()
        asyncio.get_running_loop().call_later(1.0, ended.set_result, work(None))
        return [ended]

    async def called_beside(self, seconds: float) -> CommandResult:
        """Return the end of one that is called beside another, which is given up after so long."""
        repeated = asyncio.get_running_loop().create_future()
        self.stops.note([self._drive], repeated)
        called = self.stops.send_once(self._drive)
        assert len(self.stops._tasks) == 1  # nothing else holds it
        asyncio.get_running_loop().call_later(seconds, repeated.set_result, {"pump": SILENT})
        told = (await called)["pump"]
        assert not self.stops._tasks
        return told


def test_the_end_of_the_stop_that_took_another_s_place_is_told() -> None:
    timed = TimedStops(NotedStops(), 0)
    assert run_controlled(timed.called_beside(10.0)) == STANDS
    assert timed.calls == [0.0, None]


def test_a_stop_that_was_repeated_for_its_time_by_another_is_not_repeated_again() -> None:
    timed = TimedStops(NotedStops(), 0)
    assert run_controlled(timed.called_beside(REPEATED_S + 1)) == SILENT
    assert timed.calls == [0.0]
