"""Write a family file of an imported device; each gap is a comment that begins with `gap:`."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

from multidrop.drive.line_settings import SERIAL_ADDRESSES
from multidrop.families.files.addresses import sent_as
from multidrop.families.files.csv_table import MOST_BYTES
from multidrop.importers.device import ImportedDevice, ImportedRegister
from multidrop.importers.line_settings import UNKNOWN_HOST
from multidrop.printable import printable

MOST_LOST = 500  # that the file tells
UNKNOWN_PORT = f"the port, which the file does not state; tcp://{UNKNOWN_HOST}:502 if it is Modbus TCP"
_LONGEST = 200  # characters of a text
_MOST_POINTS = 20  # of a text; TOML's reader takes a line of very many for a key

_ORDER = (
    *("unit", "values", "bits", "step", "offset", "number_format", "order", "part", "invalid"),
    *("scale_register", "length", "place", "note"),
)


def family_text(device: ImportedDevice, source: str) -> str:
    """Return the text of a family file. It declares readings and texts alone: nothing in it writes.

    Raises ValueError where it would be longer than a family file may be.
    """
    lines = [
        f"# Imported from {_comment(source)}: compare each line with the manual, and mend each `gap:`.",
        "# What could be written there is a reading here: make it a [setting] or a [command] once the manual",
        "# says what a write does, whether it is kept in EEPROM, and what is harmless.",
        "[family]",
        f"title = {_value(device.title or source)}  # gap: maker and type",
        f"manual = {_value(f'not stated: imported from {source}')}  # gap: the document and its version",
        "counts_from = 0  # the addresses below are those that are sent",
        _line_gap(device),
    ]
    if device.address is not None and device.address not in SERIAL_ADDRESSES:
        lines.append("addresses = [0, 255]  # unit ids of Modbus TCP")
    if device.together:
        lines.append(f"together = {{ holding = {device.together}, input = {device.together} }}")
    if device.readable:
        first, last = (sent_as(at, "holding") for at in (device.readable[0], device.readable[-1]))
        lines.append(f"gaps = {{ holding = [{first}, {last}] }}")
    for section, registers in (("reading", device.registers), ("text", device.texts)):
        if registers:
            lines += ["", f"[{section}]"]
        for register in registers:
            gaps = [
                *register.gaps,
                *([f"only its count is read: {register.lacks}"] if register.lacks else ()),
            ]
            lines += [*(f"# gap: {register.name}: {_comment(gap)}" for gap in gaps), entry_line(register)]
    if device.lost:
        left = len(device.lost) - MOST_LOST
        lines += ["", "# Not carried over:"]
        lines += [f"# - {_comment(str(lost))}" for lost in device.lost[:MOST_LOST]]
        lines += [f"# - and {left} more"] if left > 0 else []
    text = "\n".join([*lines, ""])
    if len(text.encode()) > MOST_BYTES:
        raise ValueError(
            f"the family file of {_comment(device.title)!r} would have more than {MOST_BYTES} bytes"
        )
    return text


def plant_text(device: ImportedDevice, family_file: str) -> str:
    """Return the text of a plant file with this device.

    Raises ValueError where its address is not known, or where it has nothing that is polled.
    """
    if not device.registers:
        raise ValueError(
            "the device has texts alone, which are never polled: no plant file can be made of it"
        )
    if device.address is None:
        raise ValueError("the file does not say the device's address: no plant file can be made of it")
    is_serial = device.address in SERIAL_ADDRESSES
    if not is_serial and device.line.port and not device.line.is_network:
        raise ValueError(
            f"the address {device.address} is a unit id of Modbus TCP, and the port {device.line.port} is a "
            "serial one: no plant file can be made of it"
        )
    port = device.line.port or ("/dev/ttyUSB0" if is_serial else f"tcp://{UNKNOWN_HOST}:502")
    return "\n".join(
        [
            "[[line]]",
            'name = "line-1"',
            f"port = {_value(port)}  # gap: {'the port' if device.line.port else UNKNOWN_PORT}",
            "",
            "[[line.drive]]",
            f"name = {_value(f'device-{device.address}')}",
            f"model = {_value(family_file)}",
            f"address = {device.address}",
            *(f"{key} = {_value(value)}" for key, value in device.line.drive_keys().items()),
            "",
        ]
    )


def _line_gap(device: ImportedDevice) -> str:
    wanted = "baudrates, formats" if device.together else "baudrates, formats, together"
    there = f"; there it is {_comment(str(device.line))}" if str(device.line) else ""
    return f"# gap: {wanted}: what the manual says of the line{there}"


def entry_line(register: ImportedRegister) -> str:
    """Return the register's line in its section."""
    parts = [f"at = {sent_as(register.address, register.table)}"]
    if register.table != "holding":
        parts.append(f"table = {_value(register.table)}")
    parts += [f"{key} = {_value(register.details[key])}" for key in _ORDER if key in register.details]
    return f"{register.name} = {{ {', '.join(parts)} }}"


def _value(value: Any) -> str:
    """Return a value as TOML on one line."""
    if isinstance(value, dict):
        return f"{{ {', '.join(_pairs(value))} }}"
    if isinstance(value, list):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, str):
        text = "".join(character if character.isprintable() else " " for character in _short(value))
        return json.dumps(text, ensure_ascii=False)
    return repr(value)


def _pairs(value: dict[str, Any]) -> Iterator[str]:
    for name, number in value.items():
        yield f"{name} = {_value(number)}"


def _comment(text: str) -> str:
    return printable(_short(text).replace("\n", " "))


def _short(text: str) -> str:
    return text[:_LONGEST].replace(".", " ") if text[:_LONGEST].count(".") > _MOST_POINTS else text[:_LONGEST]
