"""Stops while the system fails: signals at any line, no memory, no descriptors, a ledger that others hold."""

from __future__ import annotations

import sqlite3
import threading
from decimal import Decimal
from errno import EMFILE
from fractions import Fraction
from itertools import count
from linecache import getline
from pathlib import Path
from types import CodeType, FrameType, SimpleNamespace
from typing import Any

import pytest
from interruptions import interrupted_at
from own_fan import Fan
from simulated_bus import SimulatedBus, is_write

from multidrop.control import eeprom_ledger, ramp, stop_all
from multidrop.control.eeprom_ledger import Ledger
from multidrop.control.outcome import Seen
from multidrop.control.ramp import start_staggered
from multidrop.control.stop_all import Stopper
from multidrop.control.stop_attempt import LEAST_S, StopAttempt
from multidrop.core import Completion, Exchange
from multidrop.drives import InvtCHE
from multidrop.errors import Refused, Unconfirmed
from multidrop.sim import simulated
from multidrop.transport import clock

CODE = stop_all.stop_together.__code__
STOPPING = ramp._stop.__code__
NO_MEMORY, NO_DESCRIPTORS = MemoryError(), OSError(EMFILE, "Too many open files")


def running(monkeypatch: pytest.MonkeyPatch, count: int = 1) -> tuple[SimulatedBus, list[Any], list[Any]]:
    """Return a simulated bus, its drives, and their simulations, whose motors turn."""
    sims: list[Any] = [simulated(InvtCHE(number, maximum_frequency=50)) for number in range(1, count + 1)]
    line = SimulatedBus(monkeypatch, *sims)
    drives = [line.attach(sim.drive) for sim in sims]
    for drive in drives:
        drive.set_frequency(20)
        drive.start()
    line.sleep(10)
    return line, drives, sims


def writes_to(line: SimulatedBus, address: int) -> int:
    return sum(is_write(request) and request.address == address for request, _ in line.frames)


# ---- signals ----


def counts(frame: FrameType) -> bool:
    """Say whether a signal comes before this line: not before the stops are known, nor once one is over."""
    line = getline(CODE.co_filename, frame.f_lineno).strip()
    return frame.f_code is CODE and not line.startswith(("under_way = list", "try:", "end("))


