"""Arguments that several commands take."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from multidrop.bus import Bus
from multidrop.cli import HARD_WIRED, STOPS
from multidrop.cli.support.output import command_line, warn
from multidrop.core import RS485, Echo
from multidrop.drive.family import Drive
from multidrop.drive.line_settings import Settings, check_port
from multidrop.families.registry import find_model
from multidrop.plant.loader import PlantError, load_plant, load_served_plant
from multidrop.plant.model import Plant, PlantLine, drive_meant
from multidrop.printable import plain_number, plain_whole
from multidrop.toml_check import parse_duration

T = TypeVar("T")


def add_writing_arguments(parser: argparse.ArgumentParser, *, asks: bool = True) -> None:
    """Add --yes and --audit, for commands that may write. `asks` is False if the command never asks first."""
    yes = "do not ask; needed without a terminal" if asks else "no effect: this command never asks"
    parser.add_argument("--yes", action="store_true", help=yes)
    parser.add_argument("--audit", metavar="FILE", help="append every write and its outcome to this file")


def add_json_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print JSON for programs")


def argument(parse: Callable[[str], T], example: str = "") -> Callable[[str], T]:
    """Return an argparse type that calls `parse`; argparse reports its ValueError to the user."""

    def parsed(text: str) -> T:
        try:
            return parse(text)
        except ValueError as mistake:
            message = f"{text!r} is not {example}" if example else str(mistake)
            raise argparse.ArgumentTypeError(message) from None

    return parsed


def _seconds(text: str) -> float:
    seconds = plain_number(text)
    if not 0 < seconds < float("inf"):
        raise ValueError(text)
    return seconds


def _factor(text: str) -> float:
    factor = plain_number(text)
    if not 0.1 <= factor <= 100:
        raise ValueError(text)
    return factor


whole = argument(plain_whole, "a whole number such as 10")
number = argument(plain_number, "a number such as 42.5")
duration = argument(_seconds, "a number of seconds above 0")
_speed = argument(_factor, "a number from 0.1 to 100")


def add_plant_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("plant", metavar="PLANT.toml", help="lines, drives, and what is polled")


def add_port_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--port",
        metavar="LINE=PORT",
        dest="ports",
        type=argument(_named_port),
        action="append",
        default=[],
        help="use another port for a line of the plant file, such as a simulated one; may be repeated",
    )


def add_speed_option(parser: argparse.ArgumentParser, meaning: str) -> None:
    parser.add_argument("--speed", metavar="N", type=_speed, default=1.0, help=f"{meaning}; default: 1")


def plant_of(path: str, arguments: argparse.Namespace) -> Plant:
    """Load a plant, with the ports of --port. Raises ValueError for a mistake in the file or the options.

    For a stop, a mistake in the file causes only a warning. The plant then has only the drives that can be
    stopped, and `arguments.is_partial` is True.
    """
    arguments.is_partial = False
    load = load_served_plant if arguments.command == "serve" else load_plant
    try:
        plant = load(path)
    except PlantError as wrong:
        right = wrong.right
        if arguments.command not in STOPS or right is None or not any(line.drives for line in right.lines):
            raise
        plant, arguments.is_partial = right, True
        warn(f"{wrong}\na drive is not stopped if its line, model or address has a mistake: {HARD_WIRED}")
    ports = ports_of(arguments)
    return plant.with_ports(ports) if ports else plant


def ports_of(arguments: argparse.Namespace) -> dict[str, str]:
    """Return the ports of --port by line name. Raises ValueError if a line is named twice."""
    ports: dict[str, str] = {}
    for name, port in arguments.ports:
        if name in ports:
            raise ValueError(f"--port is given twice for line {name!r}: give it once")
        ports[name] = port
    return ports


def is_plant(word: str) -> bool:
    """Return True if a word in place of PORT names a plant file. Only the word's suffix is checked."""
    return "://" not in word and word.lower().endswith(".toml")


