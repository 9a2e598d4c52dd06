"""`multidrop read`: reads values of one drive and prints them with their units."""

from __future__ import annotations

import argparse
import json
from typing import Any

from multidrop.bus import Bus
from multidrop.cli.support.arguments import add_json_argument, add_target_arguments, drive_of
from multidrop.cli.support.output import print_text
from multidrop.cli.support.values import aligned, as_json, as_row
from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.errors import DriveRefused


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_target_arguments(parser)
    parser.add_argument(
        "registers", metavar="REGISTER", nargs="*", default=[], help="all readings and settings if none"
    )
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    drive = drive_of(arguments)
    wanted = [drive.register(name) for name in arguments.registers]
    for register in wanted:
        if not register.readable:
            raise ValueError(f"{register.name} can only be written; see `multidrop models {arguments.model}`")
    wanted = wanted or [register for register in drive.registers.values() if register.readable]
    with Bus(arguments.port) as bus:
        bus.attach(drive)
        values = _read(bus, drive, wanted)
    refused = [answer for answer in values.values() if isinstance(answer, DriveRefused)]
    print_text(_json(drive, values) if arguments.json else _text(drive, values))
    return 1 if refused else 0


def _read(bus: Bus, drive: Drive, wanted: list[Register[Any]]) -> dict[Register[Any], Any]:
    """Return each register's value, or the drive's refusal."""
    try:
        found = bus.read_many(drive, wanted)
    except DriveRefused:  # which register, only single reads show
        return {register: _read_one(bus, drive, register) for register in wanted}
    return {register: found[register.name] for register in wanted}


def _read_one(bus: Bus, drive: Drive, register: Register[Any]) -> Any:
    try:
        return bus.read(drive, register)
    except DriveRefused as refusal:
        return refusal


def _text(drive: Drive, values: dict[Register[Any], Any]) -> str:
    rows = [
        (register.name, "", f"refused: {value.meaning}")
        if isinstance(value, DriveRefused)
        else as_row(register, value)
        for register, value in values.items()
    ]
    return "\n".join(aligned(rows, "<><"))


def _json(drive: Drive, values: dict[Register[Any], Any]) -> str:
    shown = {
        register.name: {"value": None, "refused": value.meaning, "code": value.code}
        if isinstance(value, DriveRefused)
        else as_json(register, value)
        for register, value in values.items()
    }
    return json.dumps(
        {"drive": drive.name, "model": drive.model, "address": drive.address, "values": shown}, indent=2
    )
