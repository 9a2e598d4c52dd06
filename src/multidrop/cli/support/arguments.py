"""Arguments that several commands take."""

from __future__ import annotations

import argparse

from multidrop.drive.family import Drive
from multidrop.drives.registry import find_model


def add_port_argument(parser: argparse.ArgumentParser, nargs: str | None = None) -> None:
    parser.add_argument(
        "port", metavar="PORT", nargs=nargs, help="device such as /dev/ttyUSB0, or pyserial URL"
    )


def add_plant_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("plant", metavar="PLANT.toml", help="lines, drives, and what is polled")


def add_target_arguments(parser: argparse.ArgumentParser) -> None:
    """Add PORT MODEL ADDRESS, and options for a drive that differs from the family's defaults."""
    add_port_argument(parser)
    parser.add_argument(
        "model", metavar="MODEL", help="see `multidrop models`; or file.toml, or file.py:Class"
    )
    parser.add_argument("address", metavar="ADDRESS", type=_address, help="the drive's address on the line")
    parser.add_argument("--baudrate", type=int, metavar="N", help="where it is not the family's default")
    parser.add_argument("--format", metavar="8N1", help="data bits, parity and stop bits")
    parser.add_argument("--framing", metavar="rtu", help="where the family has several")
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


def add_writing_arguments(parser: argparse.ArgumentParser) -> None:
    """Add --yes and --audit, for commands that may write."""
    parser.add_argument("--yes", action="store_true", help="do not ask; needed where no terminal is")
    parser.add_argument("--audit", metavar="FILE", help="append every write and its outcome to this file")


def add_json_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print JSON for programs")


def duration(text: str) -> float:
    """Parse a number of seconds above 0."""
    try:
        seconds = float(text)
    except ValueError:
        seconds = 0.0
    if not 0 < seconds < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of seconds above 0")
    return seconds


def drive_of(arguments: argparse.Namespace) -> Drive:
    """Make the drive that the arguments name. Raises ValueError for what its family does not allow."""
    family = find_model(arguments.model)
    return family(
        arguments.address,
        framing=arguments.framing,
        baudrate=arguments.baudrate,
        format=arguments.format,
        ram=arguments.ram,
        **dict(arguments.option),
    )


def _address(text: str) -> int:
    try:
        return int(text, 0)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number such as 1") from None


def _option(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        return name.replace("-", "_"), float(value)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE with a number as its value") from None
