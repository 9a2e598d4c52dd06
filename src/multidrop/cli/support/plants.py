"""Plant files as arguments, and the names of lines and drives in them."""

from __future__ import annotations

import argparse

from multidrop.core import RS485
from multidrop.drive.network import check_port
from multidrop.drive.timing import Settings
from multidrop.plant.loader import load_plant
from multidrop.plant.model import Plant, PlantLine
from multidrop.toml_check import parse_duration


def add_plant_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("plant", metavar="PLANT.toml", help="lines, drives, and what is polled")


def add_port_option(parser: argparse.ArgumentParser) -> None:
    """Add --port NAME=PORT, for the lines of a plant file."""
    parser.add_argument(
        "--port",
        metavar="LINE=PORT",
        dest="ports",
        type=_named_port,
        action="append",
        default=[],
        help="another port for a line of the plant file, such as a simulated one; as often as needed",
    )


def plant_of(path: str, arguments: argparse.Namespace) -> Plant:
    """Load a plant with the ports of --port. Raises ValueError for whatever is wrong with either."""
    plant = load_plant(path)
    ports: dict[str, str] = {}
    for name, port in arguments.ports:
        if name in ports:
            raise ValueError(f"--port names line {name!r} twice; a line has one port")
        ports[name] = port
    return plant.with_ports(ports) if ports else plant


def is_plant(word: str) -> bool:
    """Return True where a word in place of PORT is a plant file, by its suffix."""
    return "://" not in word and word.lower().endswith(".toml")


def add_line_arguments(parser: argparse.ArgumentParser, *, name: str = "LINE", kind: str = "line") -> None:
    """Add PORT, or PLANT.toml and the name of a line, which may be left out where the plant has one line.

    `name` is how the help calls that second argument, and `kind` says what it may be the name of.
    """
    ways = [f"{parser.prog} PORT [options]", f"{parser.prog} PLANT.toml [{name}] [options]"]
    parser.usage = "\n       ".join(ways)
    parser.add_argument(
        "port",
        metavar="PORT",
        nargs="?",
        help="a device such as /dev/ttyUSB0, or a URL such as socket://host:port; or a plant file",
    )
    parser.add_argument(
        "name", metavar=name, nargs="?", help=f"a {kind} of the plant file; its only line if not given"
    )
    add_port_option(parser)


def add_rs485_argument(parser: argparse.ArgumentParser) -> None:
    """Add --rs485, for a port by hand; `rs485_at` has its value."""
    parser.add_argument(
        "--rs485",
        metavar="MODE",
        help="who switches between sending and receiving, where the adapter does not by itself: "
        "kernel, rts-up or rts-down",
    )


def rs485_at(arguments: argparse.Namespace, line: PlantLine | None) -> RS485:
    """Return who switches the transceiver of this line, or of a port by hand. Raises ValueError."""
    if line is None:
        found = RS485(arguments.rs485 or "off")
        found.check_port(arguments.port)
        return found
    if arguments.rs485 is not None:
        raise ValueError("--rs485 is a matter of the plant file: write it into the line there")
    return line.rs485


def add_settle_argument(parser: argparse.ArgumentParser) -> None:
    """Add --settle, for a port by hand; `settle_at` has its value."""
    parser.add_argument(
        "--settle",
        metavar="TIME",
        help='such as "1.5 s": send nothing for so long after the port is opened, for devices that it resets',
    )


def settle_at(arguments: argparse.Namespace, line: PlantLine | None) -> float:
    """Return how long this line, or a port by hand, needs after its opening, in s. Raises ValueError."""
    if line is not None:
        if arguments.settle is not None:
            raise ValueError("--settle is a matter of the plant file: write it into the line there")
        return line.settle
    return parse_duration(arguments.settle) if arguments.settle is not None else 0.0


def plant_at(arguments: argparse.Namespace) -> Plant | None:
    """Return the plant where a plant file stands in place of PORT; None where a port does.

    Raises ValueError for mistakes in the plant file, and beside a port for arguments that belong to a plant.
    """
    if arguments.port is None:
        raise ValueError(
            f"the following arguments are required: PORT; see `multidrop {arguments.command} --help`"
        )
    if is_plant(arguments.port):
        return plant_of(arguments.port, arguments)
    check_port(arguments.port)
    if arguments.ports:
        raise ValueError("--port is for the lines of a plant file; write the port in place of PORT")
    if arguments.name is not None:
        raise ValueError(
            f"unrecognized arguments: {arguments.name}; see `multidrop {arguments.command} --help`"
        )
    return None


def line_of(plant: Plant, name: str | None) -> PlantLine:
    """Return the line of this name, or a plant's only line. Raises ValueError."""
    if name is not None:
        return plant.find_line(name)
    if len(plant.lines) > 1:
        names = ", ".join(line.name for line in plant.lines)
        raise ValueError(f"{plant.path} has several lines: name one of {names}")
    return plant.lines[0]


def usual_settings(line: PlantLine | None) -> Settings:
    """Return the settings of most of a line's drives; 9600 8N1 where none is known."""
    found = [polled.drive.settings for polled in line.drives] if line else []
    return max(found, key=found.count) if found else Settings(9600, "8N1")


def _named_port(text: str) -> tuple[str, str]:
    name, equals, port = text.partition("=")
    if not (name and equals and port):
        raise argparse.ArgumentTypeError(f"{text!r} is not LINE=PORT, such as hall-1=ports/hall-1")
    return name, port
