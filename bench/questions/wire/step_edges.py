"""How late are the setpoints of a test run's steps, on a line with the pace of a real wire?

Some simulated drives in another process are polled, and the frequency of all drives changes at each step. A
setpoint's time is the end of its frame at the drive. It is compared with the planned time of the step, which
counts from the recorded start of the first step.
"""

from __future__ import annotations

import argparse
import multiprocessing
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy

from bench.support import tables
from multidrop.planning.prediction import predict
from multidrop.plant.model import Plant, planned_on
from multidrop.recording import open_recording
from multidrop.runs import RunPlan, RunStep, TestRun
from multidrop.sim import MotorDrive, Simulator, Wire, simulated

PLANT = '[[line]]\nname = "hall"\nport = "{port}"\nbaudrate = {baudrate}\n'
DRIVE = """[[line.drive]]
name = "fan-{address}"
model = "invt-che"
address = {address}
maximum_frequency = 50
poll = ["output_frequency", "output_current", "fault"]
"""


def _play(plant: Path, pipe: Connection) -> None:
    """Simulate the plant until a message arrives; then send the times of all setpoint writes, in s."""
    line = Plant.load(plant).lines[0]
    sims = [simulated(polled.drive) for polled in line.drives]
    for sim in sims:
        assert isinstance(sim, MotorDrive)
        sim.motor.acceleration_time = sim.motor.deceleration_time = 0.5
    with Simulator([Wire(sims, port=line.port)]):
        pipe.send("ready")
        pipe.recv()
    pipe.send([write.time for sim in sims for write in sim.counters.writes if write.name == "setpoint"])


@contextmanager
def playing(plant: Path) -> Iterator[Connection]:
    ours, theirs = multiprocessing.Pipe()
    process = multiprocessing.get_context("spawn").Process(target=_play, args=(plant, theirs), daemon=True)
    process.start()
    assert ours.recv() == "ready"
    yield ours
    process.join()


def lateness(folder: Path, baudrate: int, drives: int, steps: int, dwell: float) -> tuple[list[float], float]:
    """Return the delay of each setpoint, and the predicted bus cycle, both in s."""
    plant = folder / f"{baudrate}.toml"
    tables_of_drives = "".join(DRIVE.format(address=address) for address in range(1, drives + 1))
    plant.write_text(PLANT.format(port=folder / str(baudrate), baudrate=baudrate) + tables_of_drives)
    loaded = Plant.load(plant)
    names = [f"fan-{address}" for address in range(1, drives + 1)]
    run = TestRun(
        RunPlan(
            loaded,
            [
                RunStep(f"step {number}", dict.fromkeys(names, 10.0 + number % 20), dwell=dwell)
                for number in range(steps)
            ],
        )
    )
    out = folder / f"{baudrate}.arrows"
    with playing(plant) as pipe:
        result = run.run(out)
        pipe.send("end")
        times: list[float] = sorted(pipe.recv())
    assert result.ok, result
    rows: Any = (row for batch in open_recording(out) for row in batch)
    begin = next(row.monotonic_ns for row in rows if row.drive == "test") / 1e9
    planned = [begin + one.begin for one in run.timeline for _ in names]
    assert len(times) == len(planned)
    late = [time - at for time, at in zip(times, planned, strict=True)]
    return late, predict(planned_on(loaded.lines[0])).cycle


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--baudrates", type=int, nargs="+", default=[9600, 38400])
    parser.add_argument("--drives", type=int, default=4)
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--dwell", type=float, default=1.0, help="length of a step in s")
    arguments = parser.parse_args()
    tables.heading(
        f"How late are the setpoints of {arguments.drives} polled drives at each of {arguments.steps} steps?"
    )
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for baudrate in arguments.baudrates:
            late, cycle = lateness(Path(folder), baudrate, arguments.drives, arguments.steps, arguments.dwell)
            first = late[:: arguments.drives]
            shown = (
                numpy.percentile(first, 50),
                numpy.percentile(first, 100),
                numpy.percentile(late, 100),
                cycle,
            )
            rows.append((str(baudrate), *(f"{seconds * 1e3:.1f}" for seconds in shown)))
    tables.show(("baudrate", "first ms p50", "first ms max", "last ms max", "bus cycle ms"), rows)
    print("\nfirst, last: setpoint of a step. The time includes the setpoint's own frame on the wire.")


if __name__ == "__main__":
    main()
