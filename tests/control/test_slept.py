"""A machine that sleeps in the middle of a start: CLOCK_MONOTONIC stands still meanwhile.

No machine here can be put to sleep: a library put before the system's has the clocks of one that was.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from c_programs import preloaded

from multidrop.core import Message
from multidrop.families import InvtCHE
from multidrop.sim import MotorDrive, Simulator, Wire, simulated

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="CLOCK_BOOTTIME is Linux's")

CLIENT = """
import sys
from pathlib import Path
from multidrop import Bus, Expired, InvtCHE
class Pump(InvtCHE):  # is waited for however busy the machine is
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
def test_a_start_is_not_sent_when_the_machine_wakes(tmp_path: Path, sleeps: bool) -> None:
    sim = simulated(InvtCHE(1, maximum_frequency=50))
    assert isinstance(sim, MotorDrive)
    sim.motor.deceleration_time = 0.2
    answer, begun, slept = sim.answer, tmp_path / "begun", tmp_path / "slept"

    def answer_and_sleep(request: Message, now: float) -> Message | None:
        if sleeps and begun.exists():  # at the first look of the start
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
