"""How long is a line without requests if gateways or NATS nodes are killed, and do two gateways poll it?

All processes are real and run on this machine: three NATS nodes, three gateways, and lines on sockets that
record each request with its connection. The second part puts each gateway and each node into a network
namespace, and cuts its connection for 1 to 8 s; this needs root. The third part puts a gateway and a node
into each of three namespaces, like three machines. A gap is the longest time between two requests on a line
in the 11 s or more after an attack.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from fleet_drills import (
    CUTS,
    DEEDS,
    MACHINES,
    FleetDrill,
    cut,
    drilled,
    drilled_in_network,
    drilled_on_machines,
)
from namespaces import why_none

from bench.support import tables


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--lines", type=int, default=12)
    parser.add_argument("--deed", action="append", help="only this one; may be given again")
    arguments = parser.parse_args()

    tables.heading("How long is a line silent when something of its fleet dies, and do masters overlap?")
    rows: list[tuple[object, ...]] = []

    def repeat(drill: FleetDrill, name: str, deed: Callable[[Any], object]) -> None:
        worst: list[float] = []
        before = drill.hall.overlaps()
        for _ in range(arguments.rounds):
            drill.settle()
            worst.append(max(drill.judge(partial(deed, drill)).values()))
        overlaps = drill.hall.overlaps() - before
        rows.append((name, len(worst), overlaps, f"{statistics.median(worst):.2f}", f"{max(worst):.2f}"))
        print(*rows[-1], sep=", ", file=sys.stderr)

    wanted = arguments.deed or [*DEEDS, *CUTS, *MACHINES]
    if deeds := [name for name in wanted if name in DEEDS]:
        with tempfile.TemporaryDirectory() as folder, drilled(Path(folder), arguments.lines) as drill:
            for name in deeds:
                repeat(drill, name, DEEDS[name])
    cuts, reason = [name for name in wanted if name in CUTS], why_none()
    if cuts and not reason:
        with (
            tempfile.TemporaryDirectory() as folder,
            drilled_in_network(Path(folder), arguments.lines) as drill,
        ):
            for name in cuts:
                repeat(drill, name, partial(cut, name=name))
    machines = [name for name in wanted if name in MACHINES]
    if machines and not reason:
        with (
            tempfile.TemporaryDirectory() as folder,
            drilled_on_machines(Path(folder), arguments.lines) as drill,
        ):
            for name in machines:
                repeat(drill, name, MACHINES[name])
    tables.show(("deed", "rounds", "overlaps", "median, s", "worst, s"), rows)
    if (cuts or machines) and reason:
        print(f"\nno cables were cut: {reason}")


if __name__ == "__main__":
    main()
