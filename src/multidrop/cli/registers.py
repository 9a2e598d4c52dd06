"""`multidrop read`, `write` and `wear`: one drive's registers, and the writes that wear EEPROMs."""

from __future__ import annotations

import argparse
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from multidrop.cli.support.arguments import (
    add_json_argument,
    add_target_arguments,
    add_writing_arguments,
    check_words,
    target_of,
)
from multidrop.cli.support.output import confirm, print_json, print_text, reporting_interruption
from multidrop.cli.support.values import Row, aligned, as_json, as_row, nearest_value, user_title
from multidrop.control.eeprom_ledger import BUDGET, CYCLES, Ledger, Wear, default_ledger_path
from multidrop.control.rules import check_plain, raw_count, refused
from multidrop.core import Status, utc_minus_monotonic_ns
from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.drive.text import Text
from multidrop.errors import DriveException, NoValue
from multidrop.transport.clock import now_ns

_FURTHER = ("REGISTER", "VALUE")  # arguments of `write` after the drive


def add_arguments(parser: argparse.ArgumentParser) -> None:
    command = parser.get_default("command")
    if command == "wear":
        parser.add_argument("--ledger", metavar="FILE", help="another ledger than the user's")
    elif command == "write":
        add_target_arguments(parser, *_FURTHER)
        parser.description = f"{parser.description} VALUE is in the register's unit, or a name."
        add_writing_arguments(parser)
    else:
        add_target_arguments(parser, "[REGISTER ...]")
        parser.description = f"{parser.description} Without REGISTER, all readable registers are read."
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    return {"read": _run_read, "write": _run_write, "wear": _run_wear}[arguments.command](arguments)


def _run_read(arguments: argparse.Namespace) -> int:
    target, names = target_of(arguments)
    drive = target.drive
    texts = [drive.texts[name] for name in names if name in drive.texts]
    wanted = [drive.register(name) for name in names if name not in drive.texts]
    for register in wanted:
        if not register.readable:
            raise ValueError(
                f"register {register.name} cannot be read; see `multidrop models {target.model}`"
            )
    if not names:
        texts = list(drive.texts.values())
        wanted = [register for register in drive.registers.values() if register.readable]
    with target.open_bus():
        values = _read(drive, wanted)
        read_texts = {text: _read_one(drive, text) for text in texts}
    if arguments.json:
        record = {"drive": drive.name, "model": drive.model, "address": drive.address}
        shown = {one.name: _as_json(one, value) for one, value in (values | read_texts).items()}
        print_json(record | {"values": shown})
    else:
        rows = [(*_row(one, value), user_title(one)) for one, value in values.items()]
        lines = aligned(rows, "<><<")
        lines += aligned(map(_row, read_texts, read_texts.values()), "<<<")
        print_text("\n".join(lines))
    answers = (*values.values(), *read_texts.values())
    return 1 if any(isinstance(answer, DriveException) for answer in answers) else 0


def _read(drive: Drive, wanted: list[Register[Any]]) -> dict[Register[Any], Any]:
    """Return each register's value, or the drive's exception reply, or None for an invalid value."""
    try:
        found = drive.read_many(wanted)
    except NoValue as lack:
        found = dict(lack.values)
    except DriveException:  # read the registers one by one to find the one that caused the exception
        return {register: _read_one(drive, register) for register in wanted}
    return {register: found.get(register.name) for register in wanted}


def _read_one(drive: Drive, wanted: Register[Any] | Text) -> Any:
    """Return the value of a register or text, the drive's exception reply, or None for an invalid value."""
    try:
        return drive.read(wanted)
    except NoValue:
        return None
    except DriveException as refusal:
        return refusal


def _row(wanted: Register[Any] | Text, value: Any) -> Row:
    if isinstance(value, DriveException):
        return wanted.name, "", f"refused: code {value.code:02X}H, {value.meaning}"
    if value is None:
        return wanted.name, "", str(Status.NO_VALUE)
    return (wanted.name, value, "") if isinstance(wanted, Text) else as_row(wanted, value)


def _as_json(wanted: Register[Any] | Text, value: Any) -> dict[str, Any]:
    if isinstance(value, DriveException):
        return {"value": None, "refused": value.meaning, "code": value.code}
    if value is None:
        return {"value": None, "reason": str(Status.NO_VALUE)}
    return {"value": value} if isinstance(wanted, Text) else as_json(wanted, value)


def _run_write(arguments: argparse.Namespace) -> int:
    target, words = target_of(arguments)
    check_words(arguments, words, _FURTHER)
    drive = target.drive
    register = drive.register(words[0])
    if register.never:
        raise refused(drive, register, register.never)
    value = nearest_value(register, register.parse(words[1]))
    # an invalid value is refused before the port is opened
    check_plain(drive, register, raw_count(drive, register, value))
    confirm(f"Write {register.name} = {register.format(value)} to {drive.name} on {target.port}?", arguments)
    with reporting_interruption(drive, "write") as known, target.open_bus(arguments.audit):
        known.clear()
        outcome = drive.try_write(register, value)
        known.append(str(outcome))
    if arguments.json:
        held = outcome.asked if outcome.held is None else outcome.held
        record = {"drive": drive.name, "register": register.name} | as_json(register, held)
        print_json(record | {"outcome": outcome.effect.value})
    else:
        print_text(outcome, file=sys.stdout if outcome.ok else sys.stderr)
    return 0 if outcome.ok else 1


# ---- wear ----


WEAR_HEAD = ("PORT", "ADDRESS", "MODEL", "REGISTER", "WRITES", "THIS YEAR", "LEFT", "LAST")


def _run_wear(arguments: argparse.Namespace) -> int:
    if arguments.ledger and not Path(arguments.ledger).is_file():
        raise ValueError(
            f"there is no EEPROM ledger {arguments.ledger}; the default file is {default_ledger_path()}"
        )
    ledger = Ledger(arguments.ledger)
    found = ledger.wear((now_ns() + utc_minus_monotonic_ns()) / 1e9)
    if arguments.json:
        print_json([_wear_as_json(wear) for wear in found])
    elif not found:
        print_text(f"{ledger.path}: no writes to EEPROM yet")
    else:
        print_text("\n".join(aligned([WEAR_HEAD, *map(_wear_row, found)], "<><<>>><")))
        print_text(f"\n{ledger.path}: {BUDGET} writes of a register a year; an EEPROM lasts {CYCLES} writes.")
    return 0


def _wear_row(wear: Wear) -> tuple[str, ...]:
    """Return the cells of a row. The model is shown without the title that follows its ": "."""
    port, address, model, *columns, last = map(str, _wear_as_json(wear).values())
    return port, address, model.partition(": ")[0], *columns, last[:16].replace("T", " ")


def _wear_as_json(wear: Wear) -> dict[str, object]:
    cell = wear.cell
    return {
        "port": cell.port,
        "address": cell.address,
        "model": cell.model,
        "register": cell.register,
        "writes": wear.writes,
        "this_year": wear.this_year,
        "left": BUDGET - wear.this_year,
        "last": datetime.fromtimestamp(wear.last, UTC).isoformat(timespec="seconds"),
    }