def add_line_arguments(parser: argparse.ArgumentParser, *, name: str = "LINE", kind: str = "line") -> None:
    """Add PORT, or PLANT.toml and the name of a line, which is optional for a plant with one line.

    `name` is the second argument's name in the help, and `kind` is what it may name, such as "line or drive".
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
        "name", metavar=name, nargs="?", help=f"a {kind} of the plant file; default: its only line"
    )
    add_port_option(parser)


def add_opening_arguments(parser: argparse.ArgumentParser) -> None:
    """Add --rs485 and --settle for a port without a plant file; see `opening_of`."""
    parser.add_argument(
        "--rs485",
        metavar="MODE",
        help="how to switch between sending and receiving, if the adapter does not by itself: "
        "kernel, rts-up or rts-down",
    )
    parser.add_argument(
        "--settle",
        metavar="TIME",
        help='pause after opening the port, such as "1.5 s", for devices that this resets',
    )


def opening_of(arguments: argparse.Namespace, line: PlantLine | None) -> tuple[RS485, float]:
    """Return the RS-485 mode, and the pause in s after opening.

    Both come from the line of the plant file, or from the options if there is no plant file. Raises
    ValueError for an invalid mode or pause, and if these options are given with a plant file.
    """
    if line is None:
        rs485 = RS485(arguments.rs485 or "off")
        rs485.check_port(arguments.port)
        return rs485, 0.0 if arguments.settle is None else parse_duration(arguments.settle)
    for name in ("rs485", "settle"):
        if getattr(arguments, name) is not None:
            raise ValueError(
                f"--{name} cannot be used with a plant file. Write key {name!r} in the table of {line.name!r}"
            )
    return RS485(line.rs485), line.settle


def plant_at(arguments: argparse.Namespace) -> Plant | None:
    """Return the plant if a plant file is given in place of PORT; None if a port is given.

    Raises ValueError for a mistake in the plant file, and for a plant file's option given with a port.
    """
    if arguments.port is None:
        raise mistaken(arguments, "the following arguments are required: PORT")
    if is_plant(arguments.port):
        return plant_of(arguments.port, arguments)
    check_port(arguments.port)
    if arguments.ports:
        raise ValueError(
            "--port needs a plant file. Without a plant file, give the port as the first argument"
        )
    if arguments.name is not None:
        raise mistaken(arguments, f"unrecognized arguments: {arguments.name}")
    return None


def line_of(plant: Plant, name: str | None) -> PlantLine:
    """Return the line of this name; without a name, the plant's only line. Raises ValueError."""
    if name is not None:
        return plant.find_line(name)
    if len(plant.lines) > 1:
        names = ", ".join(line.name for line in plant.lines)
        raise ValueError(f"{plant.path} has several lines: choose one of {names}")
    return plant.lines[0]


def usual_settings(line: PlantLine | None) -> Settings:
    """Return the settings that most of a line's drives have; 9600 8N1 without a line."""
    found = [polled.drive.settings for polled in line.drives] if line else []
    return max(found, key=found.count) if found else Settings(9600, "8N1")


def _named_port(text: str) -> tuple[str, str]:
    name, equals, port = text.partition("=")
    if not (name and equals and port):
        raise ValueError(f"{text!r} is not LINE=PORT, such as hall-1=ports/hall-1")
    return name, port


_HEX = re.compile("0[xX][0-9A-Fa-f]+")
_BY_PORT = ("PORT", "MODEL", "ADDRESS")
_BY_PLANT = ("PLANT.toml", "DRIVE")
_STOPS_AND_LOOKS = ("read", "state", "stop", "coast", "emergency-stop")
# options that are allowed only for a drive without a plant file
_SETTINGS = ("baudrate", "format", "framing")


@dataclass(frozen=True)
class Target:
    """A drive and its port, as given on the command line.

    `words` are the command-line words that name drive and port; `model` is the family's name as given.
    """

    drive: Drive
    port: str
    echo: Echo
    rs485: RS485
    settle: float
    words: tuple[str, ...]
    model: str

    def open_bus(self, audit: Path | str | None = None) -> Bus:
        """Open the drive's port, and return a bus with only this drive. Raises LineError."""
        bus = Bus(self.port, echo=self.echo, rs485=self.rs485, settle=self.settle, audit=audit)
        bus.attach(self.drive)
        return bus


