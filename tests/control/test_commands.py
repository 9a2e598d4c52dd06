"""Commands of a server on a drive: their results, and stops for which the system has no thread."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import partial
from math import inf
from pathlib import Path
from typing import Any

import pytest
from command_desks import desks
from simulated_bus import SimulatedBus, is_write, one

from multidrop import InnovertIBD, InvtCHE
from multidrop.control import commands
from multidrop.control.command_results import CommandOutcome, CommandResult
from multidrop.control.commands import (
    AGAIN_S,
    TURN_S,
    Results,
    begin_command,
    begin_stops,
    carry_out_verb,
    stop_drive,
    stop_drive_by,
    stop_line,
    write_register,
)
from multidrop.core import Message, build_reply
from multidrop.errors import NotAttached
from multidrop.sim import simulated
from multidrop.supervisor import Supervisor

STANDS = CommandResult(CommandOutcome.DONE, "it stands")
UNKNOWN = CommandResult(CommandOutcome.UNKNOWN, "it is not seen to stand")

# ---- results ----

Stop = Callable[[InnovertIBD], Results]
STOPS: dict[str, Stop] = {
    "the line": lambda drive: stop_line(lambda: drive.bus, [drive.name], None),
    "the drive": lambda drive: stop_drive(drive, None),
    "another verb": lambda drive: stop_drive_by("stop", drive, None),
}


@pytest.mark.parametrize("way", STOPS)
def test_a_refused_stop_has_failed(monkeypatch: pytest.MonkeyPatch, way: str) -> None:
    line, drive, _ = one(monkeypatch, InnovertIBD(1))

    def refuse(request: Message) -> bytes | None:
        if not is_write(request):
            return None
        refusal = Message(request.address, request.function, request.start, exception=1)
        return build_reply(drive.framing, refusal)

    line.answers = refuse
    result = STOPS[way](drive)[drive.name]
    assert result.outcome is CommandOutcome.FAILED
    assert "refuses" in result.text
    assert line.written


@pytest.mark.parametrize("way", STOPS)
def test_an_unconfirmed_stop_is_unknown(monkeypatch: pytest.MonkeyPatch, way: str) -> None:
    line, drive, _ = one(monkeypatch, InnovertIBD(1))
    line.loses = is_write
    assert STOPS[way](drive)[drive.name].outcome is CommandOutcome.UNKNOWN


@pytest.mark.parametrize("way", STOPS)
def test_a_confirmed_stop_is_done(monkeypatch: pytest.MonkeyPatch, way: str) -> None:
    _, drive, _ = one(monkeypatch, InnovertIBD(1))
    assert STOPS[way](drive)[drive.name].is_done


def test_a_stop_of_a_line_that_is_gone_says_so_for_each_drive() -> None:
    def gone() -> None:
        raise KeyError("hall")

    assert [one.outcome for one in stop_line(gone, ["a", "b"], None).values()] == [CommandOutcome.UNKNOWN] * 2


def test_a_drive_that_left_its_line_meanwhile_was_not_sent_a_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    line = SimulatedBus(monkeypatch, simulated(InvtCHE(1)))
    found = stop_line(lambda: line.bus, ["gone"], None)
    assert found["gone"].outcome is CommandOutcome.NOT_SENT
    assert isinstance(found["gone"].error, NotAttached)


def test_commands_to_a_drive_without_a_line_are_not_sent() -> None:
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
def test_a_write_has_a_result_and_never_raises(
    monkeypatch: pytest.MonkeyPatch, value: Any, outcome: CommandOutcome, text: str
) -> None:
    _, mill, _ = one(monkeypatch, InvtCHE(1, name="mill", maximum_frequency=50))
    result = write_register(mill, "setpoint", value)
    assert result.outcome is outcome, result
    assert result.text.startswith(text)
    assert (result.error is None) == result.is_done


# ---- threads ----


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
    monkeypatch.setattr(commands, "supervisor", lambda: made)
    return made


class Motors:
    """Motors whose stops are noted; each is seen to stand once it was sent so many of them."""

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


def test_a_stop_that_is_never_seen_is_told_so_in_the_end(
    threads: Threads, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(commands, "STOP_S", 0.0)
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


def test_without_a_thread_a_command_is_not_sent(threads: Threads) -> None:
    async def main() -> CommandResult:
        return await begin_command(lambda: STANDS, lambda: inf, lambda: None)

    result = asyncio.run(main())
    assert result.outcome is CommandOutcome.NOT_SENT
    assert result.text == "can't start new thread"


def test_stops_without_threads_go_on_if_their_callers_are_cancelled(threads: Threads) -> None:
    motors = Motors(a=2)

    async def main() -> None:
        (stopping,) = begin_stops([partial(motors.stop, "a")])
        await asyncio.sleep(0)
        stopping.cancel()
        while len(motors.noted) < 2:
            await asyncio.sleep(0.01)

    asyncio.run(main())
    assert motors.noted == [("a", 0.0), ("a", TURN_S)]
