"""Stops while the system fails: signals at any line, no memory, no file descriptors, a locked ledger."""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Callable
from contextlib import suppress
from errno import EMFILE
from fractions import Fraction
from functools import cache
from itertools import chain, count
from linecache import getline
from pathlib import Path
from types import FrameType, SimpleNamespace
from typing import Any

import pytest
from interruptions import calling_at, failing_at, interrupted_at
from motors import MAKE
from own_drives import Fan
from profile_families import ALL
from simulated_bus import SimulatedBus, che_drives, is_write, one
from tables import first_in_ci, in_turn, table, usually

import multidrop
from multidrop.control import eeprom_ledger, ramp, stops
from multidrop.control.eeprom_ledger import Ledger
from multidrop.control.outcome import Seen
from multidrop.control.ramp import start_staggered
from multidrop.control.records import WriteRecords
from multidrop.control.stops import LEAST_S, StopAttempt, stop_together
from multidrop.core import Completion, Exchange
from multidrop.drive import Drive, Script, carry_out, insist, read, until, verb, wait, write
from multidrop.errors import CancelledByStop, Unconfirmed, WriteForbidden
from multidrop.families import InvtCHE
from multidrop.sim import MotorDrive, simulated
from multidrop.transport import clock
from multidrop.transport.aside_log import flush_log

STOPPING = ramp._stop.__code__
NO_MEMORY, NO_DESCRIPTORS = MemoryError(), OSError(EMFILE, "Too many open files")


def writes_to(line: SimulatedBus, address: int) -> int:
    return sum(is_write(request) and request.address == address for request, _ in line.frames)


HOME = str(Path(multidrop.__file__).parent)
# The first opcodes of a stop, before its `try`, call nothing. So the interpreter handles a signal that
# arrives during them only at a later opcode, within the `try`.
FIRST_OPCODES = 6

OURS = (
    *(f"{HOME}/{file}" for file in ("bus.py", "core/permissions.py")),
    *(f"{HOME}/{room}/" for room in ("control", "drive", "families")),
)


def is_ours(frame: FrameType) -> bool:
    return frame.f_code.co_filename.startswith(OURS)


def check_failing(nth: int, failure: type[BaseException], all_of_them: bool) -> bool:
    """Return False if a stop has fewer than n opcodes; else check a stop that fails at the nth opcode."""
    line, drives, sims = che_drives(2 if all_of_them else 1, runs_s=10)
    begun_before = [drive.begin_call("start", drive.stops_called[0]) for drive in drives]
    stop, told, place = line.bus.stop_all if all_of_them else drives[0].stop, "", []

    def fail() -> None:
        raise failure

    try:
        with calling_at(nth, is_ours, fail) as place:
            stop()
    except failure as raised:  # keeps all Python frames of the stop alive during the checks
        told = "".join(getattr(raised, "__notes__", ()))
        assert not line.bus._latches._stops, place
        assert not line.bus.stops_under_way(), place
        for drive, sim, call in zip(drives, sims, begun_before, strict=True):
            sim.pass_time(line.seconds + 60)
            assert not call.permit.is_good, place
            assert drive.begin_call("start", drive.stops_called[0]).permit.is_good, place
            assert f"{drive.name}: the stop was sent" in told or not sim.motor.goal, place
    assert not any(sim.motor.energised for sim in sims), place
    line.bus.close()
    return bool(place)


@pytest.mark.parametrize("failure", [KeyboardInterrupt, MemoryError])
@pytest.mark.parametrize("all_of_them", usually(False, True))
@pytest.mark.parametrize("step", [*usually(1999, 331), pytest.param(67, marks=pytest.mark.nightly)])
def test_a_motor_is_stopped_although_an_exception_interrupts_any_bytecode(
    failure: type[BaseException], all_of_them: bool, step: int
) -> None:
    first = FIRST_OPCODES + 1
    for nth in chain(range(first, first + 20), count(first + 20, step)):
        if not check_failing(nth, failure, all_of_them):
            break
    assert nth > 5_000


@pytest.mark.parametrize("verb", ["stop", "coast", "stop_all"])
def test_a_stop_called_by_a_signal_handler_cancels_the_interrupted_start(verb: str) -> None:
    """The handler is called at each opcode from the first at which the interpreter may handle a signal."""
    line, (drive,), (sim,) = che_drives(runs_s=10)
    drive.stop()
    stop = line.bus.stop_all if verb == "stop_all" else getattr(drive, verb)
    start, first = drive.start, 9  # bytecodes 1 to 8 are executed before the start is called
    for nth in chain(range(first, first + 80, 4), count(first + 80, 499)):
        with calling_at(nth, is_ours, stop) as place, suppress(CancelledByStop, Unconfirmed):
            start()
        if not place:
            break
        line.sleep(30)
        assert not sim.motor.energised, place
    assert nth > 2000


