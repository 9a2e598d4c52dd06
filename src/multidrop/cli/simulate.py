"""`multidrop simulate`: simulates the drives of a plant file, on pseudo-terminals or TCP ports."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from urllib.parse import urlsplit

from multidrop.cli.support.arguments import add_speed_option
from multidrop.cli.support.output import print_text
from multidrop.drive.line_settings import speaks_tcp
from multidrop.plant.loader import load_plant
from multidrop.plant.model import PlantLine
from multidrop.sim import FaultyWire, Simulator, load_faults, serve, simulated
from multidrop.sim.faults import HELP, Faults
from multidrop.sim.wire import is_dead_link

ANY_TCP = "tcp://127.0.0.1:0"  # any free TCP port of this computer; replaces a port on another computer
LOOPBACK = ("127.0.0.1", "localhost")
NO_TERMINALS = (
    "this system has no pseudo-terminals for --ports DIR: remove --ports, and give each line a port such as "
    "socket://127.0.0.1:5020"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "plant",
        metavar="PLANT.toml",
        help="the drives; lines' ports are ignored, except tcp:// on this machine and, without --ports, "
        "socket:// on this machine",
    )
    parser.add_argument(
        "--ports",
        metavar="DIR",
        type=Path,
        help="directory for a link to each line's port; needed if a line has neither of these ports",
    )
    parser.add_argument("--unpaced", action="store_true", help="answer at once, not at the pace of a wire")
    parser.add_argument("--faults", metavar="FILE", help="faults of lines and drives, as described below")
    add_speed_option(parser, "let simulated time pass N times as fast: wires, drives, motors and faults")
    parser.epilog = HELP
    parser.formatter_class = argparse.RawDescriptionHelpFormatter


def run(arguments: argparse.Namespace) -> int:
    plant = load_plant(arguments.plant)
    names = [polled.drive.name for polled in plant.drives]
    faults = load_faults(arguments.faults, names) if arguments.faults else Faults()
    directory: Path | None = arguments.ports
    if directory is not None and not hasattr(os, "openpty"):
        raise ValueError(NO_TERMINALS)
    serial = [line.name for line in plant.lines if not (speaks_tcp(line.port) or _is_local_socket(line.port))]
    if directory is None and serial:
        raise ValueError(f"line {serial[0]} needs a pseudo-terminal: add --ports DIR")
    if directory is not None and directory.exists() and not directory.is_dir():
        raise ValueError(f"--ports {directory} is a file: name a directory; it is created if missing")
    ports = [_port(line, directory) for line in plant.lines]
    if directory is not None:
        directory.mkdir(parents=True, exist_ok=True)
    wires = [
        FaultyWire(
            [simulated(polled.drive) for polled in line.drives],
            faults,
            name=line.name,
            port=port,
            unpaced=arguments.unpaced,
        )
        for line, port in zip(plant.lines, ports, strict=True)
    ]
    serve(wires, _announce, speed=arguments.speed)
    return 0


def _is_local_socket(port: str) -> bool:
    url = urlsplit(port)
    return url.scheme == "socket" and url.hostname in LOOPBACK and bool(url.port)


def _port(line: PlantLine, directory: Path | None) -> str:
    """Return the port at which a line is simulated.

    Raises ValueError if the link to its pseudo-terminal cannot be created.
    """
    if speaks_tcp(line.port):
        url = urlsplit(line.port)
        return line.port if url.hostname in LOOPBACK and url.port else ANY_TCP
    if directory is None:
        return line.port
    link = directory / line.name
    if link.parent != directory:
        raise ValueError(
            f"--ports cannot name a file after line {line.name!r}: rename the line to a name without /"
        )
    if (link.is_symlink() or link.exists()) and not is_dead_link(link):
        raise ValueError(f"{link} exists already: remove it, or choose another directory with --ports")
    return str(link)


def _announce(simulator: Simulator) -> None:
    for wire in simulator.wires:
        print_text(f"ready {wire.name} {wire.path}", flush=True)
