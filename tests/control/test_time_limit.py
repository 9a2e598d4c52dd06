"""A call with a time limit sends no request after that time, except a stop."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from math import inf
from pathlib import Path
from typing import Any

import pytest
from motors import MAKE, STARTS
from peers import preloaded
from simulated_bus import EXCHANGE_TIME, Own, SimulatedBus, first, one, started_while, writes
from tables import table

from multidrop.bus import Bus
from multidrop.control.call import written_before
from multidrop.control.ramp import ramp
from multidrop.core import Message
from multidrop.drive import Direction, Drive, Script, read, wait, write
from multidrop.drive.register import Kept, reading, setting
from multidrop.drive.verbs import verb
from multidrop.errors import CancelledByStop, Expired
from multidrop.families import YD1000, InvtCHE
from multidrop.sim import MotorDrive, Simulator, Wire, simulated


@pytest.fixture
def line() -> SimulatedBus:
    found, _, _ = one(InvtCHE(1, maximum_frequency=50))
    found.bus.drives[0].set_frequency(10)  # later calls need no identity check
    return found


def within(line: SimulatedBus, seconds: float) -> AbstractContextManager[None]:
    until_ns = (line.seconds + seconds) * 1e9
    return written_before(lambda: until_ns)


def written(line: SimulatedBus) -> list[str]:
    return [text for request, text in line.frames if request.function in (5, 6, 15, 16)]


def test_a_call_within_its_time_limit_is_sent(line: SimulatedBus) -> None:
    before = len(written(line))
    with within(line, 0.5):
        line.sleep(0.4)
        line.bus.drives[0].set_frequency(20)
    assert len(written(line)) == before + 1


@pytest.mark.parametrize("seconds", [0, 0.5, 0.9])
def test_a_call_delayed_past_its_time_limit_raises_expired(line: SimulatedBus, seconds: float) -> None:
    """The delay is shorter than the bus's own expiry of 1 s, so only the limit prevents the request."""
    before = len(written(line))
    with within(line, seconds):
        line.sleep(0.45)
        line.queue_time = 0.5
        with pytest.raises(Expired):
            line.bus.drives[0].set_frequency(20)
    assert len(written(line)) == before


@pytest.mark.parametrize("slept_before", [0, 3600])
def test_computer_sleep_before_a_time_limit_is_not_counted(line: SimulatedBus, slept_before: float) -> None:
    line.slept += slept_before
    before = len(written(line))
    with within(line, 0.5):
        line.bus.drives[0].set_frequency(20)
        line.slept += 1
        with pytest.raises(Expired):
            line.bus.drives[0].set_frequency(25)
    assert len(written(line)) == before + 1


class Slow(Drive):
    """A drive whose start waits `before` seconds before its first write, and `between` before its second."""

    model = "slow"
    title = "SLOW 1"
    speed = reading(0x10, "rpm")
    ratio = setting(0x21, kept=Kept.RAM)
    before = 0.0  # s
    between = 0.0

    @verb
    def start(self, direction: Direction | None = None) -> Script[None]:
        """Start the motor, in two steps."""
        yield from read(self.speed)
        yield from wait(self.before)
        yield from write(self.ratio, 1)
        yield from wait(self.between)
        yield from write(self.ratio, 2)


@pytest.mark.parametrize(("before", "between", "sent"), [(0.1, 0.1, 2), (0.1, 5.0, 2), (0.9, 0.1, 0)])
def test_the_time_limit_applies_only_to_a_verbs_first_write(before: float, between: float, sent: int) -> None:
    """Unlike the limit, the bus's own expiry does not count the time that a script waits."""
    line = SimulatedBus(simulated(Slow(1)))
    drive = line.bus.attach(Slow(1, confirmed=1))
    drive.before, drive.between = before, between
    with within(line, 0.8), nullcontext() if sent else pytest.raises(Expired):
        drive.start()
    assert len(written(line)) == sent


