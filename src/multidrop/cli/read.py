"""`multidrop read`: reads values of one drive and prints them with their units."""

from __future__ import annotations

import argparse
import json
from typing import Any

from multidrop.bus import Bus
from multidrop.cli.support.arguments import add_json_argument
from multidrop.cli.support.output import print_text
from multidrop.cli.support.target import add_target_arguments, target_of
from multidrop.cli.support.values import Row, aligned, as_json, as_row
from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.errors import DriveRefused


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_target_arguments(parser, "[REGISTER ...]")
    parser.description = f"{parser.description} Without a REGISTER: all that can be read."
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    target, names = target_of(arguments)
    drive = target.drive
    wanted = [drive.register(name) for name in names]
    for register in wanted:
        if not register.readable:
            raise ValueError(f"{register.name} can only be written; see `multidrop models {target.model}`")
    wanted = wanted or [register for register in drive.registers.values() if register.readable]
    with target.open_bus() as bus:
        values = _read(bus, drive, wanted)
    if arguments.json:
        record = {"drive": drive.name, "model": drive.model, "address": drive.address}
        shown = {register.name: _as_json(register, value) for register, value in values.items()}
        print_text(json.dumps(record | {"values": shown}, indent=2))
    else:
        print_text("\n".join(aligned([_row(*answer) for answer in values.items()], "<><")))
    return 1 if any(isinstance(value, DriveRefused) for value in values.values()) else 0


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


def _row(register: Register[Any], value: Any) -> Row:
    if isinstance(value, DriveRefused):
        return register.name, "", f"refused: {value.meaning}"
    return as_row(register, value)


def _as_json(register: Register[Any], value: Any) -> dict[str, Any]:
    if isinstance(value, DriveRefused):
        return {"value": None, "refused": value.meaning, "code": value.code}
    return as_json(register, value)
