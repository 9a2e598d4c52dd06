"""Does a gateway in a large fleet poll its lines at their configured rate, like a poller alone?

A fleet of 20 gateways on three real NATS nodes has thousands of lines, all on this machine. Nineteen
gateways are only state machines, whose lines do not exist. The real gateway polls its share: some 500 lines
on TCP sockets with one drive each. Before that, `multidrop poll` polls the same lines alone. Two CPU cores
can poll 500 lines only at a modest rate: twice a second by default. The simulated drives measure the rates.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from fleet_scale import cpu_s_of, groups, large_fleet, plant_of_fake_lines, until
from nats_clusters import cluster
from serial_hall import SerialHall

from bench.support import tables
from multidrop.fleet.lines.shares import assign
from multidrop.fleet.servers.plant_store import read_plant

REAL = "gw-00"
SETTLE_S = 5.0


class Seen(NamedTuple):
    """The results of one run as the simulated drives measured them, and the polling process's CPU time."""

    requests: int
    longest_s: float
    cpu_s: float
    seconds: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--lines", type=int, default=10_000, help="of the fleet")
    parser.add_argument("--gateways", type=int, default=20)
    parser.add_argument("--every", default="500 ms", help="between two exchanges of a line")
    parser.add_argument("--seconds", type=float, default=30.0, help="of each run")
    arguments = parser.parse_args()

    tables.heading("Does a real gateway among a fleet's others keep the rate of its lines?")
    _, most_files = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most_files, most_files))
    every = groups(arguments.gateways, 4)
    everywhere = plant_of_fake_lines(arguments.lines)
    shares = assign(list(everywhere), [name for group in every for name in group])
    own = [line for line, gateway in shares.items() if gateway == REAL]

    def run(words: Sequence[str]) -> Seen:
        """Run `multidrop` with these arguments, which poll all lines, for a while; return the results."""
        log, command = Path(folder) / "log", [sys.executable, "-m", "multidrop", *words]
        with log.open("wb") as output, subprocess.Popen(command, stdout=output, stderr=output) as process:
            try:

                def are_polled() -> bool:
                    assert process.poll() is None, f"multidrop {words[0]} ended: {log.read_text()}"
                    return hall.are_polled(2.0)

                until(are_polled, "all lines are polled")
                time.sleep(SETTLE_S)
                hall.reset()
                before, used, begun = hall.requests(), cpu_s_of(process.pid), time.monotonic()
                time.sleep(arguments.seconds)
                requests, seconds = hall.requests() - before, time.monotonic() - begun
                return Seen(requests, max(hall.gaps().values()), cpu_s_of(process.pid) - used, seconds)
            finally:
                process.kill()

    with tempfile.TemporaryDirectory() as folder:
        hall = SerialHall(len(own), names=own)
        plant = Path(folder) / "plant.toml"
        plant.write_text(hall.plant(arguments.every))
        rows = [("multidrop poll, alone", run(["poll", str(plant), "--out", f"{folder}/alone.arrows"]))]
        _, real = read_plant(plant)
        with cluster(Path(folder) / "nats") as nats, large_fleet(nats, everywhere | real) as fleet:
            fleet.start(*[[name for name in group if name != REAL] for group in every])
            until(lambda: fleet.polled() == arguments.lines, "the others have all lines")
            serve = ["fleet", "serve", REAL, "--folder", f"{folder}/{REAL}", "--nats", ",".join(nats.urls)]
            rows.append((f"a gateway among {arguments.gateways}", run(serve)))
        hall.close()
    tables.show(
        ("what polls", "lines", "requests/s", "of what is asked", "longest gap, s", "of a core"),
        [
            (
                name,
                len(own),
                f"{seen.requests / seen.seconds:.0f}",
                f"{seen.requests / seen.seconds * seconds_of(arguments.every) / len(own):.3f}",
                f"{seen.longest_s:.2f}",
                f"{seen.cpu_s / seen.seconds:.1%}",
            )
            for name, seen in rows
        ],
    )


def seconds_of(text: str) -> float:
    """Convert a time such as "500 ms" or "2 s" to seconds."""
    number, unit = text.split()
    return float(number) * {"ms": 0.001, "s": 1.0}[unit]


if __name__ == "__main__":
    main()
