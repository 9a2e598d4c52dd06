"""Find the entries of an imported device that a family can represent, by declaring them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from multidrop.drive import Drive
from multidrop.drive.declaration_check import DeclarationError
from multidrop.drive.register import Access, Register
from multidrop.importers.device import ONLY_WRITTEN, ImportedDevice, ImportedRegister, declare

DETAILS = {  # properties that an imported entry may have, with their titles in the printed table
    "offset": "offset",
    "invalid": "invalid counts",
    "part": "bits of a word",
    "64 bit": "numbers of 64 bit",
    "order": "order of bytes or words",
    "bcd": "BCD",
    "s8": "signed 8 bit",
    "negative step": "negative step",
    "scale_register": "scale register",
    "names": "named values or bits",
    "text": "text",
    "one character": "text of one character a register",
    "by 16": "written by 16 alone",
    "float written": "float that is written",
    "elsewhere": "written at another address",
}


@dataclass(frozen=True)
class Holding:
    """An entry of another program's file: whether a family can declare it fully, only for reading, or not."""

    entry: ImportedRegister | None  # None: the importer could not convert the entry to a register
    is_held: bool
    is_written: bool = True  # True if the other program does not write the register, or a family can too
    lacks: str = ""  # reason why the family cannot declare the entry fully
    is_text: bool = False

    @property
    def is_whole(self) -> bool:
        return self.is_held and self.is_written

    @property
    def details(self) -> Iterator[str]:
        """Yield the keys of DETAILS that apply to the entry; none applies to a plain 16-bit number."""
        if self.entry is None:
            return
        details, number = self.entry.details, str(self.entry.details.get("number_format", "U16"))
        needed = {
            **{key: key in details for key in ("offset", "invalid", "part", "scale_register")},
            "64 bit": number.endswith("64"),
            "order": "order" in details and not self.is_text,
            "bcd": number.startswith("BCD"),
            "s8": number == "I8",
            "negative step": details.get("step", 1) < 0,
            "names": "values" in details or "bits" in details,
            "text": self.is_text,
            "one character": self.is_text and details.get("order") == "B",
            "by 16": "write" in self.entry.of_writes and self.entry.is_written,
            "float written": number in ("F32", "F64") and self.entry.is_written,
            "elsewhere": "ram_address" in self.entry.of_writes,
        }
        yield from (key for key, is_needed in needed.items() if is_needed)


def holdings(device: ImportedDevice) -> list[Holding]:
    """Return for each entry of an imported device whether a family can declare it.

    The declared register must be readable and writable as in the program that the entry is from.
    """
    found = [_held(entry) for entry in device.registers]
    found += [Holding(entry, is_held=True, is_text=True) for entry in device.texts]
    found += [_commanded(entry) for entry in device.commands]
    lost = [each for each in device.lost if each.is_entry and each.reason != ONLY_WRITTEN]
    return found + [Holding(None, is_held=False, lacks=each.reason) for each in lost]


def family_of(entries: list[Holding]) -> str:
    """Declare these entries in one family; return the library's reason for a refusal, or ""."""
    members = {
        f"entry_{number}": _declared(each.entry)
        for number, each in enumerate(entries)
        if each.entry is not None and not each.is_text
    }
    for name, register in members.items():
        object.__setattr__(register, "name", name)
        # `_why_not` has already checked the scale register, which has a new name here.
        object.__setattr__(register, "scale_register", "")
    return _refusal(members)


def _held(entry: ImportedRegister) -> Holding:
    if entry.lacks:
        return Holding(entry, is_held=False, lacks=_kind_of(entry.lacks))
    reason = _why_not(entry)
    return Holding(entry, is_held=True, is_written=not reason, lacks=reason)


def _kind_of(lacks: str) -> str:
    """Return a reason without its quoted parts, so that similar reasons are counted together."""
    return re.sub(r"'[^']*'", "'...'", lacks)


def _commanded(entry: ImportedRegister) -> Holding:
    reason = entry.lacks or _why_not(entry)
    return Holding(entry, is_held=not reason, lacks=reason)


def _why_not(entry: ImportedRegister) -> str:
    """Return why a family cannot declare an entry of another program's file; "" if it can."""
    try:
        register = _declared(entry)
    except ValueError as refusal:
        return str(refusal)
    if entry.details.get("scale_register"):
        return (
            ""
            if not entry.is_written
            else "a number whose power of ten is in another register is never written"
        )
    return _refusal({register.name: register})


def _declared(entry: ImportedRegister) -> Register[Any]:
    access = Access.SETTING if entry.is_written else Access.READING
    return declare(entry, access if entry.is_read else Access.COMMAND)


def _refusal(members: Mapping[str, Register[Any]]) -> str:
    try:
        type("Device", (Drive,), {"__doc__": "Of a template.", **members})
    except DeclarationError as refusal:
        return str(refusal.mistakes[0]).partition(": ")[2]
    return ""
