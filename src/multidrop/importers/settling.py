"""Let the library itself decide which imported registers and texts a family can hold."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from multidrop.drive.declaration_check import DeclarationError, declaration_errors
from multidrop.drive.family import TAKEN_NAMES, Drive
from multidrop.drive.register import HOLDING, Access, Register
from multidrop.drive.text import Text
from multidrop.families.files.addresses import Counting
from multidrop.families.files.registers import MOST_REGISTERS, Declared
from multidrop.families.files.texts import MOST_TEXTS, texts_of
from multidrop.importers.device import ImportedDevice, ImportedRegister
from multidrop.importers.family_text import entry_line
from multidrop.toml_check import TomlPlace, parse_document

_PLACE = Path("entry")


def settle(device: ImportedDevice) -> None:
    """Move what a family cannot hold to the device's `lost`, with the sentence of the library."""
    held = _keep(device, device.registers, declare, MOST_REGISTERS, "registers")
    _keep(device, device.texts, declare_text, MOST_TEXTS, "texts")
    _settle_together(device, held)


def _keep(
    device: ImportedDevice,
    listed: list[ImportedRegister],
    declare: Callable[[ImportedRegister], Any],
    most: int,
    kind: str,
) -> dict[str, Any]:
    """Leave in a list what one family can hold; return what it declares, by name."""
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
    """Return the register that a family's file makes of this one. Raises ValueError with its reasons."""
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
    """Return the text that a family's file makes of this one. Raises ValueError with its reasons."""
    place = TomlPlace(_PLACE)
    texts = texts_of(parse_document(entry_line(found).encode()), Counting(0), {}, place)
    if place.config_errors:
        label = f"{_PLACE}: [text] {found.name}: "
        raise ValueError("; ".join(mistake.removeprefix(label) for mistake in place.config_errors))
    return texts[found.name]


def _settle_together(device: ImportedDevice, held: dict[str, Register[Any]]) -> None:
    """Take away what registers are to each other until one class holds them all."""
    by_name = {found.name: found for found in device.registers}
    gaps = {HOLDING: device.readable} if device.readable else {}
    while wrong := _refused_together({**held, "readable_gaps": gaps}):
        named = {name: sentence for name, sentence in wrong.items() if name in by_name}
        if not named:
            raise ValueError(f"its registers are not one family: {'; '.join(wrong.values())}")
        for name, sentence in named.items():
            found = by_name[name]
            if found.details.pop("scale_register", None):
                found.lacks = sentence
                held[name] = declare(found)
            else:
                device.registers.remove(found)
                del held[name], by_name[name]
                device.lose(name, sentence)


def _refused_together(members: dict[str, Any]) -> dict[str, str]:
    """Return why one class cannot have these members, by register; nothing where it can."""
    try:
        type("Imported", (Drive,), {"__doc__": "Of an importer.", **members})
    except DeclarationError as refusal:
        split = [mistake.partition(": ") for mistake in refusal.mistakes]
        return {name: sentence for name, _, sentence in split}
    return {}
