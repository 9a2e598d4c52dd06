"""Does the resident memory of a process that polls a line without waits grow over many exchanges?"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from bench.masters import adapter
from bench.masters.jobs import Job
from bench.support import tables
from bench.support.programs import paced_line

WARM_UP = 0.02  # share of the exchanges; after them, buffers have their final size
ROWS = 10


def resident_kb() -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1])
    raise RuntimeError("the kernel does not report the resident memory")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--exchanges", type=int, default=10_000_000)
    total = parser.parse_args().exchanges
    tables.heading(
        f"{total} exchanges of 10 registers over TCP without waits; batches are taken and discarded."
    )

    rows = []
    with paced_line(baudrate=0, tcp=True) as line, adapter.polling(Job(line.path, 0, 0)) as poller:
        first, begun = 0, time.monotonic()
        marks = [WARM_UP * total, *(total * (at + 1) / ROWS for at in range(ROWS))]
        for mark in marks:
            while sum(done := adapter.counts(poller)) < mark:
                for _ in poller.batches(0.1):
                    pass
            now = resident_kb()
            first = first or now
            rows.append((*done, f"{time.monotonic() - begun:.0f}", now, f"{now - first:+d}"))
    tables.show(("exchanges", "failed", "seconds", "resident kB", "since warm-up"), rows)


if __name__ == "__main__":
    main()
