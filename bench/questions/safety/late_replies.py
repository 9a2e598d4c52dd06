"""How many late or doubled replies are taken for the reply to another request?

Each line has several drives with four blocks of equal length, and each value encodes its drive and register.
Replies are late by up to three time-outs, lost, or doubled. In the first part, a drive's late reply may come
after its replies to later requests, which does not happen on a real line. In the second part, replies keep
their order. In the last part, all replies come over a network path that delays them for longer, and keeps
their order.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator

from bench.masters import many_adapter
from bench.players.responders import responders
from bench.support import tables

TIMEOUT_MS = 5
LATE_PERMILLE, LOST_PERMILLE, TWICE_PERMILLE = 100, 20, 50
PATHS_MS = (10, 100, 1000)
FEW = 4  # number of lines, and of drives on each line, if the network path is slow


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--exchanges", type=int, default=20_000)
    parser.add_argument("--lines", type=int, default=16)
    parser.add_argument("--drives", type=int, default=8, help="on each line")
    parser.add_argument("--seconds", type=float, default=20, help="of each slow path")
    arguments = parser.parse_args()
    tables.heading(
        f"{arguments.lines} lines without waits, {arguments.drives} drives each, 4 blocks of 10 registers; "
        f"time-out {TIMEOUT_MS} ms."
    )
    replies: tuple[object, ...] = "--late-us", 3 * TIMEOUT_MS * 1000, "--late-permille", LATE_PERMILLE
    replies += "--lost-permille", LOST_PERMILLE, "--twice-permille", TWICE_PERMILLE
    columns = []
    for order in ((), ("--path-us", 1)):
        begun = time.monotonic()
        with responders("socketpair", arguments.lines, *replies, *order) as (ports, _):
            judged = many_adapter.judge(ports, arguments.exchanges, arguments.drives)
        columns.append(_told(judged, time.monotonic() - begun))
    tables.show(
        ("what", "in any order", "in their order"),
        [(what, *(column.get(what, 0) for column in columns)) for what in columns[0] | columns[1]],
    )
    print(
        f"\nOf the replies {LATE_PERMILLE / 10:g} % come up to {3 * TIMEOUT_MS} ms late, "
        f"{LOST_PERMILLE / 10:g} % never, {TWICE_PERMILLE / 10:g} % twice; missed: values, 10 in an exchange."
        "\nLater than that: over three time-outs after the request, because the responders received it late."
    )
    print()
    tables.show(("path", "exchanges", "values", "another register's", "late"), list(slow_paths(arguments)))
    print("\nStalls come every five times their length. Late: replies that were recognised as such.")


def _told(judged: many_adapter.Judged, seconds: float) -> dict[str, object]:
    return {
        "seconds": f"{seconds:.0f}",
        "exchanges": judged.exchanges,
        "values": judged.samples,
        "values of another register": judged.wrong - judged.beyond,
        "the same, by answers later than that": judged.beyond,
        "late replies that were recognised": judged.late,
        **{f"missed: {why}": count for why, count in judged.misses.most_common()},
    }


def slow_paths(arguments: argparse.Namespace) -> Iterator[tuple[object, ...]]:
    """Yield a row for each delay of the network path, constant or in stalls."""
    for path_ms in PATHS_MS:
        constant = "--path-us", 1000 * path_ms
        stalls = "--stall-us", 1000 * path_ms, "--stall-every-us", 5000 * path_ms
        for name, options in ((f"{path_ms} ms", constant), (f"stalls of {path_ms} ms", stalls)):
            with responders("socketpair", FEW, *options, "--lost-permille", LOST_PERMILLE) as (ports, _):
                judged = many_adapter.judge_for(ports, arguments.seconds, FEW)
            yield name, judged.exchanges, judged.samples, judged.wrong, judged.late


if __name__ == "__main__":
    main()
