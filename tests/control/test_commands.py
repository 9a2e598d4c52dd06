"""Commands that a server sends to a drive: their results, and stops if no thread can be started."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Sequence
from functools import partial
from math import inf
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from controlled_loop import run_controlled
from fleets import desks
from lines import PATIENCE
from simulated_bus import SimulatedBus, is_write, one
from tables import table

from multidrop import InnovertIBD, InvtCHE
from multidrop.control import commands
from multidrop.control.commands import (
    AGAIN_S,
    BEGINNING_S,
    JOIN_S,
    MOST_STOPS,
    REPEATED_S,
    TURN_S,
    JoinedStops,
    LineStop,
    RepeatedStops,
    Results,
    StopFuture,
    StopWork,
    begin_command,
    begin_stops,
    carry_out_verb,
    stop_drive,
    stop_line,
    write_register,
)
from multidrop.control.outcome import CommandOutcome, CommandResult
from multidrop.errors import NotAttached
from multidrop.sim import simulated
from multidrop.supervisor import Supervisor

STANDS = CommandResult(CommandOutcome.DONE, "it stands")
UNKNOWN = CommandResult(CommandOutcome.UNKNOWN, "it is not seen to stand")


Stop = Callable[[InnovertIBD], Results]
STOPS: dict[str, Stop] = {
    "the line": lambda drive: stop_line(lambda: drive.bus, [drive.name], None),
    "the drive": lambda drive: stop_drive(drive, None),
}


@table("way", STOPS)
def test_the_outcome_of_a_stop_depends_on_the_reply(way: str) -> None:
    _, drive, _ = one(InnovertIBD(1))
    assert STOPS[way](drive)[drive.name].ok
    line, drive, _ = one(InnovertIBD(1))
    line.loses = is_write
    assert STOPS[way](drive)[drive.name].outcome is CommandOutcome.UNKNOWN

    line, drive, _ = one(InnovertIBD(1))
    line.refuses = lambda request: 1 if is_write(request) else 0
    result = STOPS[way](drive)[drive.name]
    assert result.outcome is CommandOutcome.FAILED
    assert "refuses" in result.text
    assert line.written


def test_stopping_a_removed_line_returns_unknown_for_each_drive() -> None:
    def gone() -> None:
        raise KeyError("hall")

    assert [one.outcome for one in stop_line(gone, ["a", "b"], None).values()] == [CommandOutcome.UNKNOWN] * 2


def test_stopping_a_removed_drive_returns_not_sent() -> None:
    line = SimulatedBus(simulated(InvtCHE(1)))
    found = stop_line(lambda: line.bus, ["gone"], None)
    assert found["gone"].outcome is CommandOutcome.NOT_SENT
    assert isinstance(found["gone"].error, NotAttached)


def test_a_command_to_an_unattached_drive_is_not_sent() -> None:
    drive = InvtCHE(1, name="mill", maximum_frequency=50)
    for result in (carry_out_verb(drive, "start", {}), write_register(drive, "setpoint", 10.0)):
        assert result.outcome is CommandOutcome.NOT_SENT
        assert result.text.startswith("mill is ")


@pytest.mark.parametrize(
    ("value", "outcome", "text"),
    [
        (10.0, CommandOutcome.DONE, "mill: setpoint = 10"),
        (inf, CommandOutcome.REFUSED, "mill: setpoint"),
        ("ten", CommandOutcome.REFUSED, "setpoint"),
    ],
)
def test_write_register_returns_a_result_instead_of_raising(
    value: Any, outcome: CommandOutcome, text: str
) -> None:
    _, mill, _ = one(InvtCHE(1, name="mill", maximum_frequency=50))
    result = write_register(mill, "setpoint", value)
    assert result.outcome is outcome, result
    assert result.text.startswith(text)
    assert (result.error is None) == result.ok


def test_write_register_reports_another_value_of_the_drive_and_a_lost_reply() -> None:
    line, drive, _ = one(InnovertIBD(1, name="mill"))
    taken = write_register(drive, "acceleration_time", 6000.0)
    assert (taken.outcome, taken.held) == (CommandOutcome.FAILED, "3600.0 s")
    assert taken.text == "mill: acceleration_time = 6000.0 s: taken as 3600.0 s"
    line.loses = is_write
    lost = write_register(drive, "frequency", 20.0)
    assert (lost.outcome, lost.held) == (CommandOutcome.UNKNOWN, "")
    assert "unconfirmed: mill: " in lost.text


class Threads(Supervisor):
    """A supervisor that can start only `threads` threads; then it raises `failure`."""

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
    monkeypatch.setattr(commands, "supervisor", lambda: made)
    return made


class Motors:
    """Motors that record their stops; each is at rest after the given number of stops."""

    def __init__(self, **stops: int) -> None:
        self.stops = stops
        self.noted: list[tuple[str, float | None]] = []

    def stop(self, name: str, seconds: float | None) -> Results:
        self.noted.append((name, seconds))
        self.stops[name] -= 1
        return {name: STANDS if self.stops[name] <= 0 else UNKNOWN}

    async def stop_all(self) -> Results:
        found: Results = {}
        for answers in await asyncio.gather(*begin_stops([partial(self.stop, name) for name in self.stops])):
            found |= answers
        return found


@pytest.mark.slow
@pytest.mark.parametrize("failure", [RuntimeError("can't start new thread"), MemoryError()])
async def test_all_stops_are_sent_before_any_is_repeated(threads: Threads, failure: Exception) -> None:
    """The system has no thread for the stops of two drives."""
    threads.threads, threads.failure = 1, failure
    motors = Motors(a=1, b=3, c=2)
    assert await motors.stop_all() == {"a": STANDS, "b": STANDS, "c": STANDS}
    without = [noted for noted in motors.noted if noted != ("a", None)]
    assert without == [("b", 0.0), ("c", 0.0), ("b", TURN_S), ("c", TURN_S), ("b", TURN_S)]


@pytest.mark.slow
def test_the_event_loop_continues_while_stops_run_without_threads(threads: Threads) -> None:
    motors = Motors(a=3, b=2)
    turns = 0

    async def main() -> Results:
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


async def test_a_stop_returns_unknown_if_the_motor_does_not_stop(
    threads: Threads, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(commands, "STOP_S", 0.0)
    motors = Motors(a=1000)
    assert await motors.stop_all() == {"a": UNKNOWN}
    assert motors.noted == [("a", 0.0)]


@pytest.mark.slow
@pytest.mark.usefixtures("_patient")
async def test_a_motor_is_stopped_even_if_no_thread_can_be_started(threads: Threads, tmp_path: Path) -> None:
    with desks(tmp_path) as desk:
        stopped = await desk.stop(drives=["pump"])
    assert stopped is not None
    assert stopped.ok
    assert {name for name, _ in desk.writes} == {"control"}


def test_a_command_is_not_sent_if_no_thread_can_be_started(threads: Threads) -> None:
    async def main() -> CommandResult:
        return await begin_command(lambda: STANDS, lambda: inf, lambda: None)

    result = asyncio.run(main())
    assert result.outcome is CommandOutcome.NOT_SENT
    assert result.text == "can't start new thread"


async def test_a_stop_in_the_event_loop_continues_if_its_caller_is_cancelled(threads: Threads) -> None:
    motors = Motors(a=2)

    (stopping,) = begin_stops([partial(motors.stop, "a")])
    await asyncio.sleep(0)
    stopping.cancel()
    while len(motors.noted) < 2:
        await asyncio.sleep(0.01)
    assert motors.noted == [("a", 0.0), ("a", TURN_S)]


SILENT = CommandResult(CommandOutcome.UNKNOWN, "no reply")


async def until_met(met: Callable[[], bool]) -> None:
    async with asyncio.timeout(PATIENCE):
        while not met():
            await asyncio.sleep(0.002)


class NotedStops:
    """A drive that records its stops. Each stop lasts until the test releases it."""

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


async def test_a_second_stop_is_sent_once_while_the_first_is_repeated() -> None:
    pump, stops = NotedStops(), RepeatedStops(stop_noted, on_threads)
    drive: Any = pump
    repeated = asyncio.get_running_loop().create_future()
    stops.note([drive], repeated)
    called = [stops.send_once(drive) for _ in range(5)]
    # The first call sends a stop; the other four share the next stop.
    await until_met(lambda: pump.calls == [0.0])
    pump.turns.release()
    await until_met(lambda: pump.calls == [0.0, 0.0])
    called.append(stops.send_once(drive))  # too late for the second stop: needs a third
    pump.turns.release(2)
    await until_met(lambda: pump.calls == [0.0, 0.0, 0.0] and not stops._sent)
    await asyncio.sleep(0.05)  # now all calls wait for the result of the repeated stop
    assert not any(one.done() for one in called)
    called[1].cancel()  # the client disconnected
    repeated.set_result({"pump": STANDS})
    assert all([(await one)["pump"].ok for one in called if one is not called[1]])
    assert stops.of(drive) is None


async def test_a_second_stop_is_repeated_after_the_first_has_given_up() -> None:
    pump, stops = NotedStops(), RepeatedStops(stop_noted, on_threads)
    drive: Any = pump
    before = asyncio.get_running_loop().create_future()
    stops.note([drive], before)
    pump.turns.release()
    stops.send_once(drive).cancel()  # the client disconnected; its stop continues
    called = stops.send_once(drive)
    pump.turns.release()
    await until_met(lambda: len(pump.calls) == 2 and not stops._sent)
    await asyncio.sleep(0.05)
    before.set_result({"pump": SILENT})
    await until_met(lambda: pump.calls[-1] is None)  # the earlier stop gave up: now this one is repeated
    assert pump.calls.count(None) == 1  # both calls share one repeated stop
    pump.turns.release()
    assert (await called)["pump"].ok is False


def test_a_repeated_stop_is_found_only_while_in_progress() -> None:
    async def live() -> None:
        pump, stops = NotedStops(), RepeatedStops(stop_noted, on_threads)
        drive: Any = pump
        assert stops.of(drive) is None
        repeated = asyncio.get_running_loop().create_future()
        pump.under_way = {}
        stops.note([drive], repeated)
        # The stop counts as in progress before its thread has started.
        assert stops.of(drive) is repeated
        await asyncio.sleep(0.9 * BEGINNING_S)
        assert stops.of(drive) is repeated
        await asyncio.sleep(0.2 * BEGINNING_S)
        assert stops.of(drive) is None  # this drive's stop is over; those of the other drives continue
        pump.under_way = {"pump": "no stop was sent yet"}
        await asyncio.sleep(20.0)
        assert stops.of(drive) is repeated
        bus, drive.bus = pump.bus, None
        assert stops.of(drive) is None  # the drive was detached
        drive.bus = bus
        repeated.set_result({"pump": STANDS})
        assert stops.of(drive) is None

    run_controlled(live())


def test_drives_with_and_without_a_repeated_stop_are_separated() -> None:
    async def live() -> None:
        stops = RepeatedStops(stop_noted, on_threads)
        drives: list[Any] = [NotedStops(), NotedStops(), NotedStops()]
        repeated = asyncio.get_running_loop().create_future()
        stops.note(drives[:2], repeated)
        assert stops.divided(iter(drives)) == ([drives[2]], drives[:2])
        repeated.set_result({})
        assert stops.divided(drives) == (drives, [])
        stops.note([drives[2]], asyncio.get_running_loop().create_future())
        assert set(stops._repeated) == {drives[2]}  # finished stops are forgotten

    run_controlled(live())


def test_a_line_stop_is_split_if_one_drive_is_already_being_stopped() -> None:
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
    """Stops that take 1 s each on the event loop's clock. The first `given_up` repeated stops fail."""

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
        """Return the result of a stop called while a repeated stop gives up after `seconds`."""
        repeated = asyncio.get_running_loop().create_future()
        self.stops.note([self._drive], repeated)
        called = self.stops.send_once(self._drive)
        assert len(self.stops._tasks) == 1  # asyncio itself holds no reference to the task
        asyncio.get_running_loop().call_later(seconds, repeated.set_result, {"pump": SILENT})
        told = (await called)["pump"]
        assert not self.stops._tasks
        return told


