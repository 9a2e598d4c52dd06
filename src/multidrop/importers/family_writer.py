"""Write a family file for an imported device, without the registers that a family cannot declare."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from multidrop.drive.declaration_check import DeclarationError, declaration_errors
from multidrop.drive.family import TAKEN_NAMES, Drive
from multidrop.drive.line_settings import SERIAL_ADDRESSES
from multidrop.drive.register import HOLDING, Access, Register
from multidrop.drive.text import Text
from multidrop.families.files.notation import Counting, sent_as
from multidrop.families.files.registers import MOST_BYTES, MOST_REGISTERS, Declared
from multidrop.families.files.sections import MOST_TEXTS, texts_of
from multidrop.importers.device import UNKNOWN_HOST, ImportedDevice, ImportedRegister
from multidrop.printable import printable
from multidrop.toml_check import TomlPlace
from multidrop.toml_document import parse_document

MOST_LOST = 500  # limit of entries listed in the family file as not imported
UNKNOWN_PORT = f"the port, which the file does not state; tcp://{UNKNOWN_HOST}:502 if it is Modbus TCP"
_LONGEST = 200  # limit of characters in a text
_MOST_POINTS = 20  # limit of dots in a text, because the TOML parser is slow on lines with many dots

_ORDER = (
    *("unit", "values", "bits", "step", "offset", "number_format", "order", "part", "invalid"),
    *("scale_register", "length", "place", "note", "title"),
)


def family_text(device: ImportedDevice, source: str) -> str:
    """Return the text of a family file, which declares only readings and texts.

    Raises ValueError if the text would exceed the size limit of family files.
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

    Raises ValueError if the device's address is unknown, or if it has no register to poll.
    """
    if not device.registers:
        raise ValueError(
            "the device has only text registers, which are never polled: no plant file can be made of it"
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
    """Return the TOML line that declares the register in its section of the family file."""
    parts = [f"at = {sent_as(register.address, register.table)}"]
    if register.table != "holding":
        parts.append(f"table = {_value(register.table)}")
    parts += [f"{key} = {_value(register.details[key])}" for key in _ORDER if key in register.details]
    return f"{register.name} = {{ {', '.join(parts)} }}"


def _value(value: Any) -> str:
    """Return a value in TOML notation, on one line."""
    if isinstance(value, dict):
        pairs = (f"{name} = {_value(given)}" for name, given in value.items())
        return f"{{ {', '.join(pairs)} }}"
    if isinstance(value, list):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, str):
        text = "".join(character if character.isprintable() else " " for character in _short(value))
        return json.dumps(text, ensure_ascii=False)
    return repr(value)


def _comment(text: str) -> str:
    return printable(_short(text).replace("\n", " "))


def _short(text: str) -> str:
    return text[:_LONGEST].replace(".", " ") if text[:_LONGEST].count(".") > _MOST_POINTS else text[:_LONGEST]


_PLACE = Path("entry")


def drop_undeclarable(device: ImportedDevice) -> None:
    """Move registers and texts that no family can declare to the device's `lost`, with the error."""
    held = _keep(device, device.registers, declare, MOST_REGISTERS, "registers")
    _keep(device, device.texts, declare_text, MOST_TEXTS, "texts")
    _drop_conflicts(device, held)


def _keep(
    device: ImportedDevice,
    listed: list[ImportedRegister],
    declare: Callable[[ImportedRegister], Any],
    most: int,
    kind: str,
) -> dict[str, Any]:
    """Remove the entries from `listed` that no family can declare. Return the declarations by name."""
    held: dict[str, Any] = {}
    kept: list[ImportedRegister] = []
    for found in listed:
        if len(kept) == most:
            device.lose(found.name, f"a family has at most {most} {kind}")
            continue
        try:
            held[found.name] = declare(found)
        except ValueError as refusal:
            device.lose(found.name, str(refusal))
        else:
            kept.append(found)
    listed[:] = kept
    return held


def declare(found: ImportedRegister, access: Access = Access.READING) -> Register[Any]:
    """Return the register that the family file declares. Raises ValueError with all errors."""
    place = TomlPlace(_PLACE)
    declared = Declared(Counting(0), {}, "single")
    ((name, given),) = parse_document(entry_line(found).encode()).items()
    if access is not Access.READING:
        given |= found.of_writes
    declared.add(name, access, given, place, declared.counting.address)
    mistakes = [mistake.removeprefix(f"{_PLACE}: ") for mistake in place.config_errors]
    if not mistakes:
        wrong = declaration_errors(declared.registers, TAKEN_NAMES, ())
        mistakes = [mistake.removeprefix(f"{name}: ") for mistake in wrong]
    if mistakes:
        raise ValueError("; ".join(mistakes))
    return declared.registers[name]


def declare_text(found: ImportedRegister) -> Text:
    """Return the text register that the family file declares. Raises ValueError with all errors."""
    place = TomlPlace(_PLACE)
    texts = texts_of(parse_document(entry_line(found).encode()), Counting(0), {}, place)
    if place.config_errors:
        label = f"{_PLACE}: [text] {found.name}: "
        raise ValueError("; ".join(mistake.removeprefix(label) for mistake in place.config_errors))
    return texts[found.name]


def _drop_conflicts(device: ImportedDevice, held: dict[str, Register[Any]]) -> None:
    """Remove references to scale registers, and then registers, until the class is valid."""
    by_name = {found.name: found for found in device.registers}
    gaps = {HOLDING: device.readable} if device.readable else {}
    while wrong := _conflicts({**held, "readable_gaps": gaps}):
        named = {name: sentence for name, sentence in wrong.items() if name in by_name}
        if not named:
            raise ValueError(f"its registers cannot form one family: {'; '.join(wrong.values())}")
        for name, sentence in named.items():
            found = by_name[name]
            if found.details.pop("scale_register", None):
                found.lacks = sentence
                held[name] = declare(found)
            else:
                device.registers.remove(found)
                del held[name], by_name[name]
                device.lose(name, sentence)


def _conflicts(members: dict[str, Any]) -> dict[str, str]:
    """Return the errors of a class with these members, by register name; {} if the class is valid."""
    try:
        type("Imported", (Drive,), {"__doc__": "Of an importer.", **members})
    except DeclarationError as refusal:
        split = [mistake.partition(": ") for mistake in refusal.mistakes]
        return {name: sentence for name, _, sentence in split}
    return {}
