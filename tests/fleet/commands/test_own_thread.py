"""Stops where the system gives no thread: all are sent before any is waited for, and the loop goes on."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from command_desks import desks
from peers import require_module

require_module("nats")

from multidrop.fleet.commands import own_thread  # noqa: E402
from multidrop.fleet.commands.own_thread import AGAIN_S, TURN_S, Answers, begin_stops  # noqa: E402
from multidrop.fleet.commands.words import CommandAnswer, CommandOutcome  # noqa: E402
from multidrop.supervisor import Supervisor  # noqa: E402

STANDS = CommandAnswer(CommandOutcome.DONE, "it stands")
UNKNOWN = CommandAnswer(CommandOutcome.UNKNOWN, "it is not seen to stand")


class Threads(Supervisor):
    """A supervisor that gets so many threads."""

    def __init__(self) -> None:
        super().__init__()
        self.threads = 0
        self.failure: Exception = RuntimeError("can't start new thread")

    def thread(self, name: str, limit_s: float, work: Callable[[], Any]) -> asyncio.Future[Any]:
        if self.threads == 0:
            raise self.failure
        self.threads -= 1
        return super().thread(name, limit_s, work)


@pytest.fixture
def threads(monkeypatch: pytest.MonkeyPatch) -> Threads:
    made = Threads()
    monkeypatch.setattr(own_thread, "supervisor", lambda: made)
    return made


class Motors:
    """Motors whose stops are noted; each is seen to stand once it was sent so many of them."""

    def __init__(self, **stops: int) -> None:
        self.stops = stops
        self.noted: list[tuple[str, float | None]] = []

    def stop(self, name: str, seconds: float | None) -> Answers:
        self.noted.append((name, seconds))
        self.stops[name] -= 1
        return {name: STANDS if self.stops[name] <= 0 else UNKNOWN}

    async def stop_all(self) -> Answers:
        found: Answers = {}
        for answers in await asyncio.gather(*begin_stops([partial(self.stop, name) for name in self.stops])):
            found |= answers
        return found


@pytest.mark.slow
@pytest.mark.parametrize("failure", [RuntimeError("can't start new thread"), MemoryError()])
def test_all_stops_are_sent_before_one_is_waited_for(threads: Threads, failure: Exception) -> None:
    threads.threads, threads.failure = 1, failure
    motors = Motors(a=1, b=3, c=2)
    assert asyncio.run(motors.stop_all()) == {"a": STANDS, "b": STANDS, "c": STANDS}
    without = [noted for noted in motors.noted if noted != ("a", None)]
    assert without == [("b", 0.0), ("c", 0.0), ("b", TURN_S), ("c", TURN_S), ("b", TURN_S)]


@pytest.mark.slow
def test_the_loop_goes_on_and_a_thread_that_comes_free_is_taken(threads: Threads) -> None:
    motors = Motors(a=3, b=2)
    turns = 0

    async def main() -> Answers:
        nonlocal turns
        stopping = asyncio.create_task(motors.stop_all())
        while not stopping.done():
            turns += 1
            threads.threads = 2 * (len(motors.noted) >= 3)
            await asyncio.sleep(AGAIN_S / 10)
        return stopping.result()

    assert asyncio.run(main()) == {"a": STANDS, "b": STANDS}
    assert motors.noted[:3] == [("a", 0.0), ("b", 0.0), ("a", TURN_S)]
    assert sorted(motors.noted[3:]) == [("a", None), ("b", None)]
    assert turns > 2


def test_a_stop_that_is_never_seen_is_told_so_in_the_end(
    threads: Threads, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(own_thread, "STOP_S", 0.0)
    motors = Motors(a=1000)
    assert asyncio.run(motors.stop_all()) == {"a": UNKNOWN}
    assert motors.noted == [("a", 0.0)]


@pytest.mark.slow
def test_a_motor_is_stopped_without_a_thread(threads: Threads, tmp_path: Path) -> None:
    with desks(tmp_path) as desk:
        stopped = asyncio.run(desk.stop(drives=["pump"]))
    assert stopped is not None
    assert stopped.is_done
    assert {name for name, _ in desk.writes} == {"control"}
