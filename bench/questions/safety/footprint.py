"""A poller's memory, and the CPU instructions per exchange, to estimate the load of small computers.

valgrind counts the instructions of the polling process in two runs of different lengths. The difference of
the two counts is the cost of polling alone, without start and end. valgrind does not count the kernel's
instructions: the kernel's time is measured in a run without valgrind.

`python -m bench.questions.safety.footprint JOB` is the process that polls.
"""

from __future__ import annotations

import argparse
import json
import re
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

BAUDRATE = 38400
DRIVES = 31
SETTLE_S = 2.0

# Clock in GHz, and assumed instructions per cycle of a Python program with a C core, by board.
BOARDS = {
    "Raspberry Pi Zero W (ARM1176, 1.0 GHz)": (1.0, 0.4),
    "Raspberry Pi 3, Zero 2 W (Cortex-A53, 1.0 GHz)": (1.0, 0.6),
    "Raspberry Pi 4 (Cortex-A72, 1.5 GHz)": (1.5, 1.0),
}


@dataclass(frozen=True)
class Job:
    ports: list[str]
    seconds: float
    record: str = ""  # path of the recording; "": no recording


# ---- the process that polls: it imports only modules that a user's program imports ----


def resident_kb(kind: str = "VmRSS") -> int:
    text = Path("/proc/self/status").read_text()
    found = re.search(rf"{kind}:\s+(\d+) kB", text)
    if not found:
        raise RuntimeError("the kernel does not report the resident memory")
    return int(found[1])


def poll(job: Job) -> dict[str, Any]:
    bare = resident_kb()
    import multidrop

    imported = resident_kb()
    names = [getattr(multidrop, name) for name in ("Bus", "Poller", "Plant")]
    loaded = resident_kb()
    if not job.ports:
        return {"bare": bare, "import multidrop": imported, "and Bus, Poller, Plant": loaded}
    from bench.players.replay import Played
    from multidrop.plant.model import Plant, PlantLine, Polled, PolledDrive

    def line(port: str) -> PlantLine:
        drives = [Played(at, name=f"{port}/{at}", baudrate=BAUDRATE) for at in range(1, DRIVES + 1)]
        polled = tuple(PolledDrive(each, tuple(Polled(r, None) for r in each.readings())) for each in drives)
        return PlantLine(port, port, drives=polled)

    plant = Plant(tuple(line(port) for port in job.ports), Path())
    with names[1](plant) as poller, ExitStack() as stack:
        write = (
            stack.enter_context(multidrop.open_writer(job.record, plant.metadata())).write
            if job.record
            else len
        )
        for batch in poller.batches(SETTLE_S):
            write(batch)
        before, used, begun = poller.summary(), resource.getrusage(resource.RUSAGE_SELF), time.monotonic()
        for batch in poller.batches(job.seconds):
            write(batch)
        after, left = poller.summary(), resource.getrusage(resource.RUSAGE_SELF)
        seconds = time.monotonic() - begun
    return {
        "samples": after["samples"] - before["samples"],
        "all": after["samples"],
        "misses": after["misses"],
        "seconds": seconds,
        "user": left.ru_utime - used.ru_utime,
        "system": left.ru_stime - used.ru_stime,
        "resident": resident_kb(),
        "peak": resident_kb("VmHWM"),
    }


# ---- the process that measures ----


def run(job: Job, *before: str) -> dict[str, Any]:
    """Run a process that polls, under the command `before` (such as valgrind); return its results."""
    command = [*before, sys.executable, "-m", "bench.questions.safety.footprint", json.dumps(asdict(job))]
    told = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return dict(json.loads(told))


def instructions(lines: int, seconds: float) -> tuple[int, dict[str, Any]]:
    with TemporaryDirectory() as folder, talkers(lines) as ports:
        out = Path(folder, "counts")
        valgrind = ("valgrind", "--tool=cachegrind", "--cache-sim=no", f"--cachegrind-out-file={out}")
        told = run(Job(ports, seconds), *valgrind)
        summary = re.search(r"^summary: (\d+)", out.read_text(), re.MULTILINE)
        if not summary:
            raise RuntimeError("valgrind has not reported the number of instructions")
        return int(summary[1]), told


@contextmanager
def talkers(lines: int) -> Iterator[list[str]]:
    """Simulate `lines` lines with paced_line.c; yield their ports."""
    from bench.players.responders import responders

    with responders("pty", lines, "--baudrate", BAUDRATE, "--delay-us", 2000) as (ports, _):
        yield ports


def main() -> None:
    from bench.support import tables

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--lines", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=10.0)
    arguments = parser.parse_args()
    tables.heading(f"{DRIVES} drives a line, 10 registers each, {BAUDRATE} baud, as fast as the wire allows.")

    memory = [(name, f"{kb / 1024:.1f}") for name, kb in run(Job([], 0)).items()]
    for count in (1, arguments.lines):
        with talkers(count) as ports, TemporaryDirectory() as folder:
            told = run(Job(ports, arguments.seconds, str(Path(folder, "run.arrows"))))
        memory.append(
            (f"polling {count} x {DRIVES} drives, recorded to .arrows", f"{told['resident'] / 1024:.1f}")
        )
    tables.show(("resident memory", "MB"), memory)

    with talkers(arguments.lines) as ports:
        told = run(Job(ports, arguments.seconds))
    exchanges = told["samples"] / 10
    share = (told["user"] + told["system"]) / told["seconds"]
    rate = exchanges / told["seconds"]
    print(f"\n{arguments.lines} lines: {rate:.0f} exchanges/s, {share:.1%} of a core here.")
    print(
        f"CPU of an exchange here: {told['user'] / exchanges * 1e6:.0f} us, and the kernel's "
        f"{told['system'] / exchanges * 1e6:.0f} us."
    )

    short, first = instructions(arguments.lines, 0.5 * arguments.seconds)
    long, second = instructions(arguments.lines, 2.0 * arguments.seconds)
    each = (long - short) / (second["all"] - first["all"]) * 10
    print(f"Instructions of an exchange, the kernel's left out: {each:,.0f}.\n")

    kernel = told["system"] / max(told["user"], 1e-9)
    rows = []
    for board, (clock, per_cycle) in BOARDS.items():
        used = each / (clock * 1e9 * per_cycle) * (1 + kernel)
        rows.append((board, f"{per_cycle:.1f}", f"{used * 1e6:.0f}", f"{used * rate:.0%}"))
    tables.show(("RECKONED, not measured", "instructions a cycle", "CPU us", "of a core"), rows)
    print(
        "\nReckoned: instructions are counted on x86-64 and assumed to be as many on ARM; instructions a"
        "\ncycle are assumed; the kernel's share of the time is assumed to be the same. With at most four"
        "\nlines, up to 80 us before a request are spent spinning, on any board. No such board was tested."
    )


if __name__ == "__main__":
    if len(sys.argv) == 2 and sys.argv[1].startswith("{"):
        print(json.dumps(poll(Job(**json.loads(sys.argv[1])))))
    else:
        main()
