"""Each master's utilisation of a paced line, its requests that came too early, and its cost on the host.

A minimal master in C with multidrop's silences runs before every measurement. Differences and ratios compare
each master with that minimal master. Figures are medians of all measurements, and counts are sums. A default
run takes a quarter of an hour.

With `--beside N`, each master runs beside N busy loops. Differences and ratios then compare it with multidrop
without busy loops, measured before each master. The simulated line has realtime scheduling, which needs root:
otherwise the line itself would be late. A kernel thread with normal scheduling passes on a pty's bytes. With
`--tcp` the line is a TCP connection, which needs no such thread.
"""

from __future__ import annotations

import argparse
from statistics import median
from typing import Any

from bench.masters import adapter, rivals
from bench.masters.jobs import Job
from bench.support import tables
from bench.support.programs import busy_loops, paced_line

BARE = "bare C"
QUIET = "multidrop, quiet"  # name of the row for multidrop without busy loops
BARE_REALTIME = "bare C, realtime"
# A new TCP connection delays some bytes, so requests at the start of a run are not counted.
TCP_START_MS = 1500
# minimal C master that sleeps until 1.5 characters before a reply's end, as multidrop does
ASLEEP = "bare C, asleep"
BESIDE = (BARE, BARE_REALTIME, "multidrop", "multidrop, realtime", "pymodbus", "minimalmodbus")


def columns(yard: str) -> tuple[str, ...]:
    name = "bare" if yard == BARE else "quiet"
    return (
        "baud",
        "master",
        "version",
        "utilisation",
        f"- {name}",
        "requests",
        "too early",
        "share",
        "late us",
        "p99",
        "CPU us",
        f"/ {name}",
        "failed",
    )


def measured(
    master: str, baudrate: int, seconds: float, loops: int = 0, *, tcp: bool = False
) -> dict[str, Any]:
    """Let a master poll for `seconds`; return what the simulated drives and the master measured."""
    options: dict[str, Any] = {"realtime": True} if loops else {}
    if tcp:
        options |= {"tcp": True, "settle_ms": TCP_START_MS}
    with busy_loops(0 if master == QUIET else loops), paced_line(baudrate=baudrate, **options) as line:
        job = Job(line.path, baudrate, seconds)
        if master in (BARE, BARE_REALTIME, ASLEEP):
            asleep = job.wire - 1.5 * job.character if master == ASLEEP else 0.0
            silence = adapter.silence(baudrate)
            own = rivals.measure_bare(job, silence, asleep, realtime=master == BARE_REALTIME)
        else:
            own = rivals.measure("multidrop" if master == QUIET else master, job)
    report = line.report
    asked = max(1, report["answered"] + report["unanswered"])
    return {
        "version": own["version"],
        "utilisation": report["utilisation"],
        "requests": report["answered"] + report["unanswered"],
        "early": report["early"],
        "late": report["excess_us"]["p50"],
        "late p99": report["excess_us"]["p99"],
        "cpu": own["cpu_seconds"] / asked * 1e6,
        "failed": own["failures"],
        "pacing": report["lateness_us"],
    }


def row(baudrate: int, master: str, slices: list[dict[str, Any]], bare: list[dict[str, Any]]) -> list[str]:
    def middle(key: str) -> float:
        return float(median(each[key] for each in slices))

    def total(key: str) -> int:
        return sum(each[key] for each in slices)

    pairs = list(zip(slices, bare, strict=True))
    return [
        str(baudrate),
        master,
        slices[0]["version"],
        f"{middle('utilisation'):.4f}",
        f"{median(each['utilisation'] - yard['utilisation'] for each, yard in pairs):+.4f}",
        str(total("requests")),
        str(total("early")),
        f"{total('early') / max(1, total('requests')):.2%}",
        f"{middle('late'):.0f}",
        f"{middle('late p99'):.0f}",
        f"{middle('cpu'):.0f}",
        f"{median(each['cpu'] / yard['cpu'] for each, yard in pairs):.2f}",
        str(total("failed")),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--baudrates", type=int, nargs="+", default=[9600, 38400, 115200])
    parser.add_argument("--masters", nargs="+", choices=(*rivals.MASTERS, BARE, BARE_REALTIME, ASLEEP))
    parser.add_argument("--seconds", type=float, default=3.0, help="of a slice")
    parser.add_argument("--slices", type=int, default=5)
    parser.add_argument("--beside", metavar="N", type=int, default=0, help="number of busy loops")
    parser.add_argument("--tcp", action="store_true", help="the line is a TCP connection, not a pty")
    arguments = parser.parse_args()
    loops, seconds = arguments.beside, arguments.seconds
    yard = QUIET if loops else BARE
    masters = arguments.masters or (BESIDE if loops else (*rivals.MASTERS, ASLEEP))
    rivals.insist_on(masters)

    beside = f" Beside {loops} busy loops." if loops else ""
    tables.heading(
        "A paced line: 16 drives, 10 registers each, 8N1, response delay 2 ms, delivered byte by byte."
        + beside
    )
    for baudrate in arguments.baudrates:
        pacing = measured(BARE, baudrate, seconds, loops, tcp=arguments.tcp)["pacing"]
        late = ", ".join(f"{name} {pacing[name]:.1f}" for name in ("p50", "p99", "max"))
        print(f"the line's own lateness per byte at {baudrate}: {late} us")
    print(flush=True)

    rows = []
    for baudrate in arguments.baudrates:
        slices: dict[str, list[dict[str, Any]]] = {master: [] for master in masters}
        yards: dict[str, list[dict[str, Any]]] = {master: [] for master in masters}
        for master in masters * arguments.slices:
            yards[master].append(measured(yard, baudrate, seconds, loops, tcp=arguments.tcp))
            slices[master].append(measured(master, baudrate, seconds, loops, tcp=arguments.tcp))
        rows += [row(baudrate, master, slices[master], yards[master]) for master in masters]
        every = [each for master in masters for each in yards[master]]
        rows.append(row(baudrate, yard, every, every))
    tables.show(columns(yard), rows)
    print(
        "\nutilisation: ideal bus cycle / measured; over 1 if the silence is not kept."
        "\ntoo early: requests more than 20 us before the silence was over, and their share of all requests."
        "\nlate: time from the end of the silence until a request is seen, median and 99th percentile."
        "\nCPU: of the master's process, per exchange; failed: exchanges without the right values."
        f"\n{ASLEEP}: until shortly before the reply's end, and not woken by each byte before that."
    )


if __name__ == "__main__":
    main()
