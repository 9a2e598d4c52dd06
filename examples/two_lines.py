"""Poll two lines in parallel, and add a drive while polling: `python examples/two_lines.py [SECONDS]`."""

from __future__ import annotations

import sys
from collections import Counter

from simulated_plant import simulated_plant

from multidrop import Poller

PLANT = """
[[line]]
name = "hall-1"
port = "{ports}/hall-1"

[[line.drive]]
name = "pump-1"
model = "innovert-ibd"
address = 1
poll = ["output_current"]

[[line.drive]]
name = "pump-2"
model = "innovert-ibd"
address = 2
poll = ["output_current"]

[[line]]
name = "hall-2"
port = "{ports}/hall-2"

[[line.drive]]
name = "fan-1"
model = "yd1000"
address = 1
poll = ["output_frequency", "output_current"]
"""


def main(seconds: float) -> None:
    samples: Counter[str] = Counter()
    with simulated_plant(PLANT) as plant, Poller(plant) as poller:
        poller.remove("hall-1", "pump-2")
        for number, batch in enumerate(poller.batches(seconds=seconds)):
            samples.update(row.drive for row in batch if row.status == "ok")
            if number == 2:  # add pump-2 again after the third batch
                pump = plant.lines[0].drives[1].drive
                poller.add("hall-1", pump, poll=["output_current"])
        lines = poller.statistics()
    for drive, count in sorted(samples.items()):
        print(f"{drive}: {count} samples")
    for name, line in lines.items():
        print(f"{name}: {line.utilisation:.0%} of the wire used")


if __name__ == "__main__":
    main(float(sys.argv[1]) if sys.argv[1:] else 5.0)
