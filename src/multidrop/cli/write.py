"""`multidrop write`: writes one register of one drive and says what became of it."""

from __future__ import annotations

import argparse
import json
import sys

from multidrop.bus import Bus
from multidrop.cli.support.arguments import (
    add_json_argument,
    add_target_arguments,
    add_writing_arguments,
    drive_of,
)
from multidrop.cli.support.confirm import confirm
from multidrop.cli.support.output import print_text
from multidrop.cli.support.values import as_json, nearest_value
from multidrop.control.outcome import Effect
from multidrop.control.rules import check_plain, raw_count, refused


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_target_arguments(parser)
    parser.add_argument("register", metavar="REGISTER", help="see `multidrop models MODEL`")
    parser.add_argument("value", metavar="VALUE", help="in the register's unit, or a name")
    add_writing_arguments(parser)
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    drive = drive_of(arguments)
    register = drive.register(arguments.register)
    if register.never:
        raise refused(drive, register, register.never)
    value = nearest_value(register, register.parse(arguments.value))
    check_plain(drive, register, raw_count(drive, register, value))  # before a port is opened
    confirm(
        f"Write {register.name} = {register.format(value)} to {drive.name} on {arguments.port}?", arguments
    )
    with Bus(arguments.port, audit=arguments.audit) as bus:
        outcome = bus.try_write(bus.attach(drive), register, value)
    if arguments.json:
        held = outcome.asked if outcome.held is None else outcome.held
        record = {"drive": drive.name, "register": register.name} | as_json(register, held)
        print_text(json.dumps(record | {"outcome": outcome.effect.value}, indent=2))
    else:
        print_text(outcome, file=sys.stdout if outcome.effect is Effect.DONE else sys.stderr)
    return 0 if outcome.effect is Effect.DONE else 1
