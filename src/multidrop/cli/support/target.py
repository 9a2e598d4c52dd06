"""The drive that a command is for: PORT MODEL ADDRESS, or PLANT.toml DRIVE."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from multidrop.bus import Bus
from multidrop.cli.support.arguments import whole
from multidrop.cli.support.output import command_line
from multidrop.cli.support.plants import add_port_option, is_plant, plant_of
from multidrop.core import RS485, Echo
from multidrop.drive.family import Drive
from multidrop.drive.network import check_port
from multidrop.families.registry import find_model
from multidrop.plant.drive_names import drive_meant
from multidrop.printable import plain_number, plain_whole

_HEX = re.compile("0[xX][0-9A-Fa-f]+")
_BY_HAND = ("PORT", "MODEL", "ADDRESS")
_BY_PLANT = ("PLANT.toml", "DRIVE")
_STOPS_AND_LOOKS = ("read", "state", "stop", "coast", "emergency-stop")
_SETTINGS = ("baudrate", "format", "framing")  # of a drive without a plant file


@dataclass(frozen=True)
class Target:
    """A drive, its port, the words that name both on a command line, and those that name its family."""

    drive: Drive
    port: str
    echo: Echo
    rs485: RS485
    settle: float
    words: tuple[str, ...]
    model: str

    def open_bus(self, audit: Path | str | None = None) -> Bus:
        """Open the drive's line, with the drive alone on it. Raises LineError."""
        bus = Bus(self.port, echo=self.echo, rs485=self.rs485, settle=self.settle, audit=audit)
        bus.attach(self.drive)
        return bus


def add_target_arguments(parser: argparse.ArgumentParser, *further: str) -> None:
    """Add the two ways to name a drive, and `further` arguments behind them, such as "[REGISTER ...]"."""
    ways = [" ".join((parser.prog, *way, *further, "[options]")) for way in (_BY_HAND, _BY_PLANT)]
    parser.usage = "\n       ".join(ways)
    parser.add_argument(
        "words",
        metavar="PORT MODEL ADDRESS",
        nargs="*",
        help="PORT: a device such as /dev/ttyUSB0, or a URL such as socket://host:port. MODEL: one of "
        "`multidrop models`, or file.toml, or file.py:Class. ADDRESS: the drive's. In their place "
        "PLANT.toml DRIVE: a plant file and the name of a drive in it",
    )
    parser.add_argument("--baudrate", type=whole, metavar="N", help="where it is not the family's default")
    parser.add_argument(
        "--format", metavar="8N1", help="data bits, parity and stop bits; the family's default if not given"
    )
    parser.add_argument(
        "--framing", metavar="rtu", help="where the family has several; its first if not given"
    )
    parser.add_argument(
        "--option",
        metavar="NAME=VALUE",
        type=_option,
        action="append",
        default=[],
        help="a fact about this drive; see `multidrop models MODEL`",
    )
    parser.add_argument(
        "--ram",
        metavar="REGISTER",
        action="append",
        default=[],
        help="a register that this drive is known not to store in EEPROM",
    )
    add_port_option(parser)


def target_of(arguments: argparse.Namespace) -> tuple[Target, list[str]]:
    """Return the drive that is named, and the words behind it.

    Raises ValueError for missing words, and for whatever the plant file or the family does not allow.
    """
    words = arguments.words
    if words and is_plant(words[0]):
        return _by_plant(arguments), words[len(_BY_PLANT) :]
    check_words(arguments, words[: len(_BY_HAND)], _BY_HAND)
    if arguments.ports:
        raise ValueError("--port is for the lines of a plant file; write the port in place of PORT")
    return _by_hand(arguments), words[len(_BY_HAND) :]


def check_words(arguments: argparse.Namespace, words: Sequence[str], names: Sequence[str]) -> None:
    """Raise ValueError unless there is one word for each name."""
    if missing := names[len(words) :]:
        raise _mistaken(arguments, f"the following arguments are required: {', '.join(missing)}")
    if words[len(names) :]:
        raise _mistaken(arguments, f"unrecognized arguments: {' '.join(words[len(names) :])}")


def number_of(arguments: argparse.Namespace, name: str, text: str) -> float:
    """Return the number that a word is. Raises ValueError."""
    try:
        return plain_number(text)
    except ValueError:
        raise _mistaken(arguments, f"argument {name}: {text!r} is not a number such as 42.5") from None


def _by_plant(arguments: argparse.Namespace) -> Target:
    path, *names = arguments.words
    plant = plant_of(path, arguments)
    given = [
        f"--{name}" for name in (*_SETTINGS, "option", "ram") if getattr(arguments, name) not in (None, [])
    ]
    if given:
        raise ValueError(f"{given[0]} is a matter of the plant file: write it into {path}")
    drives = [polled.drive.name for line in plant.lines for polled in line.drives]
    if not names:
        raise _mistaken(arguments, f"name a drive of {path}: {', '.join(drives)}")
    name = drive_meant(names[0], drives) if arguments.command in _STOPS_AND_LOOKS else names[0]
    line, drive = plant.find_drive(name)
    ports = [f"--port={name}={port}" for name, port in arguments.ports]
    words = (path, drive.name, *ports)
    return Target(
        drive, line.port, line.echo, line.rs485, line.settle, words, command_line((path, drive.name))
    )


def _by_hand(arguments: argparse.Namespace) -> Target:
    port, model, text = arguments.words[: len(_BY_HAND)]
    check_port(port)
    family = find_model(model)
    try:
        address = int(text, 16) if _HEX.fullmatch(text) else plain_whole(text)
    except ValueError:
        raise _mistaken(arguments, f"argument ADDRESS: {text!r} is not a number such as 1") from None
    settings = {name: getattr(arguments, name) for name in _SETTINGS}
    drive = family(address, ram=arguments.ram, **settings, **dict(arguments.option))
    words = [port, model, text]
    for name, value in settings.items():
        words += [] if value is None else [f"--{name}", str(value)]
    words += [f"--option={name}={value:g}" for name, value in arguments.option]
    return Target(drive, port, Echo.AUTO, RS485.OFF, 0.0, tuple(words), model)


def _mistaken(arguments: argparse.Namespace, sentence: str) -> ValueError:
    return ValueError(f"{sentence}; see `multidrop {arguments.command} --help`")


def _option(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        return name.replace("-", "_"), plain_number(value)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE with a number as its value") from None
