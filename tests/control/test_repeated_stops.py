"""Stops of a silent drive that many call: one is repeated, and each is sent once after its call."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, NamedTuple

from lines import PATIENCE

from multidrop.control.repeated_stops import EndedStops, RepeatedStops, StopWork


class Ended(NamedTuple):
    is_done: bool
    text: str


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


def stop_noted(drive: Any, seconds: float | None) -> dict[str, Ended]:
    drive.stop(seconds)
    return {drive.name: Ended(False, "no reply")}


def on_a_thread(work: StopWork[Ended]) -> EndedStops[Ended]:
    return asyncio.get_running_loop().run_in_executor(None, work, None)


def test_a_stop_beside_one_that_is_repeated_is_sent_once_after_its_call() -> None:
    async def live() -> None:
        pump, stops = NotedStops(), RepeatedStops(stop_noted)
        drive: Any = pump
        repeated = asyncio.get_running_loop().create_future()
        stops.note([drive], repeated)
        called = [stops.send_once(drive, on_a_thread) for _ in range(5)]
        await until_met(lambda: pump.calls == [0.0])  # the first one's; the others wait for it, together
        pump.turns.release()
        await until_met(lambda: pump.calls == [0.0, 0.0])
        called.append(stops.send_once(drive, on_a_thread))  # it comes too late for that one
        pump.turns.release(2)
        await until_met(lambda: pump.calls == [0.0, 0.0, 0.0] and not stops._sent)
        await asyncio.sleep(0.05)  # all of them await the one that is repeated
        assert not any(one.done() for one in called)
        called[1].cancel()  # its client is gone
        repeated.set_result({"pump": Ended(True, "stopped")})
        assert all([(await one)["pump"].is_done for one in called if one is not called[1]])
        assert stops.of(drive) is None

    asyncio.run(live())


def test_a_stop_is_repeated_on_where_the_one_beside_it_is_given_up() -> None:
    async def live() -> None:
        pump, stops = NotedStops(), RepeatedStops(stop_noted)
        drive: Any = pump
        before = asyncio.get_running_loop().create_future()
        stops.note([drive], before)
        pump.turns.release()
        stops.send_once(drive, on_a_thread).cancel()  # its client is gone, and it goes on
        called = stops.send_once(drive, on_a_thread)
        pump.turns.release()
        await until_met(lambda: len(pump.calls) == 2 and not stops._sent)
        await asyncio.sleep(0.05)
        before.set_result({"pump": Ended(False, "no reply")})
        await until_met(lambda: pump.calls[-1] is None)  # repeated as if it had been called alone
        assert pump.calls.count(None) == 1  # for both
        pump.turns.release()
        assert (await called)["pump"].is_done is False

    asyncio.run(live())
