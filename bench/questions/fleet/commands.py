"""Under attack, is a fleet's command carried out twice, or its result reported wrongly?

Three gateways and three NATS nodes are killed (SIGKILL) and suspended (SIGSTOP, gateways for up to 3.5 s) at
random moments. Meanwhile callers write setpoints to simulated drives on the gateways' lines. Some of their
messages are doubled, immediately or seconds later, and some are late. Every 20th command is a stop. The
simulated drives list the writes that they receive. Exits with 1 if a command was carried out twice, if its
caller got a wrong result, or if an executed command is missing in its gateway's audit log.
"""

from __future__ import annotations

import argparse
import asyncio
import sys
import tempfile
from pathlib import Path

from command_drills import command_drill

from bench.support import tables


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--commands", type=int, default=600)
    parser.add_argument("--lines", type=int, default=12)
    parser.add_argument(
        "--seconds", type=float, help="for all of them; a tenth of a second for each if not given"
    )
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()

    tables.heading("Is a command carried out twice, or its asker told wrongly, whatever is killed?")
    seconds = arguments.seconds or arguments.commands / 10
    with tempfile.TemporaryDirectory() as folder, command_drill(Path(folder), arguments.lines) as drill:
        found = asyncio.run(drill.ask(arguments.commands, seconds, arguments.seed))
    for title, counts in (("told", found.told), ("asked", found.ways), ("attack", found.deeds)):
        tables.show((title, "times"), sorted(counts.items()))
        print()
    rows = [
        ("carried out twice", found.twice),
        ("told wrongly", found.wrongly),
        ("told unknown, and carried out", found.unknown_sent),
        ("carried out, and in no gateway's log", found.unnoted),
        ("oldest when its drive had it, s since its offer came", f"{found.oldest_s:.2f}"),
    ]
    tables.show(("judged by the drives", ""), rows)
    return 1 if found.twice or found.wrongly or found.unnoted else 0


if __name__ == "__main__":
    sys.exit(main())
