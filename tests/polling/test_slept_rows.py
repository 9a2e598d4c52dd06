"""Rows of a computer that sleeps during polling: each row has the time of its exchange.

The test computer does not sleep. A preloaded library gives the process the clocks of a computer that slept.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from c_programs import preloaded

from multidrop.core import Message
from multidrop.families import InvtCHE
from multidrop.sim import Simulator, Wire, simulated

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="CLOCK_BOOTTIME is Linux's")

HOUR_NS = 3600 * 10**9
PLANT = """
[[line]]
name = "hall"
port = "{}"
baudrate = 38400
[[line.drive]]
name = "pump-1"
model = "invt-che"
address = 1
poll = ["output_frequency"]
"""
CLIENT = """
import json, sys, time
from multidrop import Plant, Poller
rows = []
with Poller(Plant.load(sys.argv[1])) as poller:
    while sum(row.status == "ok" and row.time_ns > int(sys.argv[2]) for row in rows) < 300:
        rows += poller.take() or ()
        time.sleep(0.001)
print(json.dumps([[row.time_ns, row.monotonic_ns] for row in rows if row.status == "ok"]))
"""


@pytest.mark.long
@pytest.mark.slow
def test_rows_have_the_time_of_their_exchange_although_the_computer_slept(tmp_path: Path) -> None:
    sim = simulated(InvtCHE(1, baudrate=38400))
    answer, slept, asked_ns = sim.answer, tmp_path / "slept", list[int]()

    def answer_and_sleep(request: Message, now: float) -> Message | None:
        asked_ns.append(time.monotonic_ns())
        if len(asked_ns) == 50:
            slept.touch()
        return answer(request, now)

    sim.answer = answer_and_sleep  # type: ignore[method-assign]
    with Simulator([Wire([sim], unpaced=True)]) as simulator:
        (tmp_path / "plant.toml").write_text(PLANT.format(simulator.wires[0].path))
        ahead_ns = time.time_ns() - time.monotonic_ns()
        ran = subprocess.run(
            [sys.executable, "-c", CLIENT, str(tmp_path / "plant.toml"), str(time.time_ns() + HOUR_NS)],
            env=os.environ | {"LD_PRELOAD": preloaded("sleeping_clock", tmp_path), "SLEPT": str(slept)},
            capture_output=True,
            text=True,
            check=False,
        )
    assert ran.returncode == 0, ran.stderr
    slept_for = {
        True: set[int](),
        False: set[int](),
    }  # hours of sleep in the rows' UTC; True: rows of requests before the sleep
    before_ns, amid_ns = asked_ns[48], asked_ns[49]  # the second request may be timed before or after it
    for time_ns, monotonic_ns in json.loads(ran.stdout):
        if not before_ns < monotonic_ns <= amid_ns:
            slept_for[monotonic_ns <= before_ns].add(round((time_ns - monotonic_ns - ahead_ns) / HOUR_NS))
    assert slept_for == {True: {0}, False: {8}}
