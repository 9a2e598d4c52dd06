"""Numbers of other programs' tables: their types, steps, and orders of bytes and words."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

TABLES = ("holding", "input", "coil", "discrete")
_SIGNED = {"16": "I16", "32": "I32", "64": "I64"}
_UNSIGNED = {"16": "U16", "32": "U32", "64": "U64"}
_FLOATS = {"": "F32", "16": "F16", "32": "F32", "64": "F64"}
_KINDS: Mapping[str, Mapping[str, str]] = {
    **dict.fromkeys(("int", "s", "i", "acc_s"), _SIGNED),
    **dict.fromkeys(("uint", "u", "acc", "enum", "bitfield"), _UNSIGNED),
    "float": _FLOATS,
}
_NAMED = {"word": "U16", "dword": "U32", "double": "F64", "float": "F32", "s8": "I8", "int8": "I8"}
_NAMED |= {"int": "I16", "uint": "U16", "sunssf": "I16", "count": "U16", "pad": "U16", "raw16": "U16"}
_COUNT = re.compile(r"0[xX][0-9a-fA-F]{1,16}|-?[0-9]{1,20}")


def number_format(kind: str) -> str | None:
    """Return the number format of a type such as uint16, s32 or float; None where it is not known."""
    kind = kind.strip().lower()
    if kind in _NAMED:
        return _NAMED[kind]
    match = re.fullmatch(r"([a-z_]+?)(\d*)", kind)
    return _KINDS.get(match[1], {}).get(match[2]) if match else None


def words_of(number: str) -> int:
    return {"32": 2, "64": 4}.get(number[-2:], 1)


def put_number(details: dict[str, Any], number: str, order: str = "") -> None:
    """Add the number format and the order of its bytes, of ABCD's kind for any width."""
    if number != "U16":
        details["number_format"] = number
    if words_of(number) == 1:
        order = "BA" if order in ("BADC", "DCBA", "BA") else ""
    if order not in ("", "ABCD"):
        details["order"] = order


def scaled(details: dict[str, Any], step: Any, offset: Any = 0) -> None:
    """Add step and offset where they say something; a step of 0 says nothing. Raises as `number` does."""
    found = number(step, 1), number(offset, 0)
    if found[0] not in (0, 1):
        details["step"] = found[0]
    if found[1] != 0:
        details["offset"] = found[1]


def number(given: Any, default: float) -> float:
    """Return a number that may be text; `default` where there is none. Raises ValueError for other text."""
    if given in (None, ""):
        return default
    text = str(given)
    if re.fullmatch(r"-?\d+,\d+", text):  # a decimal comma
        text = text.replace(",", ".")
    found = float(text)
    if not math.isfinite(found):
        raise ValueError(f"{str(given)[:40]!r} is no number")
    return int(found) if found == int(found) and abs(found) < 1e15 else found


def count(given: Any) -> int | str:
    """Return a raw count: a number, also as text and in hex, or NaN. Raises ValueError for what is none."""
    text = str(given).strip()
    if text.lower() == "nan":
        return "NaN"
    if not _COUNT.fullmatch(text):
        raise ValueError(f"{text[:40]!r} is no count")
    return int(text, 0 if text[:2].lower() == "0x" else 10)
