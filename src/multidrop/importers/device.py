"""A device as an importer found it: registers with their gaps, and what could not be carried over."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from multidrop.drive.family import TAKEN_NAMES
from multidrop.family_file.names import unusable

_SIGNED = {"16": "I16", "32": "I32", "64": "I64"}
_UNSIGNED = {"16": "U16", "32": "U32", "64": "U64"}
_FLOATS = {"": "F32", "32": "F32", "64": "F64"}
_KINDS: Mapping[str, Mapping[str, str]] = {
    **dict.fromkeys(("int", "s", "i", "acc_s"), _SIGNED),
    **dict.fromkeys(("uint", "u", "acc", "enum", "bitfield"), _UNSIGNED),
    "float": _FLOATS,
}
_NAMED = {"word": "U16", "dword": "U32", "double": "F64", "float": "F32", "s8": "I8", "int8": "I8"}
_NAMED |= {"sunssf": "I16", "count": "U16", "pad": "U16", "raw16": "U16"}
TABLES = ("holding", "input", "coil", "discrete")


def number_format(kind: str) -> str | None:
    """Return the number format of a type such as uint16, s32 or float; None where it is not known."""
    kind = kind.strip().lower()
    if kind in _NAMED:
        return _NAMED[kind]
    match = re.fullmatch(r"([a-z_]+?)(\d*)", kind)
    return _KINDS.get(match[1], {}).get(match[2]) if match else None


def words_of(number: str) -> int:
    return {"32": 2, "64": 4}.get(number[-2:], 1)


@dataclass
class ImportedRegister:
    """One register; its address is the one that is sent. `gaps` are sentences about what is not known."""

    name: str
    address: int
    table: str = "holding"
    details: dict[str, Any] = field(default_factory=dict)  # by the keys of a family file, in this order
    gaps: list[str] = field(default_factory=list)


@dataclass
class ImportedDevice:
    """A device: what is read of it, and sentences about what could not be carried over."""

    title: str = ""
    address: int | None = None
    registers: list[ImportedRegister] = field(default_factory=list)
    texts: list[ImportedRegister] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)

    def add(self, found: ImportedRegister, *, is_text: bool = False) -> None:
        """Add a register under a name that no other has. Raises ValueError for an address that is none."""
        if isinstance(found.address, bool) or not 0 <= found.address <= 0xFFFF:
            self.lost.append(f"{found.name}: its address {found.address} is none from 0 to 65535")
            return
        spelt, found.name = found.name, self._name(found.name)
        if spelt != found.name and "note" not in found.details:
            found.details["note"] = spelt
        (self.texts if is_text else self.registers).append(found)

    def _name(self, spelt: str) -> str:
        name = re.sub(r"[^A-Za-z0-9]+", "_", spelt).strip("_").lower()[:50] or "register"
        if unusable(name) or name in _TAKEN:
            name = f"r_{name}"
        taken = {each.name for each in (*self.registers, *self.texts)}
        free = (name if number == 1 else f"{name}_{number}" for number in range(1, 10_000))
        return next(each for each in free if each not in taken)


_TAKEN = TAKEN_NAMES | {"declared_verbs", "is_jogged"}


def scaled(details: dict[str, Any], step: Any, offset: Any = 0) -> None:
    """Add step and offset where they say something. A step may be "unknown": counts are shown then."""
    if step == "unknown":
        details["step"] = step
        return
    if number(step, 1) != 1:
        details["step"] = number(step, 1)
    if number(offset, 0) != 0:
        details["offset"] = number(offset, 0)


def number(given: Any, default: float) -> float:
    """Return a number that may be text; `default` where there is none. Raises ValueError for other text."""
    if given in (None, ""):
        return default
    found = float(given)
    return int(found) if found == int(found) else found
