"""The utilisation of a line with drives of all families: several baud rates, formats and silences.

Every drive has its documented factory settings, and all its readings are polled. The measured bus cycle is
compared with the one that multidrop predicts before the port is opened.
`python -m bench.questions.wire.mixed_line PORT SECONDS` is the process that polls.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from typing import Any

from bench.masters import many_adapter
from bench.support import tables
from bench.support.programs import CORE, FRAMES, compiled, module, talking

PORT = str(CORE / "posix" / "serial.c")


def measured(line: many_adapter.Mixed, seconds: float) -> tuple[dict[str, Any], dict[str, Any]]:
    """Poll the line for `seconds`; return the report of the simulated drives, and the poller's summary."""
    with talking([compiled("players/mixed_line.c", *FRAMES, PORT), *line.words]) as player:
        told = subprocess.check_output(module("bench.questions.wire.mixed_line", player.said, str(seconds)))
    return player.report, json.loads(told)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cycles", type=int, default=3, help="in a slice")
    parser.add_argument("--slices", type=int, default=3)
    arguments = parser.parse_args()
    line = many_adapter.mixed()
    tables.heading(
        f"All families on one line: {len(line.drives)} drives, {line.requests} requests in a bus cycle, "
        f"predicted {1e3 * line.cycle:.1f} ms."
    )
    rows = []
    for number in range(1, arguments.slices + 1):
        seen, told = measured(line, (arguments.cycles + 0.2) * line.cycle)
        rows.append(
            (
                str(number),
                str(seen["requests"]),
                f"{seen['utilisation']:.4f}",
                f"{told['utilisation']:.4f}",
                f"{seen['cycle_ms']:.1f}",
                f"{1e3 * line.cycle / seen['cycle_ms'] if seen['cycles'] else 0:.4f}",
                str(seen["early"]),
                str(seen["refused"]),
                str(sum(told["misses"].values())),
            )
        )
    columns = (
        "slice",
        "requests",
        "utilisation",
        "as told",
        "cycle ms",
        "predicted /",
        "too early",
        "refused",
        "missed",
    )
    tables.show(columns, rows)
    print(
        "\nutilisation: what the requests that came had to take / what they took, from the drives' side."
        "\nas told: by the poll itself, from the delays that it has learnt; predicted / measured bus cycle."
        "\ntoo early: requests more than 20 us before the silence was over; missed: values."
    )


if __name__ == "__main__":
    if len(sys.argv) == 3 and sys.argv[1].startswith("/"):
        print(json.dumps(many_adapter.poll_mixed(sys.argv[1], float(sys.argv[2]))))
    else:
        main()