@pytest.mark.long
def test_wherever_a_stop_of_all_is_interrupted_each_is_sent_once_more_and_told_of(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for nth in range(1, 40):
        line, drives, sims = running(monkeypatch, 2)
        with pytest.raises(KeyboardInterrupt) as interruption, interrupted_at(nth, counts):
            line.bus.stop_all()
        told = "".join(interruption.value.__notes__)
        for drive, sim in zip(drives, sims, strict=True):
            assert f"{drive.name}: the stop was sent" in told, nth
            sim.pass_time(line.seconds + 60)
            assert not sim.motor.energised, nth
        assert not line.bus.stops_under_way()


def first_line(code: CodeType, text: str) -> int:
    """Return the number of the first line of this code that begins so."""
    numbers = (number for _, _, number in code.co_lines() if number is not None)
    return min(number for number in numbers if getline(code.co_filename, number).strip().startswith(text))


@pytest.mark.parametrize("all_of_them", [False, True])
def test_a_stop_that_is_interrupted_as_it_begins_is_sent(
    monkeypatch: pytest.MonkeyPatch, all_of_them: bool
) -> None:
    """Also between its making and its beginning."""
    making, beginning = Stopper._carry_out.__code__, Stopper._carry_out_known.__code__
    since = first_line(making, "with self._under_way")

    def counts(frame: FrameType) -> bool:
        is_before = making.co_firstlineno < frame.f_lineno < since
        return frame.f_code is beginning or (frame.f_code is making and not is_before)

    for nth in count(1):
        line, drives, sims = running(monkeypatch, 2 if all_of_them else 1)
        begun_before = [drive.begin_call("start") for drive in drives]
        try:
            with interrupted_at(nth, counts):
                line.bus.stop_all() if all_of_them else drives[0].stop()
        except KeyboardInterrupt:
            for sim in sims:
                sim.pass_time(line.seconds + 60)
            assert not any(sim.motor.energised for sim in sims), nth
            assert not any(call.permit.is_good for call in begun_before), nth
        else:
            break
    assert nth > 8


def fails_to_start_the_last(line: SimulatedBus, drives: list[Any], sims: list[Any]) -> None:
    """Stop all motors, and start them again, until the last one's fault ends that."""
    line.bus.stop_all()
    sims[-1].trip(4)
    start_staggered(drives, 2.0)


@pytest.mark.long
def test_a_failed_staggered_start_that_is_interrupted_stops_each_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class OwnThread(threading.Thread):
        """A thread that does its work at once."""

        def start(self) -> None:
            self.run()

        def join(self, timeout: float | None = None) -> None:
            """There is nothing to wait for."""

    monkeypatch.setattr(threading, "Thread", OwnThread)

    def counts(frame: FrameType) -> bool:
        text = getline(STOPPING.co_filename, frame.f_lineno).strip()
        return frame.f_code is STOPPING and not text.startswith(("def stop", "threads:", "left =", "try:"))

    for nth in range(1, 12):
        line, drives, sims = running(monkeypatch, 3)
        with pytest.raises(KeyboardInterrupt), interrupted_at(nth, counts):
            fails_to_start_the_last(line, drives, sims)
        assert not any(sim.motor.goal for sim in sims), nth


def test_a_failed_staggered_start_stops_each_though_the_stop_of_one_raises_anything(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class NoThread(threading.Thread):
        def start(self) -> None:
            raise MemoryError

    def raises(*_: object) -> None:
        raise TypeError

    line, drives, sims = running(monkeypatch, 3)
    monkeypatch.setattr(threading, "Thread", NoThread)
    line.bus.stop_all()
    drives[0].carry_out_stop = raises
    sims[2].trip(4)
    with pytest.raises(Refused, match="OC1"):
        start_staggered(drives, 2.0)
    assert [bool(sim.motor.goal) for sim in sims] == [True, False, False]


# ---- no memory, no descriptors ----


@pytest.mark.parametrize("fault", [NO_MEMORY, NO_DESCRIPTORS], ids=["memory", "descriptors"])
@pytest.mark.parametrize("is_sent", [False, True])
def test_a_stop_is_repeated_where_the_system_had_no_room_for_it(
    monkeypatch: pytest.MonkeyPatch, fault: Exception, is_sent: bool
) -> None:
    line, drives, sims = running(monkeypatch, 2)
    carry_out, left = line.carry_out, [7]

    def failing(exchange: Exchange, **details: Any) -> Completion:
        left[0] -= 1
        if left[0] >= 0:
            if is_sent:
                carry_out(exchange, **details)
            raise fault
        return carry_out(exchange, **details)

    monkeypatch.setattr(line, "carry_out", failing)
    drives[0].stop()
    assert not sims[0].motor.energised
    left[0] = 7
    found = line.bus.stop_all()
    assert {stopped.seen for stopped in found.values()} == {Seen.STOPPED}
    assert not sims[1].motor.energised


class NoRoom:
    """Stands in for the class of stops: the system has no room for the first of them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, times: int, fault: Exception) -> None:
        self.left = times
        self._fault = fault
        self._make = stop_all.StopAttempt
        monkeypatch.setattr(stop_all, "StopAttempt", self.make)

    def make(self, *details: Any) -> StopAttempt:
        self.left -= 1
        if self.left >= 0:
            raise self._fault
        return self._make(*details)


@pytest.mark.parametrize("fault", [NO_MEMORY, NO_DESCRIPTORS], ids=["memory", "descriptors"])
@pytest.mark.parametrize("all_of_them", [False, True])
def test_a_stop_is_made_once_the_system_has_room_for_it(
    monkeypatch: pytest.MonkeyPatch, fault: Exception, all_of_them: bool
) -> None:
    line, drives, sims = running(monkeypatch)
    begun = line.seconds
    room = NoRoom(monkeypatch, 149, fault)
    line.bus.stop_all() if all_of_them else drives[0].stop()
    assert room.left == -1
    assert line.seconds - begun > 149 * 0.2
    assert not sims[0].motor.energised


def test_a_stop_that_can_never_be_made_raises_why(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drives, _ = running(monkeypatch)
    begun, before = line.seconds, len(line.written)
    NoRoom(monkeypatch, 1000, NO_MEMORY)
    with pytest.raises(MemoryError):
        drives[0].stop()
    assert LEAST_S - 1 < line.seconds - begun < LEAST_S + 1
    assert len(line.written) == before


def test_a_stop_for_which_there_is_never_room_ends_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    line, _, _ = running(monkeypatch)

    def failing(exchange: Exchange, **details: Any) -> Completion:
        raise NO_DESCRIPTORS

    monkeypatch.setattr(line, "carry_out", failing)
    begun = line.seconds
    (stopped,) = line.bus.stop_all(seconds=5).values()
    assert stopped.seen is Seen.FAILED
    assert "Too many open files" in stopped.why
    assert 5 <= line.seconds - begun < 6


# ---- odd values ----


@pytest.mark.parametrize("seconds", [Decimal(12), Fraction(12), 10**400], ids=["decimal", "fraction", "huge"])
def test_a_stop_takes_any_number_as_its_time(monkeypatch: pytest.MonkeyPatch, seconds: Any) -> None:
    line, drives, sims = running(monkeypatch)
    deaf_until = line.seconds + (20 if seconds == 12 else 2 * LEAST_S)
    line.deafens = lambda request: clock.now_ns() < deaf_until * 1e9
    if seconds == 12:
        with pytest.raises(Unconfirmed, match="never confirmed"):
            drives[0].stop(seconds=seconds)
        assert line.seconds < deaf_until - 5
    else:
        drives[0].stop(seconds=seconds)
        assert not sims[0].motor.energised


# ---- a ledger that others hold, or cannot keep ----


@pytest.mark.slow
def test_a_stop_waits_once_for_a_ledger_that_others_hold_however_often_it_was_sent(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    ledger = Ledger(tmp_path / "wear")
    line = SimulatedBus(monkeypatch, simulated(Fan(1)), simulated(Fan(2)), ledger=ledger)
    for address in (1, 2):
        line.attach(Fan(address))
    asked = 0

    def busy(*_: object, **__: object) -> None:
        nonlocal asked
        asked += 1
        raise sqlite3.OperationalError("database is locked")

    line.loses = is_write
    with monkeypatch.context() as held:
        held.setattr(eeprom_ledger, "sqlite3", SimpleNamespace(connect=busy, Error=sqlite3.Error))
        line.bus.stop_all()
    assert asked == 1
    assert "stops were not counted: " in caplog.text
    before = len(line.written)
    line.bus.stop_all()
    assert asked == 1
    assert sum(wear.writes for wear in ledger.wear(1.8e9)) == len(line.written) - before > 40


def test_a_port_whose_name_is_no_text_keeps_no_stop_from_being_told(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    line = SimulatedBus(monkeypatch, simulated(Fan(1)), ledger=tmp_path / "wear")
    line.identity = "/dev/tty\udcff"
    line.attach(Fan(1)).stop()
    assert len(line.written) == 1
    assert "stops were not counted: " in caplog.text
