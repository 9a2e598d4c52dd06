"""Record a plant into a Parquet file: `python examples/logger.py`. Needs `pip install '.[parquet]'`.

With real ports: `python examples/logger.py --plant plant.toml --seconds 3600`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from simulated_plant import simulated_plant

from multidrop import Plant, Poller, open_writer
from multidrop.recording import convert

PLANT = """
[[line]]
name = "hall"
port = "{ports}/hall"

[[line.drive]]
name = "pump"
model = "innovert-ibd"
address = 1
poll = ["output_current", "motor_speed"]

[[line.drive]]
name = "fan"
model = "yd1000"
address = 2
every = "500 ms"
poll = ["output_frequency"]
"""


def record(plant: Plant, seconds: float, out: Path) -> int:
    """Record into Arrow, which survives a crash, and convert at the end; return the number of rows."""
    safe = out.with_suffix(".arrows")
    with Poller(plant) as poller, open_writer(safe, plant.metadata()) as writer:
        for batch in poller.batches(seconds=seconds):
            writer.write(batch)
    return convert(safe, out)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plant", help="default: simulated drives")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--out", type=Path, default=Path("log.parquet"))
    arguments = parser.parse_args()
    if arguments.plant:
        rows = record(Plant.load(arguments.plant), arguments.seconds, arguments.out)
    else:
        with simulated_plant(PLANT) as plant:
            rows = record(plant, arguments.seconds, arguments.out)
    print(f"{rows} rows in {arguments.out}")


if __name__ == "__main__":
    main()
