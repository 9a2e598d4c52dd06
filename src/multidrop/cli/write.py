"""`multidrop write`: one register of one drive, and what the drive then holds."""

from __future__ import annotations

import argparse
import json
import sys

from multidrop.bus import Bus
from multidrop.cli.target import add_json_argument, add_target_arguments, drive_of
from multidrop.cli.values import as_json
from multidrop.errors import Refused


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_target_arguments(parser)
    parser.add_argument("register", metavar="REGISTER", help="see `multidrop models MODEL`")
    parser.add_argument("value", metavar="VALUE", help="in the register's unit, or a name")
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    drive = drive_of(arguments)
    register = drive.register(arguments.register)
    if not register.writable:
        raise Refused(
            f"{register.name} is not written: {register.never or f'it is a {register.access.value}'}"
        )
    value = register.parse(arguments.value)
    asked = register.decode(register.encode(value))
    with Bus(arguments.port) as bus:
        held = bus.write(bus.attach(drive), register, value)
    if arguments.json:
        print(
            json.dumps({"drive": drive.name, "register": register.name} | as_json(register, held), indent=2)
        )
    else:
        print(f"{register.name} = {register.format(held)}")
    if register.readable and held != asked:
        refusal = f"{drive.name} holds {register.format(held)}, not {register.format(asked)} as it was told"
        print(f"multidrop: {refusal}", file=sys.stderr)
        return 1
    return 0
