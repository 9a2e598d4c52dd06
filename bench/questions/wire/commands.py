"""The polling rate of a line while threads read from its drives without pause.

16 drives at the pace of a wire are polled as fast as the line allows. Each thread calls `drive.read_many`
in a loop; its exchanges have priority over polling.
"""

from __future__ import annotations

import argparse
import threading
import time
from typing import Any

from bench.masters import adapter
from bench.masters.jobs import Job
from bench.support import tables
from bench.support.programs import paced_line


def measured(threads: int, baudrate: int, seconds: float) -> dict[str, float]:
    """Poll while `threads` threads read; return both rates per second, and the longest read in s."""
    with paced_line(baudrate=baudrate) as line, adapter.polling(Job(line.path, baudrate, seconds)) as poller:
        bus = poller.bus("line")
        stop, took = threading.Event(), []

        def read(drive: Any) -> None:
            while not stop.is_set():
                begun = time.monotonic()
                drive.read_many(drive.readings())
                took.append(time.monotonic() - begun)

        time.sleep(1.0)  # until the poller has learned the response delays
        readers = [threading.Thread(target=read, args=[bus.drives[at]]) for at in range(threads)]
        before, begun = adapter.counts(poller)[0], time.monotonic()
        for reader in readers:
            reader.start()
        time.sleep(seconds)
        polled, spent = adapter.counts(poller)[0] - before, time.monotonic() - begun
        stop.set()
        for reader in readers:
            reader.join()
        return {"polled": polled / spent, "by hand": len(took) / spent, "longest": max(took, default=0.0)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--baudrate", type=int, default=38400)
    parser.add_argument("--threads", type=int, nargs="+", default=[0, 1, 2, 4])
    parser.add_argument("--seconds", type=float, default=5.0)
    arguments = parser.parse_args()
    tables.heading(
        f"A paced line of 16 drives at {arguments.baudrate}, polled beside threads that read by hand."
    )
    rows = []
    for threads in arguments.threads:
        found = measured(threads, arguments.baudrate, arguments.seconds)
        polled, by_hand = found["polled"], found["by hand"]
        share = polled / (polled + by_hand)
        rows.append(
            [str(threads), f"{polled:.1f}", f"{by_hand:.1f}", f"{share:.1%}", f"{1e3 * found['longest']:.1f}"]
        )
    tables.show(("threads", "polled/s", "by hand/s", "polled", "longest ms"), rows)
    print("\nlongest: that a call of drive.read_many took.")


if __name__ == "__main__":
    main()
