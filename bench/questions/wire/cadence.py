"""The polling rate and the delay of results, alone and while another Python thread computes.

With `--loops N`, N busy programs compute instead of the thread. The simulated line then has realtime
scheduling, which needs root.

`python -m bench.questions.wire.cadence MASTER JOB LOOPS` is the process of one master. It prints its results
as JSON.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy

from bench.masters import rivals
from bench.masters.jobs import TIMEOUT_S, Job
from bench.support import tables
from bench.support.programs import busy_loops, module, paced_line


def compute_without_pause() -> None:
    number = 0
    while True:
        number = (number * 1103515245 + 12345) & 0x7FFFFFFF


def of_multidrop(job: Job, *, realtime: bool = False) -> tuple[int, numpy.ndarray]:
    from bench.masters import adapter

    return adapter.lateness_ms(job, realtime=realtime)


def of_pymodbus(job: Job) -> tuple[int, numpy.ndarray]:
    """Return the number of good exchanges, and the time in ms of each call without its time on the wire."""
    wire = job.wire if job.baudrate else 0.0
    took: list[float] = []
    with rivals.pymodbus(job) as read:
        end = time.monotonic() + job.seconds
        while (begun := time.monotonic()) < end:
            read(1 + len(took) % job.drives)
            took.append(time.monotonic() - begun - wire)
    good = [each for each in took if each < TIMEOUT_S]
    return len(good), numpy.array(good) * 1e3


MASTERS: dict[str, Callable[[Job], tuple[int, numpy.ndarray]]] = {
    "multidrop": of_multidrop,
    "multidrop, realtime": partial(of_multidrop, realtime=True),
    "pymodbus": of_pymodbus,
}


def work(master: str, job: Job, loops: int) -> None:
    """Print a master's rate and delays as JSON: first alone, then on a busy computer.

    The load is `loops` busy programs; if `loops` is 0, it is a busy thread of the master's own process.
    """
    told = {}
    for when in ("alone", "beside"):
        if when == "beside" and not loops:
            threading.Thread(target=compute_without_pause, daemon=True).start()
        with busy_loops(loops if when == "beside" else 0):
            good, late = MASTERS[master](job)
        late = late if len(late) else numpy.array([numpy.nan])
        p50, p99, most = numpy.percentile(late, [50, 99, 100])
        told[when] = {"rate": good / job.seconds, "p50": p50, "p99": p99, "max": most}
    print(json.dumps(told))


def measured(master: str, baudrate: int, seconds: float, loops: int) -> dict[str, Any]:
    is_realtime = {"realtime": True} if loops else {}
    with paced_line(baudrate=baudrate, **is_realtime) as line:
        job = json.dumps(asdict(Job(line.path, baudrate, seconds)))
        told: dict[str, Any] = json.loads(
            subprocess.check_output(module("bench.questions.wire.cadence", master, job, loops))
        )
    return told


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--baudrates", type=int, nargs="+", default=[38400, 115200, 0], help="0: no waits")
    parser.add_argument("--masters", nargs="+", choices=MASTERS, default=list(MASTERS))
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--loops", type=int, default=0, help="number of busy programs instead of the thread")
    arguments = parser.parse_args()
    rivals.insist_on(arguments.masters)
    beside = f"{arguments.loops} busy programs" if arguments.loops else "a Python thread"
    tables.heading(f"16 drives, 10 registers each, beside {beside} without pauses.")

    rows = []
    for baudrate in arguments.baudrates:
        for master in arguments.masters:
            told = measured(master, baudrate, arguments.seconds, arguments.loops)
            alone, beside = told["alone"], told["beside"]
            kept = beside["rate"] / alone["rate"] if alone["rate"] else 0.0
            rates = f"{alone['rate']:.1f}", f"{beside['rate']:.1f}", f"{kept:.1%}"
            late = [f"{when[key]:.1f}" for when in (alone, beside) for key in ("p50", "p99", "max")]
            rows.append((f"{baudrate or 'no waits'}", master, *rates, *late))
    columns = (
        "baud",
        "master",
        "alone/s",
        "beside/s",
        "kept",
        "late ms p50",
        "p99",
        "max",
        "beside p50",
        "p99",
        "max",
    )
    tables.show(columns, rows)
    print(
        "\nlate: multidrop, from a reply's first byte until the consumer has the value;"
        "\npymodbus, how much longer than its time on the wire the call takes."
    )


if __name__ == "__main__":
    if len(sys.argv) == 4 and sys.argv[1] in MASTERS:
        work(sys.argv[1], Job(**json.loads(sys.argv[2])), int(sys.argv[3]))
    else:
        main()
