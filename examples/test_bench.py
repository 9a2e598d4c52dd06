"""Run a fan at several frequencies and record it: `python examples/test_bench.py [SECONDS]`.

Each step lasts SECONDS. The test ends early if the current exceeds a limit or the drive stops answering. The
motor is stopped however the test ends: after the last step, on an error, on Ctrl-C and on SIGTERM.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from statistics import mean

from simulated_plant import simulated_plant

from multidrop import Plant, Poller, open_writer, ramp
from multidrop.recording import RecordingWriter

PLANT = """
[[line]]
name = "bench"
port = "{ports}/bench"

[[line.drive]]
name = "fan"
model = "invt-che"
address = 1
maximum_frequency = 50
poll = ["output_frequency", "output_current", "fault"]
"""
STEPS_HZ = (10.0, 20.0, 30.0)
LIMIT_A = 30.0


class LimitExceeded(Exception):
    """Raised to end the test: the current is too high, or no current was read."""


def record_step(poller: Poller, writer: RecordingWriter, seconds: float) -> list[float]:
    """Record for this time; return currents in A. Raises LimitExceeded for a high or a missing current."""
    currents: list[float] = []
    begin_ns = time.time_ns()  # earlier rows belong to the ramp
    for batch in poller.batches(seconds=seconds):
        writer.write(batch)
        for row in batch:
            if row.register != "output_current" or row.value is None:
                continue
            if row.value > LIMIT_A:
                raise LimitExceeded(f"{row.value} A is over the limit of {LIMIT_A} A")
            if row.time_ns >= begin_ns:
                currents.append(row.value)
    if not currents:
        raise LimitExceeded(f"no current was read for {seconds} s")
    return currents


def run(plant: Plant, seconds: float, out: Path) -> None:
    """Print the mean current of each step."""
    with Poller(plant, stop_on_exit=True) as poller, open_writer(out, plant.metadata()) as writer:
        fan = poller["fan"]
        fan.set_frequency(STEPS_HZ[0])
        fan.start()
        for hz in STEPS_HZ:
            ramp(fan, hz, rate=20.0)
            print(f"{hz} Hz: {mean(record_step(poller, writer, seconds)):.2f} A")


def main(seconds: float) -> None:
    with simulated_plant(PLANT) as plant:
        try:
            run(plant, seconds, Path("bench.arrows"))
        except LimitExceeded as reason:
            print("ended early:", reason)


if __name__ == "__main__":
    main(float(sys.argv[1]) if sys.argv[1:] else 3.0)
