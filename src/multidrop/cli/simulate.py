"""`multidrop simulate`: simulates the drives of a plant file on pseudo-terminals."""

from __future__ import annotations

import argparse
from pathlib import Path

from multidrop.cli.support.output import print_text
from multidrop.drive.network import speaks_tcp
from multidrop.plant.loader import load_plant
from multidrop.plant.model import PlantLine
from multidrop.sim import FaultyWire, Simulator, Wire, load_faults, serve, simulated
from multidrop.sim.faults import HELP, Faults

ANY_TCP = "tcp://127.0.0.1:0"  # for a line on tcp://: any free port of this machine


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "plant", metavar="PLANT.toml", help="the drives; each line's port is ignored, but for tcp://"
    )
    parser.add_argument(
        "--ports", metavar="DIR", type=Path, required=True, help="where a link to each line's port is put"
    )
    parser.add_argument("--unpaced", action="store_true", help="answer at once, not at the pace of a wire")
    parser.add_argument("--faults", metavar="FILE", help="what befalls the bytes, as said below")
    parser.epilog = HELP
    parser.formatter_class = argparse.RawDescriptionHelpFormatter


def run(arguments: argparse.Namespace) -> int:
    plant = load_plant(arguments.plant)
    faults = load_faults(arguments.faults) if arguments.faults else Faults()
    if arguments.ports.exists() and not arguments.ports.is_dir():
        raise ValueError(
            f"{arguments.ports} is a file: name a directory with --ports, which is made if need be"
        )
    arguments.ports.mkdir(parents=True, exist_ok=True)
    serve([_wire(line, arguments.ports, faults, arguments.unpaced) for line in plant.lines], _announce)
    return 0


def _wire(line: PlantLine, directory: Path, faults: Faults, unpaced: bool) -> Wire:
    link = directory / line.name
    if link.parent != directory:
        raise ValueError(f"line {line.name!r} has a / in its name, which the link to its port cannot have")
    if link.is_symlink() or link.exists():
        raise ValueError(f"{link} is there already: remove it, or choose another directory with --ports")
    drives = [simulated(polled.drive) for polled in line.drives]
    port = ANY_TCP if speaks_tcp(line.port) else str(link)
    return FaultyWire(drives, faults, name=line.name, port=port, unpaced=unpaced)


def _announce(simulator: Simulator) -> None:
    for wire in simulator.wires:
        print_text(f"ready {wire.name} {wire.path}", flush=True)
