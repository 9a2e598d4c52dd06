"""The host's cost of an exchange when one process polls many lines.

Before every measurement, a minimal epoll loop in C polls the same number of lines. Ratios compare multidrop
with that loop. The client runs on one processor and the responders on another. On the same processor, the
responders would interrupt a slower client every few exchanges. Numbers of lines beyond a limit of the system
are skipped, and the limit is printed. A default run takes a quarter of an hour.
`python -m bench.questions.wire.many_lines JOB` is the process that polls.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from operator import itemgetter
from pathlib import Path
from statistics import median
from typing import Any

from bench.masters import jobs
from bench.players.responders import responders
from bench.support import tables
from bench.support.programs import FRAMES, compiled, module, on_processor

BAUDRATE = 115200
DELAY_US = 2000
SETTLE_S = 2.0  # time for the first exchanges of thousands of drives
DESCRIPTORS = 5  # a poller's descriptors per line: port and two pipes; responders need fewer
OTHERS = 64  # descriptors that the process needs besides its lines
PTYS = Path("/proc/sys/kernel/pty")


@dataclass(frozen=True)
class Lines:
    """Ports to poll for `seconds`: paths, or numbers of open descriptors."""

    ports: Sequence[str]
    baudrate: int
    seconds: float


# ---- the process that polls ----


def _thread_seconds() -> dict[int, float]:
    """Return the CPU seconds of each thread of this process."""
    tasks = Path("/proc/self/task").iterdir()
    return {int(task.name): int((task / "schedstat").read_text().split()[0]) / 1e9 for task in tasks}


def poll(job: Lines) -> dict[str, Any]:
    from bench.masters import adapter, many_adapter

    begun = time.monotonic()
    with many_adapter.polling_lines(job.ports, job.baudrate) as poller:
        opened = time.monotonic() - begun
        for _ in poller.batches(SETTLE_S):
            pass
        while poller.take():
            pass
        used, begun, good, bad, dropped = _thread_seconds(), time.monotonic(), 0, 0, adapter.dropped(poller)
        for batch in poller.batches(job.seconds):
            failed = adapter.missed(batch)
            good, bad = good + len(batch) - failed, bad + failed
        left, seconds = _thread_seconds(), time.monotonic() - begun
        in_python = {thread.native_id for thread in threading.enumerate()}
        if lost := adapter.dropped(poller) - dropped:
            raise AssertionError(f"the poller dropped {lost} rows, besides {good + bad} rows that were taken")
    spent = {thread: left[thread] - used.get(thread, 0.0) for thread in left}
    return {
        "exchanges": good // jobs.REGISTERS,
        "failures": bad // jobs.REGISTERS,
        "cpu_seconds": sum(spent.values()),
        "python_seconds": sum(spent[thread] for thread in spent if thread in in_python),
        "seconds": seconds,
        "opened": opened,
    }


# ---- the process that measures ----


def room(kind: str) -> dict[str, int]:
    """Return the number of lines of this kind (ptys or sockets) that each limit of the system allows."""
    files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    limits = {f"{DESCRIPTORS} descriptors a line, {files} a process": (files - OTHERS) // DESCRIPTORS}
    if kind == "pty":
        most, used = (int((PTYS / name).read_text()) for name in ("max", "nr"))
        limits[f"kernel.pty.max is {most}, {used} are in use"] = most - used
    return limits


def has_room(kind: str, count: int) -> bool:
    """Return True if the system allows `count` lines of this kind; otherwise print the limit."""
    why, most = min(room(kind).items(), key=itemgetter(1))
    if count > most:
        print(f"{kind} {count} is skipped: there is room for {most} ({why}).", flush=True)
    return count <= most


def measured(master: str, kind: str, count: int, seconds: float, paced: bool) -> dict[str, Any]:
    baudrate, delay_us = (BAUDRATE, DELAY_US) if paced else (0, 0)
    with ExitStack() as stack:
        with on_processor(1):
            lines = responders(kind, count, "--baudrate", baudrate, "--delay-us", delay_us)
            ports, fds = stack.enter_context(lines)
        if master == "bare C":
            command = [compiled("masters/bare_lines.c", *FRAMES), seconds, *ports]
        else:
            job = json.dumps(asdict(Lines(ports, baudrate, seconds)))
            command = [*module("bench.questions.wire.many_lines", job)]
        with on_processor(0):
            told = subprocess.check_output([str(word) for word in command], pass_fds=fds)
    own: dict[str, Any] = json.loads(told)
    own["exchanges"] = good = max(1, own["exchanges"])  # a short slice on a busy machine may have none
    return own | {"rate": good / own["seconds"], "cpu": own["cpu_seconds"] / good * 1e6}


Slices = list[dict[str, Any]]


def row(kind: str, count: int, master: str, slices: Slices, bare: Slices) -> list[str]:
    pairs = list(zip(slices, bare, strict=True))
    python = [each["python_seconds"] / each["exchanges"] * 1e6 for each in slices if "python_seconds" in each]
    return [
        kind,
        str(count),
        master,
        f"{median(each['rate'] for each in slices):.0f}",
        f"{median(each['rate'] / yard['rate'] for each, yard in pairs):.3f}",
        f"{median(each['cpu'] for each in slices):.2f}",
        f"{median(each['cpu'] / yard['cpu'] for each, yard in pairs):.2f}",
        f"{median(python):.2f}" if python else "",
        str(sum(each["failures"] for each in slices)),
    ]


def compared(kind: str, count: int, arguments: argparse.Namespace) -> list[list[str]]:
    bare, slices = [], []
    for _ in range(arguments.slices):
        bare.append(measured("bare C", kind, count, arguments.seconds, paced=False))
        slices.append(measured("multidrop", kind, count, arguments.seconds, paced=False))
    return [row(kind, count, "bare C", bare, bare), row(kind, count, "multidrop", slices, bare)]


def paced(arguments: argparse.Namespace) -> list[str]:
    own = measured("multidrop", "socketpair", arguments.paced, arguments.seconds, paced=True)
    share, python = own["cpu_seconds"] / own["seconds"], own["python_seconds"] / own["seconds"]
    cells = f"{own['rate']:.0f}", f"{own['cpu']:.1f}", f"{share:.1%}", f"{python:.1%}", str(own["failures"])
    return [str(arguments.paced), *cells]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--socketpairs", type=int, nargs="*", default=[1, 16, 64, 256, 1024])
    parser.add_argument("--ptys", type=int, nargs="*", default=[1, 16, 64, 256, 1024])
    parser.add_argument("--paced", type=int, default=64, help=f"lines at {BAUDRATE} baud")
    parser.add_argument("--seconds", type=float, default=2.0, help="of a slice")
    parser.add_argument("--slices", type=int, default=5)
    arguments = parser.parse_args()
    tables.heading("Many lines in one process: 16 drives on each, 10 registers each, decoded to columns.")

    _, most_files = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most_files, most_files))
    kinds = {"socketpair": arguments.socketpairs, "pty": arguments.ptys}
    asked = [(kind, count) for kind, counts in kinds.items() for count in counts if has_room(kind, count)]
    rows = [line for kind, count in asked for line in compared(kind, count, arguments)]
    columns = "lines", "number", "master", "exchanges/s", "/ bare", "CPU us", "/ bare", "in Python", "failed"
    tables.show(columns, rows)
    print(f"\nWith the pace of a wire: {BAUDRATE} baud, response delay {DELAY_US / 1000:g} ms.\n")
    tables.show(("lines", "exchanges/s", "CPU us", "of a core", "in Python", "failed"), [paced(arguments)])
    print(
        "\nCPU us: of all threads of the process, per exchange; in Python: of these, those that run Python."
        "\nPoller polls the lines; a socket pair replaces an open port."
    )


if __name__ == "__main__":
    if len(sys.argv) == 2 and sys.argv[1].startswith("{"):
        print(json.dumps(poll(Lines(**json.loads(sys.argv[1])))))
    else:
        main()
