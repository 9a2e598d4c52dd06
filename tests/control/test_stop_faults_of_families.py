"""Stops of every kind of family, with a signal or a want of room at any line of theirs."""

from __future__ import annotations

from collections.abc import Callable
from errno import EMFILE
from functools import cache
from itertools import count
from pathlib import Path
from types import FrameType

import pytest
from examples import in_turn
from interruptions import failing_at
from motors import MAKE
from profile_families import ALL
from simulated_bus import SimulatedBus, one

import multidrop
from multidrop.control.records import WriteRecords
from multidrop.control.stops import stop_together
from multidrop.drive import Drive
from multidrop.sim import MotorDrive

FAMILIES: dict[str, Callable[[int], Drive]] = {
    **MAKE,
    "a profile": ALL["abb-acs355"],
    "a shipped file": ALL["shipped delta-ms300"],
}
FAILURES: dict[str, Callable[[], BaseException]] = {
    "signal": KeyboardInterrupt,
    "no memory": MemoryError,
    "no descriptors": lambda: OSError(EMFILE, "Too many open files"),
}
HOME = Path(multidrop.__file__).parent
SCRIPTS = tuple(str(HOME / name) for name in ("families", "drive/script.py"))
ATTEMPT = (str(HOME / "control/stops.py"), str(HOME / "drive/family.py"))


@cache
def has_lines_that_count(file: str) -> bool:
    return file.startswith((*SCRIPTS, *ATTEMPT))


def counts(frame: FrameType) -> bool:
    code = frame.f_code
    return has_lines_that_count(code.co_filename) or code is stop_together.__code__


@pytest.fixture
def _unbounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let setpoints be written as often as these tests begin anew."""
    monkeypatch.setattr(WriteRecords, "count", lambda *_: None)


def running(monkeypatch: pytest.MonkeyPatch, family: str) -> tuple[SimulatedBus, Drive, MotorDrive]:
    """Return a bus whose motor turns."""
    line, drive, sim = one(monkeypatch, FAMILIES[family](1))
    sim.motor.acceleration_time = sim.motor.deceleration_time = 1.0
    drive.set_frequency(20)
    drive.start()
    line.sleep(3)
    sim.pass_time(line.seconds)
    assert sim.motor.energised
    return line, drive, sim


def check_stops(monkeypatch: pytest.MonkeyPatch, family: str, failure: str, step: int) -> None:
    """Stop the motor again and again, with this failure at a later line each time until it is too late."""
    for nth in count(1, step):
        line, drive, sim = running(monkeypatch, family)
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
        line.bus.part()  # waits for no stop that is over
    assert nth > 80


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # as a script ends
@pytest.mark.usefixtures("_unbounded")
@pytest.mark.parametrize("step", [37, pytest.param(11, marks=pytest.mark.long)])
@pytest.mark.parametrize(("family", "failure"), in_turn(FAMILIES, [*FAILURES]))
def test_a_motor_stands_though_its_stop_failed_at_some_line(
    monkeypatch: pytest.MonkeyPatch, family: str, failure: str, step: int
) -> None:
    """Steps are prime, so that loops are met in different places; 1 tries each line, in a quarter hour."""
    check_stops(monkeypatch, family, failure, step)
