"""What a stray byte before every reply, and silent drives, cost the others on a paced line.

31 drives at 38400. Each case is held against the same plant without the fault: without the stray
bytes, or without the silent drives.
"""

from __future__ import annotations

import argparse
from typing import Any

import rivals
import tables
from jobs import Job
from programs import paced_line

DRIVES = 31
BAUDRATE = 38400


def measured(master: str, drives: int, arguments: argparse.Namespace, **fault: Any) -> tuple[float, float]:
    """Answers per second that drives gave once the master was settled, and the share that it read."""
    settle_ms = round(arguments.settle * 1000)
    with paced_line(baudrate=BAUDRATE, drives=drives, settle_ms=settle_ms, **fault) as line:
        own = rivals.measure(master, Job(line.path, BAUDRATE, arguments.settle + arguments.seconds, drives))
    asked = own["exchanges"] + own["failures"]
    return line.report["answered"] / max(line.report["seconds"], 1e-9), own["exchanges"] / max(asked, 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    known = list(rivals.MASTERS)
    parser.add_argument("--masters", nargs="+", choices=known, default=known[:3])
    parser.add_argument("--silent", type=int, nargs="+", default=[0, 1, 5, 10], help="how many of 31")
    parser.add_argument("--settle", type=float, default=10.0, help="seconds before anything is counted")
    parser.add_argument("--seconds", type=float, default=20.0, help="that are counted")
    arguments = parser.parse_args()
    rivals.insist_on(arguments.masters)
    tables.heading(f"A paced line of {DRIVES} drives at {BAUDRATE}, 10 registers each, with faults.")

    rows = []
    for master in arguments.masters:
        whole, read = measured(master, DRIVES, arguments)
        rows.append((master, "no fault", f"{whole:.1f}", "100.0%", f"{read:.1%}"))
        rate, read = measured(master, DRIVES, arguments, stray=True)
        rows.append((master, "00 before every reply", f"{rate:.1f}", f"{rate / whole:.1%}", f"{read:.1%}"))
        for dead in filter(None, arguments.silent):
            living = DRIVES - dead
            alone, _ = measured(master, living, arguments)
            silent = ",".join(str(address) for address in range(living + 1, DRIVES + 1))
            rate, read = measured(master, DRIVES, arguments, silent=silent)
            rows.append((master, f"{dead} silent", f"{rate:.1f}", f"{rate / alone:.1%}", f"{read:.1%}"))
    tables.show(("master", "case", "answers/s", "kept", "read"), rows)
    print(
        "\nread: good exchanges of all that were asked, from the start on; a silent drive's count as failed."
    )


if __name__ == "__main__":
    main()