def test_a_second_stop_succeeds_after_the_first_has_given_up() -> None:
    timed = TimedStops(NotedStops(), 0)
    assert run_controlled(timed.called_beside(10.0)) == STANDS
    assert timed.calls == [0.0, None]


def test_a_second_stop_is_not_repeated_after_the_time_limit() -> None:
    timed = TimedStops(NotedStops(), 0)
    assert run_controlled(timed.called_beside(REPEATED_S + 1)) == SILENT
    assert timed.calls == [0.0]


def test_excess_stop_requests_share_one_later_stop() -> None:
    async def main() -> None:
        stops, begun, silent = JoinedStops(), list[int](), asyncio.Event()

        async def stop(number: int) -> int:
            begun.append(number)
            await silent.wait()
            return number

        def begin(number: int, drive: str = "pump") -> asyncio.Future[int]:
            return stops.begin(drive, lambda: asyncio.ensure_future(stop(number)))

        called = [*map(begin, range(MOST_STOPS + 3)), begin(-1, "fan")]
        await asyncio.sleep(JOIN_S / 2)
        assert begun == [*range(MOST_STOPS), -1]
        await asyncio.sleep(JOIN_S)
        assert begun == [*range(MOST_STOPS), -1, MOST_STOPS]
        silent.set()
        assert await asyncio.gather(*called) == [*range(MOST_STOPS), *[MOST_STOPS] * 3, -1]
        assert not stops._running

    run_controlled(main())
