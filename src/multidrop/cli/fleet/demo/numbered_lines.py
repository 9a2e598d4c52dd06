"""Simulated lines whose drives number their answers, so that each can be found again in the hub's files.

They speak Modbus TCP, whose replies name their requests. So each request that left has one row, with its own
answer's number or none, however late it came. On other lines a value may be the late answer to the request
before, and a request that only proves whose a reply is has no row.

Run as a module it simulates until it is terminated, and then prints how many answers each drive gave.
"""

from __future__ import annotations

import json
import sys

from multidrop.cli.support.output import print_text
from multidrop.families import InnovertIBD
from multidrop.sim import SimulatedDrive, Simulator, Wire, serve
from multidrop.sim.memory import MemoryCell

NUMBERED = "motor_speed"  # has no scale: its value is the very count
DRIVES = 2  # of each line
EVERY = "100 ms"
PORT = "tcp://127.0.0.1:0"


class NumberedDrive(SimulatedDrive):
    """A drive whose motor speed is the number of times that it was asked for."""

    answers = 0

    def refresh(self, cell: MemoryCell) -> None:
        super().refresh(cell)
        if cell.name == NUMBERED:
            self.answers += 1
            cell.raw = self.answers


def drive_name(line: str, address: int) -> str:
    return f"{line}-drive-{address}"


def plant_file(ports: dict[str, str]) -> str:
    """Return the plant file of these lines, by their ports."""
    return "\n".join(
        f'[[line]]\nname = "{line}"\nport = "{port}"\n'
        + "".join(
            f'[[line.drive]]\nname = "{drive_name(line, address)}"\nmodel = "{InnovertIBD.model}"\n'
            f'address = {address}\npoll = ["{NUMBERED}"]\nevery = "{EVERY}"\n'
            for address in range(1, DRIVES + 1)
        )
        for line, port in ports.items()
    )


def simulate(number: int) -> None:
    """Simulate so many lines until terminated; their ports are printed first, the counts at the end."""
    drives = {
        line: [
            NumberedDrive(InnovertIBD(address=address, name=drive_name(line, address)))
            for address in range(1, DRIVES + 1)
        ]
        for line in (f"line-{at}" for at in range(1, number + 1))
    }

    def announce(simulator: Simulator) -> None:
        print_text(json.dumps({wire.name: wire.path for wire in simulator.wires}), flush=True)

    serve([Wire(found, name=line, port=PORT) for line, found in drives.items()], announce)
    counts = {sim.drive.name: sim.answers for found in drives.values() for sim in found}
    print_text(json.dumps(counts), flush=True)


if __name__ == "__main__":
    simulate(int(sys.argv[1]))