def test_an_inner_time_limit_cannot_extend_the_outer_time_limit(line: SimulatedBus) -> None:
    with within(line, 0.2), within(line, 60):
        line.sleep(0.3)
        with pytest.raises(Expired):
            line.bus.drives[0].set_frequency(20)
    line.bus.drives[0].set_frequency(20)


def test_the_expiry_of_the_bus_also_applies_within_a_time_limit(line: SimulatedBus) -> None:
    line.queue_time = 1.5
    with within(line, 60), pytest.raises(Expired):
        line.bus.drives[0].set_frequency(20)


def test_a_call_expires_immediately_if_the_limit_function_returns_nan(line: SimulatedBus) -> None:
    before = len(written(line))
    with written_before(lambda: float("nan")), pytest.raises(Expired):
        line.bus.drives[0].set_frequency(20)
    assert len(written(line)) == before


def test_a_stop_is_sent_after_the_time_limit(line: SimulatedBus) -> None:
    before = len(written(line))
    with within(line, 0):
        line.sleep(5)
        line.bus.drives[0].stop()
    assert len(written(line)) > before


def test_a_stop_called_in_the_limit_function_cancels_the_write(line: SimulatedBus) -> None:
    """A program can therefore check for stops in its `limit` function, and misses none."""
    drive = line.bus.drives[0]
    before = len(written(line))

    def limit() -> float:
        drive.stop()  # the last moment at which a stop can cancel the call
        return inf

    with written_before(limit), pytest.raises(CancelledByStop):
        drive.set_frequency(20)
    assert written(line)[before:] == written(line)[-1:]  # the stop


@table("limit", [0.5, True, "1", None])
def test_an_invalid_time_limit_prevents_writes_but_not_stops(limit: Any) -> None:
    line, drive, _ = one(InvtCHE(1, maximum_frequency=50))
    with written_before(limit):
        for call in (lambda: drive.set_frequency(20), drive.start):
            with pytest.raises(TypeError, match=r"must be a function that returns a time"):
                call()
        assert not written(line)
        drive.stop()
    assert len(written(line)) == 1


class Looking(Own):
    """A drive whose start reads twenty times before it writes."""

    @verb
    def start(self, direction: Direction | None = None) -> Script[None]:
        for _ in range(20):
            yield from read(self.speed)
        yield from write(self.ratio, 1)


class Resting(Own):
    """A drive that needs 5 s between two requests."""

    least_interval = 5.0


def suspend(line: SimulatedBus) -> None:
    line.sleep(5)  # as by Ctrl-Z


def sleep_for_a_night(line: SimulatedBus) -> None:
    line.slept += 8 * 3600  # CLOCK_MONOTONIC does not advance, so by that clock the start is not late


@table("model", MAKE)
@pytest.mark.parametrize("hold_up", [suspend, sleep_for_a_night])
def test_a_start_is_not_sent_after_a_suspension_or_sleep_during_checks(
    tmp_path: Path, model: str, hold_up: Callable[[SimulatedBus], None]
) -> None:
    """The start is delayed at each of its reads."""
    for frames in range(1, 100):
        line, _, meanwhile, begun, failure = started_while(
            tmp_path, model, frames, lambda line, drive: hold_up(line)
        )
        start = first(line, begun, STARTS[model])
        if not meanwhile.has_come or (start is not None and start < frames):
            break
        assert start is None
        assert isinstance(failure, Expired)
    assert frames > 2


def test_a_start_does_not_expire_because_of_slow_reads() -> None:
    class Sleepy(Own):
        """A drive whose start waits and reads twenty times."""

        @verb
        def start(self, direction: Direction | None = None) -> Script[None]:
            for _ in range(20):
                yield from wait(1.0)
                yield from read(self.speed)
            yield from write(self.ratio, 1)

    line = SimulatedBus(simulated(Sleepy(1)))
    line.attach(Sleepy(1, confirmed=1)).start()
    assert len(writes(line)) == 1


