"""multidrop as a master on Windows: `python windows_master.py JOB`. JOB is a Job as JSON.

Prints the result as JSON. It runs without the package `bench`, and imports only its file players/replay.py.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from multidrop import Plant, Poller

REPLAY = Path(__file__).parents[1] / "players" / "replay.py"


def plant_text(job: dict[str, Any]) -> str:
    drives = (
        f"[[line.drive]]\nname = \"drive-{address}\"\nmodel = '{REPLAY}:Played'\naddress = {address}\n"
        f"baudrate = {job['baudrate']}\n"
        for address in range(1, job["drives"] + 1)
    )
    return f"[[line]]\nname = \"line\"\nport = '{job['port']}'\n" + "".join(drives)


def values_of(batch: Any) -> int:
    """Return the number of values in a batch; exit the program if a value is wrong."""
    found = 0
    for row in batch:
        address, register = int(row.drive.partition("-")[2]), int(row.register[1:])
        if row.value is None:
            continue
        if row.value != 256 * address + register:
            sys.exit(f"{row} is not what the drive holds")
        found += 1
    return found


def main(job: dict[str, Any]) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "plant.toml"
        path.write_text(plant_text(job), encoding="utf-8")
        plant = Plant.load(path)
    with Poller(plant) as poller:
        cpu = time.process_time()
        for batch in poller.batches(job["seconds"]):
            last = batch
        cpu = time.process_time() - cpu
        values_of(last)
        summary = poller.summary()
    print(json.dumps({"samples": summary["samples"], "misses": summary["misses"], "cpu_seconds": cpu}))


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