@pytest.mark.parametrize("failure", [SystemExit, KeyboardInterrupt, GeneratorExit])
def test_other_motors_are_stopped_if_a_stop_script_raises_system_exit(failure: type[BaseException]) -> None:
    """SystemExit is raised only after all stops are over, even if the other motor's first stops are lost."""

    class Ending(Fan):
        model = "ending"
        title = "ENDING"

        @verb
        def stop(self) -> Script[None]:
            raise failure

    sims: list[Any] = [simulated(Ending(1)), simulated(InvtCHE(2, maximum_frequency=50))]
    line = SimulatedBus(*sims)
    _, other = (line.attach(sim.drive) for sim in sims)
    other.set_frequency(20)
    other.start()
    deaf_until = line.seconds + 5
    line.deafens = lambda request: line.seconds < deaf_until
    with pytest.raises(failure):
        line.bus.stop_all()
    assert not sims[1].motor.energised
    assert line.bus._latches.latch(other).permit().is_good


def fails_to_start_the_last(line: SimulatedBus, drives: list[Any], sims: list[Any]) -> None:
    """Stop all motors, then start them again; the start fails at the last drive, which has a fault."""
    line.bus.stop_all()
    sims[-1].trip(4)
    start_staggered(drives, 2.0)


@pytest.mark.long
def test_all_started_drives_are_stopped_although_a_stop_is_interrupted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class OwnThread(threading.Thread):
        """A thread that does its work in `start`."""

        def start(self) -> None:
            self.run()

        def join(self, timeout: float | None = None) -> None:
            """Return immediately."""

    monkeypatch.setattr(threading, "Thread", OwnThread)

    def counts(frame: FrameType) -> bool:
        text = getline(STOPPING.co_filename, frame.f_lineno).strip()
        return frame.f_code is STOPPING and not text.startswith(("def stop", "threads:", "left =", "try:"))

    for nth in range(1, 12):
        line, drives, sims = che_drives(3, runs_s=10)
        with pytest.raises(KeyboardInterrupt), interrupted_at(nth, counts):
            fails_to_start_the_last(line, drives, sims)
        assert not any(sim.motor.goal for sim in sims), nth


def test_all_started_drives_are_stopped_even_if_one_stop_raises(monkeypatch: pytest.MonkeyPatch) -> None:
    class NoThread(threading.Thread):
        def start(self) -> None:
            raise MemoryError

    def raises(*_: object) -> None:
        raise TypeError

    line, drives, sims = che_drives(3, runs_s=10)
    monkeypatch.setattr(threading, "Thread", NoThread)
    line.bus.stop_all()
    drives[0].begin_stop = raises
    sims[2].trip(4)
    with pytest.raises(WriteForbidden, match="OC1"):
        start_staggered(drives, 2.0)
    assert [bool(sim.motor.goal) for sim in sims] == [True, False, False]


