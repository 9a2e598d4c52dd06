"""Find the drive that loses values on a noisy line: `python examples/noise_hunt.py [SECONDS]`.

It writes captures of the whole traffic into the folder `noise/`.
"""

from __future__ import annotations

import sys
from collections import Counter
from functools import partial
from pathlib import Path

from simulated_plant import simulated_plant

from multidrop import Plant, Poller
from multidrop.capture import CaptureWriter, FlightRecorder, Tapped
from multidrop.sim import Faults, FaultyWire

PLANT = """
[[line]]
name = "hall"
port = "{ports}/hall"

[[line.drive]]
name = "pump-1"
model = "innovert-ibd"
address = 1
poll = ["output_current", "motor_speed"]

[[line.drive]]
name = "pump-2"
model = "innovert-ibd"
address = 2
poll = ["output_current", "motor_speed"]
"""
FAULTS = Faults(seed=7, flip=0.05, drop=0.02, noise=0.1)


def hunt(plant: Plant, seconds: float, directory: Path) -> Counter[tuple[str, str]]:
    """Poll, and write captures to `directory`; return the number of lost values by drive and reason."""
    lost: Counter[tuple[str, str]] = Counter()
    poller = Poller(plant)
    lines = list(poller.buses)
    recorder = FlightRecorder(directory, lines)
    with CaptureWriter(directory / "all.pcapng", lines) as capture:
        with Tapped(poller.buses, capture, recorder) as tapped, poller:
            for batch in poller.batches(seconds=seconds):
                tapped.collect()
                lost.update((row.drive, row.status) for row in batch if row.status != "ok")
        recorder.close()
    for name, drive in poller.statistics()["hall"].drives.items():
        print(f"{name}: {drive.samples} samples, {drive.misses.total()} misses")
        print(f"  {drive.skipped_bytes} stray bytes, {drive.late_replies} late replies")
    return lost


def main(seconds: float) -> None:
    with simulated_plant(PLANT, partial(FaultyWire, faults=FAULTS)) as plant:
        lost = hunt(plant, seconds, Path("noise"))
    for (drive, status), count in lost.most_common():
        print(f"{drive:8}{count:5}  {status}")


if __name__ == "__main__":
    main(float(sys.argv[1]) if sys.argv[1:] else 10.0)
