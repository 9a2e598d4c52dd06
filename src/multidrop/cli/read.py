"""`multidrop read`: reads values of one drive and prints them with their units."""

from __future__ import annotations

import argparse
import json
from typing import Any

from multidrop.cli.support.arguments import add_json_argument, add_target_arguments, target_of
from multidrop.cli.support.output import print_text
from multidrop.cli.support.values import Row, aligned, as_json, as_row
from multidrop.core import Status
from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.drive.text import Text
from multidrop.errors import DriveException, NoValue


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_target_arguments(parser, "[REGISTER ...]")
    parser.description = f"{parser.description} Without REGISTER, all readable registers are read."
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    target, names = target_of(arguments)
    drive = target.drive
    texts = [drive.texts[name] for name in names if name in drive.texts]
    wanted = [drive.register(name) for name in names if name not in drive.texts]
    for register in wanted:
        if not register.readable:
            raise ValueError(f"{register.name} can only be written; see `multidrop models {target.model}`")
    if not names:
        texts = list(drive.texts.values())
        wanted = [register for register in drive.registers.values() if register.readable]
    with target.open_bus():
        values = _read(drive, wanted)
        read_texts = {text: _read_text(drive, text) for text in texts}
    if arguments.json:
        record = {"drive": drive.name, "model": drive.model, "address": drive.address}
        shown = {register.name: _as_json(register, value) for register, value in values.items()}
        shown |= {text.name: _text_as_json(answer) for text, answer in read_texts.items()}
        print_text(json.dumps(record | {"values": shown}, indent=2))
    else:
        lines = aligned([_row(*answer) for answer in values.items()], "<><")
        lines += aligned([_text_row(*answer) for answer in read_texts.items()], "<<")
        print_text("\n".join(lines))
    answers = (*values.values(), *read_texts.values())
    return 1 if any(isinstance(answer, DriveException) for answer in answers) else 0


def _read(drive: Drive, wanted: list[Register[Any]]) -> dict[Register[Any], Any]:
    """Return each register's value, the drive's exception, or None if it has no valid value."""
    try:
        found = drive.read_many(wanted)
    except NoValue as lack:
        found = dict(lack.values)
    except DriveException:  # read one by one to find the register that caused it
        return {register: _read_one(drive, register) for register in wanted}
    return {register: found.get(register.name) for register in wanted}


def _read_one(drive: Drive, register: Register[Any]) -> Any:
    try:
        return drive.read(register)
    except NoValue:
        return None
    except DriveException as refusal:
        return refusal


def _read_text(drive: Drive, text: Text) -> str | DriveException:
    try:
        return drive.read(text)
    except DriveException as refusal:
        return refusal


def _row(register: Register[Any], value: Any) -> Row:
    if isinstance(value, DriveException):
        return register.name, "", _refusal(value)
    if value is None:
        return register.name, "", str(Status.NO_VALUE)
    return as_row(register, value)


def _text_row(text: Text, answer: str | DriveException) -> Row:
    return text.name, _refusal(answer) if isinstance(answer, DriveException) else answer


def _refusal(refusal: DriveException) -> str:
    return f"refused: code {refusal.code:02X}H, {refusal.meaning}"


def _text_as_json(answer: str | DriveException) -> dict[str, Any]:
    if isinstance(answer, DriveException):
        return {"value": None, "refused": answer.meaning, "code": answer.code}
    return {"value": answer}


def _as_json(register: Register[Any], value: Any) -> dict[str, Any]:
    if isinstance(value, DriveException):
        return {"value": None, "refused": value.meaning, "code": value.code}
    if value is None:
        return {"value": None, "reason": str(Status.NO_VALUE)}
    return as_json(register, value)
