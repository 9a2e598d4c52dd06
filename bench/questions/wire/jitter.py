"""How late are requests that are due at a fixed rate, on an idle computer?

Measurements of multidrop alternate with those of a C program that sleeps until each request's time.
`python -m bench.questions.wire.jitter JOB` is the process that polls.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from dataclasses import asdict, dataclass

import numpy

from bench.players.responders import responders
from bench.support import tables
from bench.support.programs import compiled, module

BAUDRATE = 115200
DELAY_US = 2000


@dataclass(frozen=True)
class Rate:
    """A measurement: one drive on each of some lines, polled at a fixed rate for `seconds`."""

    ports: list[str]
    hertz: float
    seconds: float


def poll(job: Rate) -> list[float]:
    from bench.masters import many_adapter

    lateness: list[float] = many_adapter.start_lateness_us(job.ports, BAUDRATE, 1 / job.hertz, job.seconds)
    return lateness


def of_multidrop(lines: int, arguments: argparse.Namespace) -> list[float]:
    with responders("socketpair", lines, "--baudrate", BAUDRATE, "--delay-us", DELAY_US) as (ports, fds):
        job = json.dumps(asdict(Rate(ports, arguments.hertz, arguments.seconds)))
        told = subprocess.check_output(module("bench.questions.wire.jitter", job), pass_fds=fds)
    late: list[float] = json.loads(told)
    return late


def of_bare_timer(arguments: argparse.Namespace) -> list[float]:
    times = round(arguments.seconds * arguments.hertz)
    with responders("socketpair", 1, "--baudrate", BAUDRATE, "--delay-us", DELAY_US) as (ports, fds):
        command = [compiled("masters/bare_timer.c"), round(1e6 / arguments.hertz), times, *ports]
        told = subprocess.check_output([str(word) for word in command], pass_fds=fds)
    return [int(line) / 1e3 for line in told.split()]


def row(what: str, late: list[float], yard: list[float]) -> tuple[str, ...]:
    p50, p99, most = numpy.percentile(late, [50, 99, 100])
    more = p99 - numpy.percentile(yard, 99)
    return what, str(len(late)), *(f"{each:.1f}" for each in (p50, p99, most)), f"{more:+.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hertz", type=float, default=50.0)
    parser.add_argument("--lines", type=int, nargs="+", default=[1, 16], help="with one drive each")
    parser.add_argument("--seconds", type=float, default=10.0, help="of a slice")
    parser.add_argument("--slices", type=int, default=3)
    arguments = parser.parse_args()
    tables.heading(
        f"Requests due at {arguments.hertz:g} Hz on lines at {BAUDRATE} baud: how late they start."
    )

    yard: list[float] = []
    late: dict[int, list[float]] = {lines: [] for lines in arguments.lines}
    for _ in range(arguments.slices):
        yard += of_bare_timer(arguments)
        for lines in arguments.lines:
            late[lines] += of_multidrop(lines, arguments)
    rows = [row("bare C timer", yard, yard)]
    rows += [row(f"multidrop, {lines} line{'s' * (lines > 1)}", late[lines], yard) for lines in late]
    tables.show(("what", "requests", "late us p50", "p99", "max", "p99 - bare"), rows)
    print("\nlate: from the time when a request was due until its write() call, by CLOCK_MONOTONIC.")


if __name__ == "__main__":
    if len(sys.argv) == 2 and sys.argv[1].startswith("{"):
        print(json.dumps(poll(Rate(**json.loads(sys.argv[1])))))
    else:
        main()