@table("fault", [NO_MEMORY, NO_DESCRIPTORS], ids=["memory", "descriptors"])
@table("is_sent", [False, True])
def test_a_stop_is_repeated_after_a_lack_of_memory_or_descriptors(
    monkeypatch: pytest.MonkeyPatch, fault: Exception, is_sent: bool
) -> None:
    line, drives, sims = che_drives(2, runs_s=10)
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
    """Replaces StopAttempt: creating one raises `fault` the first `times` times."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, times: int, fault: Exception) -> None:
        self.left = times
        self._fault = fault
        self._make = stops.StopAttempt
        monkeypatch.setattr(stops, "StopAttempt", self.make)

    def make(self, *details: Any) -> StopAttempt:
        self.left -= 1
        if self.left >= 0:
            raise self._fault
        return self._make(*details)


@table("fault", [NO_MEMORY, NO_DESCRIPTORS], ids=["memory", "descriptors"])
@table("all_of_them", [False, True])
def test_a_stop_is_sent_as_soon_as_memory_and_descriptors_are_available(
    monkeypatch: pytest.MonkeyPatch, fault: Exception, all_of_them: bool
) -> None:
    line, drives, sims = che_drives(runs_s=10)
    begun = line.seconds
    room = NoRoom(monkeypatch, 149, fault)
    line.bus.stop_all() if all_of_them else drives[0].stop()
    assert room.left == -1
    assert line.seconds - begun > 149 * 0.2
    assert not sims[0].motor.energised


def test_a_stop_raises_memory_error_after_30_s_without_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drives, _ = che_drives(runs_s=10)
    begun, before = line.seconds, len(line.written)
    NoRoom(monkeypatch, 1000, NO_MEMORY)
    with pytest.raises(MemoryError):
        drives[0].stop()
    assert LEAST_S - 1 < line.seconds - begun < LEAST_S + 1
    assert len(line.written) == before


def test_the_stop_result_says_that_no_file_descriptor_was_left(monkeypatch: pytest.MonkeyPatch) -> None:
    line, _, _ = che_drives(runs_s=10)

    def failing(exchange: Exchange, **details: Any) -> Completion:
        raise NO_DESCRIPTORS

    monkeypatch.setattr(line, "carry_out", failing)
    begun = line.seconds
    (stopped,) = line.bus.stop_all(seconds=5).values()
    assert stopped.seen is Seen.FAILED
    assert "Too many open files" in stopped.why
    assert 5 <= line.seconds - begun < 6


@pytest.mark.parametrize("seconds", [Fraction(12), 10**400], ids=["fraction", "huge"])
def test_a_stop_accepts_any_real_number_of_seconds(seconds: Any) -> None:
    line, drives, sims = che_drives(runs_s=10)
    deaf_until = line.seconds + (20 if seconds == 12 else 2 * LEAST_S)
    line.deafens = lambda request: clock.now_ns() < deaf_until * 1e9
    if seconds == 12:
        with pytest.raises(Unconfirmed, match="never confirmed"):
            drives[0].stop(seconds=seconds)
        assert line.seconds < deaf_until - 5
    else:
        drives[0].stop(seconds=seconds)
        assert not sims[0].motor.energised


@pytest.mark.slow
def test_a_repeated_stop_opens_a_locked_eeprom_ledger_only_once(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    ledger = Ledger(tmp_path / "wear")
    line = SimulatedBus(simulated(Fan(1)), simulated(Fan(2)), ledger=ledger)
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
        line.bus._records.flush(60)
    flush_log(60)
    assert 1 <= asked <= 2  # at the end of each stop, or once for both stops
    assert "stops were not counted: " in caplog.text
    before, asked_before = len(line.written), asked
    line.bus.stop_all()
    line.bus._records.flush(60)
    assert asked == asked_before
    assert sum(wear.writes for wear in ledger.wear(1.8e9)) == len(line.written) - before > 40


def test_a_stop_is_sent_even_if_the_port_name_is_invalid_unicode(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    line = SimulatedBus(simulated(Fan(1)), ledger=tmp_path / "wear")
    line.identity = "/dev/tty\udcff"
    line.attach(Fan(1)).stop()
    assert len(line.written) == 1
    line.bus._records.flush(60)
    flush_log(60)
    assert "stops were not counted: " in caplog.text


FAMILIES: dict[str, Callable[[int], Drive]] = {
    **MAKE,
    "a profile": ALL["abb-acs355"],
    "a shipped file": ALL["delta-ms300"],
}

FAILURES: dict[str, Callable[[], BaseException]] = {
    "signal": KeyboardInterrupt,
    "no memory": MemoryError,
    "no descriptors": lambda: OSError(EMFILE, "Too many open files"),
}

HOME = Path(multidrop.__file__).parent

SCRIPTS = str(HOME / "families")

STEPS = {one.__code__ for one in (carry_out, insist, read, until, wait, write)}

ATTEMPT = (str(HOME / "control/stops.py"), str(HOME / "drive/family.py"))


@cache
def has_lines_that_count(file: str) -> bool:
    return file.startswith((SCRIPTS, *ATTEMPT))


def counts(frame: FrameType) -> bool:
    code = frame.f_code
    return has_lines_that_count(code.co_filename) or code in STEPS or code is stop_together.__code__


@pytest.fixture
def _unbounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Disable the budget of EEPROM writes, because these tests write setpoints again and again."""
    monkeypatch.setattr(WriteRecords, "count", lambda *_: None)


def running_family(family: str) -> tuple[SimulatedBus, Drive, MotorDrive]:
    """Return a simulated bus, its drive, and the simulation, whose motor turns."""
    line, drive, sim = one(FAMILIES[family](1))
    sim.motor.acceleration_time = sim.motor.deceleration_time = 1.0
    drive.set_frequency(20)
    drive.start()
    line.sleep(3)
    sim.pass_time(line.seconds)
    assert sim.motor.energised
    return line, drive, sim


def check_stops(family: str, failure: str, step: int) -> None:
    """Check that the motor stops although the stop fails at one of its lines, each `step` lines apart."""
    for nth in count(1, step):
        line, drive, sim = running_family(family)
        told = ""
        try:
            with failing_at(nth, counts, FAILURES[failure]()) as place:
                drive.stop() if nth % 2 else line.bus.stop_all()
        except BaseException as raised:
            told = "".join(getattr(raised, "__notes__", ()))
            assert f"{drive.name}: the stop was sent" in told or not sim.motor.goal, place
        if not place:
            break
        sim.pass_time(line.seconds + 60)
        assert not sim.motor.energised, place
        assert not line.bus.stops_under_way(), place
        line.bus.part()  # returns at once: the stop is over
    assert nth > 80


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # raised when the script ends
@pytest.mark.usefixtures("_unbounded")
@pytest.mark.parametrize("step", first_in_ci(37, 11))
@pytest.mark.parametrize(("family", "failure"), in_turn(FAMILIES, [*FAILURES]))
def test_a_motor_is_stopped_although_any_line_of_code_fails(family: str, failure: str, step: int) -> None:
    """Steps are prime, so that they reach different lines of loops. With step 1, a run takes 15 minutes."""
    check_stops(family, failure, step)
