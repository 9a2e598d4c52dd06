"""`multidrop simulate`: the drives of a plant file, on pseudo-terminals."""

from __future__ import annotations

import argparse
from pathlib import Path

from multidrop.plant import Line, load_plant
from multidrop.sim import Simulator, Wire, serve, simulated


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("plant", metavar="PLANT.toml", help="the drives; each line's port is ignored")
    parser.add_argument(
        "--ports", metavar="DIR", type=Path, required=True, help="where a link to each line's port is put"
    )
    parser.add_argument("--unpaced", action="store_true", help="answer at once, not at the pace of a wire")


def run(arguments: argparse.Namespace) -> int:
    plant = load_plant(arguments.plant)
    arguments.ports.mkdir(parents=True, exist_ok=True)
    serve([_wire(line, arguments.ports, arguments.unpaced) for line in plant.lines], _announce)
    return 0


def _wire(line: Line, directory: Path, unpaced: bool) -> Wire:
    link = directory / line.name
    if link.parent != directory:
        raise ValueError(f"line {line.name!r} has a / in its name, which the link to its port cannot have")
    if link.is_symlink() or link.exists():
        raise ValueError(f"{link} is there already: remove it, or choose another directory with --ports")
    drives = [simulated(polled.drive) for polled in line.drives]
    return Wire(drives, name=line.name, port=str(link), unpaced=unpaced)


def _announce(simulator: Simulator) -> None:
    for wire in simulator.wires:
        print(f"ready {wire.name} {wire.path}", flush=True)
