"""The cost of faults on a paced line: stray bytes, silent drives, refused requests.

The line has 31 drives (or `--drives`) at 38400 baud. Each rate is divided by the rate of the same plant
without the stray bytes, or without the silent drives, measured immediately before. All figures are medians.
`python -m bench.questions.wire.faults MASTER JOB` is the process of a master whose requests are refused.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import asdict
from statistics import median
from typing import Any

from bench.masters import rivals
from bench.masters.jobs import REGISTERS, TIMEOUT_S, Job
from bench.support import tables
from bench.support.programs import module, paced_line

DRIVES = 31
BAUDRATE = 38400
REFUSALS = 20
CHARACTERS = 8 + 5  # characters of a request and of its exception reply
WIRE_MS = CHARACTERS * 10 / BAUDRATE * 1e3 + 2


def measured(master: str, drives: int, arguments: argparse.Namespace, **fault: Any) -> tuple[float, float]:
    """Let a master poll a line with this fault; return replies per second, and the share of good exchanges.

    Replies during the settling time at the start are not counted."""
    settle_ms = round(arguments.settle * 1000)
    with paced_line(baudrate=BAUDRATE, drives=drives, settle_ms=settle_ms, **fault) as line:
        own = rivals.measure(master, Job(line.path, BAUDRATE, arguments.settle + arguments.seconds, drives))
    asked = own["exchanges"] + own["failures"]
    return line.report["answered"] / max(line.report["seconds"], 1e-9), own["exchanges"] / max(asked, 1)


def cases(drives: int, silent: list[int]) -> Iterator[tuple[str, int, dict[str, Any]]]:
    """Yield each fault's name, the number of drives without the fault, and paced_line's options for it."""
    yield "00 before every reply", drives, {"stray": True}
    for dead in silent:
        living = drives - dead
        yield f"{dead} silent", living, {"silent": ",".join(map(str, range(living + 1, drives + 1)))}


def cost(
    master: str, case: str, arguments: argparse.Namespace, drives: int, fault: dict[str, Any]
) -> tuple[str, ...]:
    slices = []
    for _ in range(arguments.slices):
        without, _ = measured(master, drives, arguments)
        rate, read = measured(master, arguments.drives, arguments, **fault)
        slices.append((without, rate, rate / without, read))
    without, rate, kept, read = (median(column) for column in zip(*slices, strict=True))
    return master, case, f"{without:.1f}", f"{rate:.1f}", f"{kept:.1%}", f"{read:.1%}"


# ---- requests that are refused ----


def of_multidrop(job: Job) -> AbstractContextManager[Callable[[int], object]]:
    from bench.masters import adapter

    return adapter.reading(job)


READERS = {"multidrop": of_multidrop, **rivals.READERS}


def ask_in_vain(master: str, job: Job) -> None:
    """Print as JSON how many ms each call took to report that the drive refused, and the error's text."""
    took, said = [], "an empty answer"
    with READERS[master](job) as read:
        for at in range(REFUSALS):
            begun = time.monotonic()
            try:
                read(1 + at % job.drives)
            except Exception as failure:  # each master has its own error classes
                said = str(failure) or type(failure).__name__
            took.append(1e3 * (time.monotonic() - begun))
    print(json.dumps({"took": took, "said": said.splitlines()[0]}))


def refused(master: str) -> tuple[str, ...]:
    with paced_line(baudrate=BAUDRATE, registers=REGISTERS - 1) as line:
        job = json.dumps(asdict(Job(line.path, BAUDRATE, 0)))
        told = json.loads(subprocess.check_output(module("bench.questions.wire.faults", master, job)))
    took = told["took"]
    return master, f"{median(took):.1f}", f"{max(took):.1f}", told["said"][:90]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    known = list(rivals.MASTERS)
    parser.add_argument("--masters", nargs="+", choices=known, default=known[:3])
    parser.add_argument("--drives", type=int, default=DRIVES)
    parser.add_argument("--silent", type=int, nargs="+", default=[0, 1, 5, 10], help="how many of them")
    parser.add_argument("--settle", type=float, default=10.0, help="seconds before anything is counted")
    parser.add_argument("--seconds", type=float, default=20.0, help="that are counted; 0: only refusals")
    parser.add_argument("--slices", type=int, default=3, help="pairs, without the fault and with it")
    arguments = parser.parse_args()
    rivals.insist_on(arguments.masters)
    tables.heading(
        f"A paced line of {arguments.drives} drives at {BAUDRATE}, 10 registers each, with faults."
    )

    rows = [
        cost(master, case, arguments, drives, fault)
        for master in (arguments.masters if arguments.seconds else ())
        for case, drives, fault in cases(arguments.drives, arguments.silent)
    ]
    if rows:
        tables.show(("master", "case", "without", "answers/s", "kept", "read"), rows)
        print(
            "\nwithout: replies per second without the fault; kept: the median share of each pair."
            "\nread: good exchanges as a share of all, from the start on; silent drives' count as failed.\n"
        )

    readers = [master for master in READERS if master in arguments.masters]
    print(f"A drive that answers with an exception; time-out {1e3 * TIMEOUT_S:g} ms.")
    print(f"On the wire that takes {WIRE_MS:.1f} ms, without the silence before it.\n")
    tables.show(("master", "known after ms p50", "max", "told"), [refused(master) for master in readers])


if __name__ == "__main__":
    if len(sys.argv) == 3 and sys.argv[1] in READERS:
        ask_in_vain(sys.argv[1], Job(**json.loads(sys.argv[2])))
    else:
        main()
