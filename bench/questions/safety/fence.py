"""Does a suspended master send requests on lines that another master has taken over? Counted by the drives.

A process polls 10 socket:// lines under a lease, and is suspended (SIGSTOP) at a random moment. Another
process takes over when, by its own clock, the last renewal is older than lease plus guard time. Then the
first process continues. There are three kinds of first processes: with clock check and kernel timer, with the
clock check only, and without both. Exits with 1 if a request got through in the first kind, or if none got
through in the third.
"""

from __future__ import annotations

import argparse
import random
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

from fencing import Fence, Round

from bench.support import tables

AN_HOUR = 3600.0
KINDS: dict[str, dict[str, float]] = {
    "look and timer": {},
    "look alone": {"timer": AN_HOUR},
    "neither": {"timer": AN_HOUR, "beyond": AN_HOUR},
}
HEADS = ("held back by", "stops", "killed", "rounds with stale requests", "stale requests")


def rounds(kind: str, stops: int, lines: int, lease: float, guard: float, seed: int) -> list[Round]:
    chance = random.Random(seed)
    fence = Fence(lines, lease, guard, **KINDS[kind])
    try:
        return [fence.stop_once(chance) for _ in range(stops)]
    finally:
        fence.close()


def side_by_side(kind: str, stops: int, details: argparse.Namespace) -> list[Round]:
    """Suspend masters `stops` times, in several processes at once; each process has its own lines."""
    jobs = details.jobs
    shares = [stops // jobs + (job < stops % jobs) for job in range(jobs)]
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        found = [
            pool.submit(rounds, kind, share, details.lines, details.lease, details.guard, details.seed + job)
            for job, share in enumerate(shares)
        ]
        return [one for each in found for one in each.result()]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stops", type=int, default=2000, help="of the first kind; a tenth of the others")
    parser.add_argument("--lines", type=int, default=10)
    parser.add_argument("--lease", type=float, default=0.3, metavar="S")
    parser.add_argument("--guard", type=float, default=0.3, metavar="S")
    parser.add_argument("--jobs", type=int, default=1, help="processes that do this side by side")
    parser.add_argument("--seed", type=int, default=1)
    details = parser.parse_args()
    tables.heading(
        f"{details.lines} lines, lease {details.lease:g} s, guard {details.guard:g} s; a master is stopped "
        "at a random moment."
    )
    stops = {"look and timer": details.stops, "look alone": details.stops // 10, "neither": 20}
    found = {kind: side_by_side(kind, stops[kind], details) for kind in KINDS}
    tables.show(
        HEADS,
        [
            (
                kind,
                len(each),
                sum(one.is_killed for one in each),
                sum(one.stale > 0 for one in each),
                sum(one.stale for one in each),
            )
            for kind, each in found.items()
        ],
    )
    is_held = not any(one.stale for one in found["look and timer"])
    return 0 if is_held and all(one.stale for one in found["neither"]) else 1


if __name__ == "__main__":
    sys.exit(main())
