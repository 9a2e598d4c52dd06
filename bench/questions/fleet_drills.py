"""Fleet drills: gateways and NATS nodes are killed and stopped; how long is a line silent, and who overlaps?

Real processes on this machine: three NATS nodes, three gateways, and lines on sockets that note each request
with the connection it came by. A gap is the longest time between two requests of one line, from the deed on
for 11 s and more.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
from functools import partial
from pathlib import Path

from bench.support import tables

ROOT = Path(__file__).parents[2]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--lines", type=int, default=12)
    parser.add_argument("--deed", action="append", help="only this one; may be given again")
    arguments = parser.parse_args()
    sys.path.insert(0, str(ROOT / "tests" / "support"))
    from fleet_drills import DEEDS, drilled

    tables.heading("How long is a line silent when something of its fleet dies, and do masters overlap?")
    rows = []
    with tempfile.TemporaryDirectory() as folder, drilled(Path(folder), arguments.lines) as drill:
        for deed in arguments.deed or DEEDS:
            worst = []
            before = drill.hall.overlaps()
            for _ in range(arguments.rounds):
                drill.settle()
                worst.append(max(drill.judge(partial(DEEDS[deed], drill)).values()))
            overlaps = drill.hall.overlaps() - before
            middle, most = f"{statistics.median(worst):.2f}", f"{max(worst):.2f}"
            rows.append((deed, len(worst), overlaps, middle, most))
    tables.show(("deed", "rounds", "overlaps", "median, s", "worst, s"), rows)


if __name__ == "__main__":
    main()
