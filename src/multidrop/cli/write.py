"""`multidrop write`: writes one register of a drive and prints the outcome."""

from __future__ import annotations

import argparse
import json
import sys

from multidrop.cli.support.arguments import (
    add_json_argument,
    add_target_arguments,
    add_writing_arguments,
    check_words,
    target_of,
)
from multidrop.cli.support.output import print_text
from multidrop.cli.support.values import as_json, nearest_value
from multidrop.cli.support.writing import confirm, reporting_interruption
from multidrop.control.rules import check_plain, raw_count, refused

_FURTHER = ("REGISTER", "VALUE")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_target_arguments(parser, *_FURTHER)
    parser.description = f"{parser.description} VALUE is in the register's unit, or a name."
    add_writing_arguments(parser)
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    target, words = target_of(arguments)
    check_words(arguments, words, _FURTHER)
    drive = target.drive
    register = drive.register(words[0])
    if register.never:
        raise refused(drive, register, register.never)
    value = nearest_value(register, register.parse(words[1]))
    check_plain(drive, register, raw_count(drive, register, value))  # checked before the port is opened
    confirm(f"Write {register.name} = {register.format(value)} to {drive.name} on {target.port}?", arguments)
    with reporting_interruption(drive, "write") as known, target.open_bus(arguments.audit):
        known.clear()
        outcome = drive.try_write(register, value)
        known.append(str(outcome))
    if arguments.json:
        held = outcome.asked if outcome.held is None else outcome.held
        record = {"drive": drive.name, "register": register.name} | as_json(register, held)
        print_text(json.dumps(record | {"outcome": outcome.effect.value}, indent=2))
    else:
        print_text(outcome, file=sys.stdout if outcome.ok else sys.stderr)
    return 0 if outcome.ok else 1
