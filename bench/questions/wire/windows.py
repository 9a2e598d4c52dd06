"""The utilisation of a paced line, and requests that came too early: on a COM port with Wine, and on Linux.

`tools/wine make` must have filled FOLDER. Wine is not Windows: its timers have a resolution of 1 ms, each
wait goes through another process (wineserver), and its COM port is a pseudo-terminal.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from statistics import median
from typing import Any

from bench.masters import rivals
from bench.masters.jobs import REGISTERS, Job
from bench.support import tables
from bench.support.programs import HERE, paced_line

COLUMNS = (
    "baud",
    "system",
    "utilisation",
    "requests",
    "too early",
    "given up",
    "late us",
    "CPU us",
    "misses",
)
COM = 5


def here(job: Job, folder: Path) -> dict[str, Any]:
    """Run a job on this system; return its CPU seconds and the number of exchanges without values."""
    own = rivals.measure("multidrop", job)
    return {"cpu": own["cpu_seconds"], "misses": own["failures"]}


def on_windows(job: Job, folder: Path) -> dict[str, Any]:
    """Run a job with Wine; return its CPU seconds and the number of exchanges without values."""
    link = folder / "wine" / "dosdevices" / f"com{COM}"
    link.unlink(missing_ok=True)
    link.symlink_to(job.port)
    words = [HERE.parent / "tools" / "wine", folder, HERE / "masters" / "windows_master.py"]
    told = subprocess.check_output([*words, json.dumps(asdict(replace(job, port=f"COM{COM}")))], text=True)
    own = json.loads(told.splitlines()[-1])
    return {"cpu": own["cpu_seconds"], "misses": own["misses"] // REGISTERS}


SYSTEMS: dict[str, Callable[[Job, Path], dict[str, Any]]] = {"Linux": here, "Windows": on_windows}


def measured(system: str, baudrate: int, seconds: float, folder: Path) -> dict[str, Any]:
    """Poll a line on Linux or with Wine; return what the simulated drives and the master measured."""
    with paced_line(baudrate=baudrate) as line:
        own = SYSTEMS[system](Job(line.path, baudrate, seconds), folder)
    report = line.report
    requests = report["answered"] + report["unanswered"]
    return own | {
        "utilisation": report["utilisation"],
        "requests": requests,
        "early": report["early"],
        "given_up": report["given_up"],
        "late": report["excess_us"]["p50"],
        "cpu": own["cpu"] / max(1, requests) * 1e6,
    }


def row(baudrate: int, system: str, slices: list[dict[str, Any]]) -> list[str]:
    middle = {key: median(each[key] for each in slices) for key in ("utilisation", "late", "cpu")}
    total = {key: sum(each[key] for each in slices) for key in ("requests", "early", "given_up", "misses")}
    return [
        str(baudrate),
        system,
        f"{middle['utilisation']:.4f}",
        str(total["requests"]),
        str(total["early"]),
        str(total["given_up"]),
        f"{middle['late']:.0f}",
        f"{middle['cpu']:.0f}",
        str(total["misses"]),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--baudrates", type=int, nargs="+", default=[9600, 38400, 115200])
    parser.add_argument("--seconds", type=float, default=3.0, help="of a slice")
    parser.add_argument("--slices", type=int, default=3)
    parser.add_argument("--ahead", action="store_true", help="run line and masters with SCHED_RR; needs root")
    arguments = parser.parse_args()
    if arguments.ahead:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(2))
    tables.heading("A paced line, as in utilisation.py, on a pseudo-terminal: by Linux, and as COM5 by Wine.")
    rows = []
    for baudrate in arguments.baudrates:
        slices: dict[str, list[dict[str, Any]]] = {system: [] for system in SYSTEMS}
        for _ in range(arguments.slices):
            for system in SYSTEMS:
                slices[system].append(measured(system, baudrate, arguments.seconds, arguments.folder))
        rows += [row(baudrate, system, slices[system]) for system in SYSTEMS]
    tables.show(COLUMNS, rows)
    print(
        "\nutilisation: ideal bus cycle / measured."
        "\ntoo early: requests more than 20 us before the silence was over."
        "\ngiven up: of these, those sent before the previous reply had come: it was delayed for longer than"
        "\nthe time-out, and the master had stopped waiting for it."
        "\nlate: median time from the end of the silence until a request is seen."
        "\nCPU: of the master's process, per exchange, without Wine's server."
        "\nmisses: exchanges without values."
    )


if __name__ == "__main__":
    main()
