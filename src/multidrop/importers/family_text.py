"""Write a family file of an imported device; each gap is a comment that begins with `gap:`."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

from multidrop.family_file.addresses import is_ambiguous
from multidrop.importers.device import ImportedDevice, ImportedRegister
from multidrop.printable import printable

_ORDER = (
    *("unit", "values", "bits", "step", "offset", "number_format", "order", "part", "invalid"),
    *("scale_register", "length", "place", "note"),
)


def family_text(device: ImportedDevice, source: str) -> str:
    """Return the text of a family file. It declares readings and texts alone: nothing in it writes."""
    lines = [
        f"# Imported from {_comment(source)}: compare each line with the manual, and mend each `gap:`.",
        "# What could be written there is a reading here: make it a [setting] or a [command] once the manual",
        "# says what a write does, whether it is kept in EEPROM, and what is harmless.",
        "[family]",
        f"title = {_value(device.title or source)}  # gap: maker and type",
        f"manual = {_value(f'not stated: imported from {source}')}  # gap: the document and its version",
        "counts_from = 0  # the addresses below are those that are sent",
        "# gap: baudrates, formats, together: what the manual says of the line",
    ]
    for section, registers in (("reading", device.registers), ("text", device.texts)):
        if registers:
            lines += ["", f"[{section}]"]
        for register in registers:
            lines += [
                *(f"# gap: {register.name}: {_comment(gap)}" for gap in register.gaps),
                _entry(register),
            ]
    if device.lost:
        lines += ["", "# Not carried over:", *(f"# - {_comment(sentence)}" for sentence in device.lost)]
    return "\n".join([*lines, ""])


def plant_text(device: ImportedDevice, family_file: str) -> str:
    """Return the text of a plant file with this device. Raises ValueError where its address is not known."""
    if device.address is None:
        raise ValueError("the file does not say the device's address: no plant file can be made of it")
    return "\n".join(
        [
            "[[line]]",
            'name = "line-1"',
            'port = "/dev/ttyUSB0"  # gap: the port',
            "",
            "[[line.drive]]",
            f"name = {_value(f'device-{device.address}')}",
            f"model = {_value(family_file)}",
            f"address = {device.address}",
            "",
        ]
    )


def _entry(register: ImportedRegister) -> str:
    in_hex = f"0x{register.address:04X}"
    parts = [f'at = "{in_hex}"' if is_ambiguous(register.address, register.table) else f"at = {in_hex}"]
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
        text = "".join(character if character.isprintable() else " " for character in value[:500])
        return json.dumps(text, ensure_ascii=False)
    return repr(value)


def _pairs(value: dict[str, Any]) -> Iterator[str]:
    for name, number in value.items():
        yield f"{name} = {_value(number)}"


def _comment(text: str) -> str:
    return printable(text.replace("\n", " "))[:500]