def add_target_arguments(parser: argparse.ArgumentParser, *further: str) -> None:
    """Add the two ways to name a drive, and `further` arguments after them, such as "[REGISTER ...]"."""
    ways = [" ".join((parser.prog, *way, *further, "[options]")) for way in (_BY_PORT, _BY_PLANT)]
    parser.usage = "\n       ".join(ways)
    parser.add_argument(
        "words",
        metavar="PORT MODEL ADDRESS",
        nargs="*",
        help="PORT: a device such as /dev/ttyUSB0, or a URL such as socket://host:port. MODEL: one of "
        "`multidrop models`, or file.toml, or file.py:Class. ADDRESS: the drive's. In their place "
        "PLANT.toml DRIVE: a plant file and the name of a drive in it",
    )
    parser.add_argument("--baudrate", type=whole, metavar="N", help="default: the family's")
    parser.add_argument(
        "--format", metavar="8N1", help="data bits, parity and stop bits; default: the family's"
    )
    parser.add_argument("--framing", metavar="rtu", help="default: the family's first")
    parser.add_argument(
        "--option",
        metavar="NAME=VALUE",
        type=argument(_option, "NAME=VALUE with a number as its value"),
        action="append",
        default=[],
        help="a fact about this drive; see `multidrop models MODEL`",
    )
    parser.add_argument(
        "--ram",
        metavar="REGISTER",
        action="append",
        default=[],
        help="a register that this drive does not store in EEPROM",
    )
    add_port_option(parser)


def target_of(arguments: argparse.Namespace) -> tuple[Target, list[str]]:
    """Return the named drive, and the words after it.

    Raises ValueError for missing words, and for mistakes in the plant file or the drive's options.
    """
    words = arguments.words
    if words and is_plant(words[0]):
        return _by_plant(arguments), words[len(_BY_PLANT) :]
    check_words(arguments, words[: len(_BY_PORT)], _BY_PORT)
    if arguments.ports:
        raise ValueError(
            "--port needs a plant file. Without a plant file, give the port as the first argument"
        )
    return _by_port(arguments), words[len(_BY_PORT) :]


def check_words(arguments: argparse.Namespace, words: Sequence[str], names: Sequence[str]) -> None:
    """Raise ValueError unless the number of words equals the number of names."""
    if missing := names[len(words) :]:
        raise mistaken(arguments, f"the following arguments are required: {', '.join(missing)}")
    if words[len(names) :]:
        raise mistaken(arguments, f"unrecognized arguments: {' '.join(words[len(names) :])}")


def number_of(arguments: argparse.Namespace, name: str, text: str) -> float:
    try:
        return plain_number(text)
    except ValueError:
        raise mistaken(arguments, f"argument {name}: {text!r} is not a number such as 42.5") from None


def _by_plant(arguments: argparse.Namespace) -> Target:
    path, *names = arguments.words
    plant = plant_of(path, arguments)
    given = [
        f"--{name}" for name in (*_SETTINGS, "option", "ram") if getattr(arguments, name) not in (None, [])
    ]
    if given:
        raise ValueError(f"{given[0]} cannot be used with a plant file. Write the setting in {path}")
    drives = [polled.drive.name for polled in plant.drives]
    if not names:
        raise mistaken(arguments, f"choose a drive of {path}: {', '.join(drives)}")
    name = drive_meant(names[0], drives) if arguments.command in _STOPS_AND_LOOKS else names[0]
    line, drive = plant.find_drive(name)
    ports = [f"--port={name}={port}" for name, port in arguments.ports]
    words = (path, drive.name, *ports)
    echo, rs485 = Echo(line.echo), RS485(line.rs485)
    return Target(drive, line.port, echo, rs485, line.settle, words, command_line((path, drive.name)))


def _by_port(arguments: argparse.Namespace) -> Target:
    port, model, text = arguments.words[: len(_BY_PORT)]
    check_port(port)
    family = find_model(model)
    try:
        address = int(text, 16) if _HEX.fullmatch(text) else plain_whole(text)
    except ValueError:
        raise mistaken(arguments, f"argument ADDRESS: {text!r} is not a number such as 1") from None
    settings = {name: getattr(arguments, name) for name in _SETTINGS}
    drive = family(address, ram=arguments.ram, **settings, **dict(arguments.option))
    words = [port, model, text]
    for name, value in settings.items():
        words += [] if value is None else [f"--{name}", str(value)]
    words += [f"--option={name}={value:g}" for name, value in arguments.option]
    return Target(drive, port, Echo.AUTO, RS485.OFF, 0.0, tuple(words), model)


def mistaken(arguments: argparse.Namespace, sentence: str) -> ValueError:
    return ValueError(f"{sentence}; see `multidrop {arguments.command} --help`")


def _option(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    return name.replace("-", "_"), plain_number(value)
