"""Does the resident memory grow over many exchanges, or over many reloads of a plant file?

A process polls a line without waits. Then a gateway polls 40 drives, and each reload changes the address of
every drive.
"""

from __future__ import annotations

import argparse
import asyncio
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from bench.masters import adapter
from bench.masters.jobs import Job
from bench.support import tables
from bench.support.programs import paced_line
from multidrop import InvtCHE, Plant
from multidrop.gateway.gateway import Gateway
from multidrop.gateway.settings import ServeSettings, read_settings
from multidrop.sim import Simulator, Wire, simulated

WARM_UP = 0.02  # fraction of all exchanges during which the buffers may still grow
ROWS = 10
DRIVES = 40


def resident_kb() -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1])
    raise RuntimeError("the kernel does not report the resident memory")


def write_plant(path: Path, port: str, reload: int) -> None:
    """Write a plant file in which each drive has another address than in the file of the previous reload."""
    text = f'[[line]]\nname = "hall"\nport = "{port}"\nbaudrate = 38400\n'
    for number in range(DRIVES):
        address = 1 + number + DRIVES * (reload % 2)
        text += f'[[line.drive]]\nname = "pump-{number}"\nmodel = "invt-che"\naddress = {address}\n'
        text += 'every = "500 ms"\npoll = ["status", "output_frequency"]\n'
    path.write_text(text)


async def reload_often(path: Path, port: str, total: int) -> None:
    def read() -> tuple[Plant, ServeSettings]:
        plant = Plant.load(path)
        return plant, replace(read_settings(plant, {}), port=0)

    write_plant(path, port, 0)
    gateway, ready = Gateway(*read(), read=read), asyncio.Event()
    running = asyncio.create_task(gateway.run(ready.set))
    await ready.wait()
    rows, first, begun = [], 0, time.monotonic()
    marks = {total // ROWS * at for at in range(1, ROWS + 1)}
    for reload in range(1, total + 1):
        write_plant(path, port, reload)
        result = await gateway.reload.carry_out("the benchmark")
        assert result.is_done, result
        if reload in marks:
            now = resident_kb()
            first = first or now
            rows.append((reload, f"{time.monotonic() - begun:.0f}", now, f"{now - first:+d}"))
    tables.show(("reloads", "seconds", "resident kB", "since the first row"), rows)
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--exchanges", type=int, default=10_000_000)
    parser.add_argument("--reloads", type=int, default=1000)
    arguments = parser.parse_args()
    if arguments.exchanges:
        measure_exchanges(arguments.exchanges)
    tables.heading(f"{arguments.reloads} reloads; each changes the addresses of {DRIVES} simulated drives.")
    drives = [simulated(InvtCHE(address, baudrate=38400)) for address in range(1, 2 * DRIVES + 1)]
    with TemporaryDirectory() as folder, Simulator([Wire(drives, unpaced=True)]) as simulator:
        asyncio.run(reload_often(Path(folder, "plant.toml"), simulator.wires[0].path, arguments.reloads))


def measure_exchanges(total: int) -> None:
    tables.heading(
        f"{total} exchanges of 10 registers over TCP without waits; batches are taken and discarded."
    )

    rows = []
    with paced_line(baudrate=0, tcp=True) as line, adapter.polling(Job(line.path, 0, 0)) as poller:
        first, begun = 0, time.monotonic()
        marks = [WARM_UP * total, *(total * (at + 1) / ROWS for at in range(ROWS))]
        for mark in marks:
            while sum(done := adapter.counts(poller)) < mark:
                for _ in poller.batches(0.1):
                    pass
            now = resident_kb()
            first = first or now
            rows.append((*done, f"{time.monotonic() - begun:.0f}", now, f"{now - first:+d}"))
    tables.show(("exchanges", "failed", "seconds", "resident kB", "since warm-up"), rows)


if __name__ == "__main__":
    main()
