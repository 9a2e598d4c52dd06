"""The host's CPU time per exchange, on lines without waits: on a pty and over TCP.

A minimal write-poll-read loop in C runs before every measurement. Ratios compare multidrop with that loop.
Both ends of the line run on the same processor, because results then vary least. A default run takes six
minutes.
"""

from __future__ import annotations

import argparse
from statistics import median
from typing import Any

from bench.masters import rivals
from bench.masters.jobs import REGISTERS, Job
from bench.support import tables
from bench.support.programs import on_processor, paced_line

BARE = "bare C"
LINES: dict[str, dict[str, Any]] = {"pty": {}, "TCP": {"tcp": True}}


def measured(master: str, seconds: float, **options: Any) -> dict[str, Any]:
    with paced_line(baudrate=0, **options) as line:
        job = Job(line.path, 0, seconds)
        own = rivals.measure_bare(job, 0) if master == BARE else rivals.measure(master, job)
    good = max(1, own["exchanges"])
    if line.report["answered"] < good:
        raise AssertionError(
            f"{master} reports {good} exchanges, but the line answered {line.report['answered']}"
        )
    if line.report["registers"] != REGISTERS * line.report["answered"]:
        raise AssertionError(
            f"{master} reads {line.report['registers']} registers with {line.report['answered']} requests"
        )
    return own | {"rate": good / own["seconds"], "cpu": own["cpu_seconds"] / good * 1e6}


def row(where: str, master: str, slices: list[dict[str, Any]], bare: list[dict[str, Any]]) -> list[str]:
    pairs = list(zip(slices, bare, strict=True))
    failed = sum(each["failures"] for each in slices)
    return [
        where,
        master,
        slices[0]["version"],
        f"{median(each['rate'] for each in slices):.0f}",
        f"{median(each['rate'] / yard['rate'] for each, yard in pairs):.3f}",
        f"{median(each['cpu'] for each in slices):.1f}",
        f"{median(each['cpu'] / yard['cpu'] for each, yard in pairs):.2f}",
        str(failed),
    ]


def compared(where: str, arguments: argparse.Namespace) -> list[list[str]]:
    rows, yards = [], []
    for master in arguments.masters:
        bare, slices = [], []
        for _ in range(arguments.slices):
            bare.append(measured(BARE, arguments.seconds, **LINES[where]))
            slices.append(measured(master, arguments.seconds, **LINES[where]))
        yards += bare
        rows.append(row(where, master, slices, bare))
    return [*rows, row(where, BARE, yards, yards)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--masters", nargs="+", choices=rivals.MASTERS, default=rivals.MASTERS)
    parser.add_argument("--seconds", type=float, default=2.0, help="of a slice")
    parser.add_argument("--slices", type=int, default=5)
    arguments = parser.parse_args()
    rivals.insist_on(arguments.masters)
    tables.heading(
        "Lines without waits: 16 drives, 10 registers each, the library's own silence if it has one."
    )

    with on_processor(0):
        rows = [line for where in LINES for line in compared(where, arguments)]
    columns = ("line", "master", "version", "exchanges/s", "/ bare", "CPU us", "/ bare", "failed")
    tables.show(columns, rows)
    print("\nTCP: the same RTU frames; CPU us: of the master's process, per good exchange.")


if __name__ == "__main__":
    main()
