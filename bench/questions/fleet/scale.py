"""The time until each of 10,000 lines has a gateway: at the start, and after a quarter of the fleet dies.

Four processes with the state machines of 20 gateways, and three NATS nodes, run on this machine. The lines do
not exist, so no port is opened. The time of a cold start counts from the moment when all processes are
connected. CPU seconds are the sum of all gateways and servers; two cores offer 16 CPU seconds in 8 s.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

from fleet_scale import groups, large_fleet, plant_of_fake_lines
from nats_clusters import cluster

from bench.support import tables


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--lines", type=int, default=10_000)
    parser.add_argument("--gateways", type=int, default=20)
    parser.add_argument("--kills", type=int, default=3)
    arguments = parser.parse_args()

    tables.heading("How soon has each line of a large fleet a gateway?")
    rows: list[tuple[object, ...]] = []

    def note(what: str, seconds: float, lines: int, since_s: float) -> None:
        loads, used = fleet.loads(), fleet.cpu_s() - since_s
        share, load = f"{loads[0]} to {loads[-1]}", f"{os.getloadavg()[0]:.1f}"
        rows.append((what, lines, f"{seconds:.2f}", f"{used:.1f}", share, load))
        print(*rows[-1], sep=", ", file=sys.stderr)

    with (
        tempfile.TemporaryDirectory() as folder,
        cluster(Path(folder)) as nats,
        large_fleet(nats, plant_of_fake_lines(arguments.lines)) as fleet,
    ):
        used = fleet.cpu_s()
        note("cold start", fleet.settled(fleet.start(*groups(arguments.gateways, 4))), arguments.lines, used)
        fleet.check()
        for at in range(arguments.kills):
            dead = fleet.processes[at]
            lost = sum(dead.counts.values())
            used = fleet.cpu_s() - dead.cpu_s()
            note(f"{len(dead.gateways)} of {arguments.gateways} killed", fleet.kill(dead), lost, used)
            fleet.check()
            begun = fleet.start(dead.gateways)
            fleet.settled(begun)
            time.sleep(10)  # until the fleet's balancing has moved lines to the new gateways
            fleet.check()
    tables.show(("what", "lines", "until the last, s", "CPU s", "lines a gateway", "load"), rows)


if __name__ == "__main__":
    main()