@pytest.mark.parametrize(("more", "is_sent"), [(0.25, True), (0.35, False)])
def test_a_start_expires_only_if_a_read_takes_too_long(more: float, is_sent: bool) -> None:
    """A read may take as long as its timeout, two silences and 64 characters together."""
    line = SimulatedBus(simulated(Looking(1)))
    drive = line.attach(Looking(1, confirmed=1, silence=0.1))
    line.bus.check_identity(drive)
    line.queue_time = drive.response_timeout + more - EXCHANGE_TIME
    if is_sent:
        drive.start()
    else:
        with pytest.raises(Expired):
            drive.start()
    assert len(line.written) == is_sent


@pytest.mark.parametrize(("waits", "is_sent"), [(5.9, True), (6.1, False)])
def test_a_write_does_not_expire_during_the_drives_required_pause(waits: float, is_sent: bool) -> None:
    line = SimulatedBus(simulated(Resting(1)))
    drive = line.attach(Resting(1, confirmed=1))
    line.bus.check_identity(drive)
    line.queue_time = waits
    if is_sent:
        drive.write(drive.ratio, 3.0)
    else:
        with pytest.raises(Expired):
            drive.write(drive.ratio, 3.0)
    assert len(line.written) == is_sent


def test_a_verb_does_not_expire_because_of_slow_writes() -> None:
    """A ramp has more writes than fit into the expiry of one call."""
    line, drive, _ = one(YD1000(1))
    drive.set_frequency(1)
    before = len(writes(line))
    ramp(drive, 51, rate=0.5, every=1)
    assert len(writes(line)) - before == 100
    assert 100 * EXCHANGE_TIME > 1.0  # the ramp takes longer than the expiry of one call


@table("expiry", [0, -1, float("nan"), float("inf"), 10**30, True, "1"])
def test_an_invalid_expiry_is_refused(expiry: Any) -> None:
    with pytest.raises(ValueError, match=r"expiry = .* must be a number of seconds above 0"):
        Bus("/dev/none", expiry=expiry)


pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="CLOCK_BOOTTIME is Linux's")

CLIENT = """
import sys
from pathlib import Path
from multidrop import Bus, Expired, InvtCHE
class Pump(InvtCHE):  # long timeouts for a busy machine
    response_timeout = 60.0
    response_delay = 15.0
with Bus(sys.argv[1], expiry=600) as bus:
    pump = bus.attach(Pump(1, maximum_frequency=50))
    pump.set_frequency(20)
    Path(sys.argv[2]).touch()
    try:
        pump.start()
    except Expired as failure:
        print(failure)
    pump.stop()
"""


@pytest.mark.long
@pytest.mark.parametrize("sleeps", [True, False])
def test_a_start_is_not_sent_after_the_computer_wakes_up(tmp_path: Path, sleeps: bool) -> None:
    sim = simulated(InvtCHE(1, maximum_frequency=50))
    assert isinstance(sim, MotorDrive)
    sim.motor.deceleration_time = 0.2
    answer, begun, slept = sim.answer, tmp_path / "begun", tmp_path / "slept"

    def answer_and_sleep(request: Message, now: float) -> Message | None:
        if sleeps and begun.exists():  # simulates a sleep at the first request of `drive.start`
            slept.touch()
        return answer(request, now)

    sim.answer = answer_and_sleep  # type: ignore[method-assign]
    with Simulator([Wire([sim], unpaced=True)]) as simulator:
        ran = subprocess.run(
            [sys.executable, "-c", CLIENT, simulator.wires[0].path, str(begun)],
            env=os.environ | {"LD_PRELOAD": preloaded("sleeping_clock", tmp_path), "SLEPT": str(slept)},
            capture_output=True,
            text=True,
            check=False,
        )
    assert ran.returncode == 0, ran.stderr
    commands = [write.raw for write in sim.counters.writes if write.name == "control"]
    assert commands == ([5] if sleeps else [1, 5])
    assert ("was not sent" in ran.stdout) == sleeps
