"""A gateway with known samples: `python -m bench.players.fleet_gateway NAME FOLDER TOLD URL...`

It appends numbered exchanges to its spool in FOLDER, and forwards them to the NATS servers at URL. It also
writes lines into the file TOLD. Each line has the number of this run's first exchange, and how many exchanges
are stored so far. If TOLD is `-`, the gateway only forwards. It may be killed at any moment.
"""

from __future__ import annotations

import asyncio
import os
import sys
import time
import traceback
from contextlib import suppress
from pathlib import Path

from spooled import numbered

from multidrop.core import Names
from multidrop.fleet.errors import FleetError
from multidrop.fleet.samples.samples_stream import Forwarder, samples_path
from multidrop.samples.spool import Spool

EXCHANGES = 100  # per batch
RATE = 1000  # exchanges per second, with 10 values each
GAP = 1_000_000  # exchange numbers reserved for each run of this program


async def live(name: str, folder: Path, told: str, urls: list[str]) -> None:
    spool = Spool(folder, name)
    doing = [asyncio.create_task(forward(spool, urls))]
    if told != "-":
        drives = Names([f"{name}-{drive}" for drive in range(4)])
        doing.append(asyncio.create_task(asyncio.to_thread(fill, spool, drives, Path(told))))
    try:
        await asyncio.gather(*doing)
    except Exception:
        traceback.print_exc()
    os._exit(1)  # a task failed: exit, because the thread would continue


def fill(spool: Spool, drives: Names, told: Path) -> None:
    """Append numbered exchanges forever, and write into `told` how many are stored."""
    runs = len({line.split()[0] for line in told.read_text().splitlines()}) if told.exists() else 0
    first, count, begun = runs * GAP, 0, time.monotonic()
    with told.open("a") as file:
        file.write(f"{first} 0\n")
        file.flush()
        while True:
            spool.append(numbered(first + count, EXCHANGES, drives))
            count += EXCHANGES
            if count % (3 * EXCHANGES) == 0 and spool.sync(5.0):
                file.write(f"{first} {count}\n")
                file.flush()
            time.sleep(max(0.0, begun + count / RATE - time.monotonic()))


async def forward(spool: Spool, urls: list[str]) -> None:
    while True:
        with suppress(FleetError):
            async with samples_path(urls) as path:
                await Forwarder(spool, path).run()
        await asyncio.sleep(0.2)


if __name__ == "__main__":
    _, gateway, spooled, noted, *servers = sys.argv
    asyncio.run(live(gateway, Path(spooled), noted, servers))
