"""Keys of a register in a family's file: what each takes, and the detail of a declaration that it becomes.

The same keys stand in a table of TOML and at the head of a CSV file's columns.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from multidrop.core import NumberFormat
from multidrop.drive.register import Access, Kept
from multidrop.families.files import cells
from multidrop.families.files.addresses import TABLES

LONGEST_TEXT = 1000
MOST_LISTED = 100  # raw counts of one key
NOT_STATED = "unknown"
ORDERS = ("ABCD", "CDAB", "BADC", "DCBA", "AB", "BA")
WRITES = ("single", "multiple")
ACCESSES = {access.value: access for access in Access}
_KEPT = {"ram": Kept.RAM, "eeprom": Kept.EEPROM, NOT_STATED: Kept.UNKNOWN}


@dataclass(frozen=True)
class RegisterKey:
    """One key: it raises ValueError for what it does not take, and `example` is what it does."""

    convert: Callable[[Any], Any]
    example: str
    cell: Callable[[str], Any] = cells.text


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError("is no text")
    if not value.isprintable():
        raise ValueError("has characters that do not print; leave them out")
    if len(value) > LONGEST_TEXT:
        raise ValueError(f"has more than {LONGEST_TEXT} characters")
    return value


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError("is no number")
    if not math.isfinite(value):
        raise ValueError("is no finite number")
    return value


def _step(value: Any) -> Any:
    if value == NOT_STATED:
        return None
    if _number(value) == 0:
        raise ValueError("makes every value 0")
    return value


def _truth(value: Any) -> bool:
    if not isinstance(value, bool):
        raise ValueError("is neither true nor false")
    return value


def _span(value: Any) -> tuple[float, float]:
    if not isinstance(value, list) or len(value) != 2:
        raise ValueError("is not two numbers")
    low, high = map(_number, value)
    if low > high:
        raise ValueError("is the wrong way round: the smallest comes first")
    return low, high


def _counts(value: Any) -> tuple[int, ...]:
    if not isinstance(value, list) or not all(
        isinstance(each, int) and not isinstance(each, bool) for each in value
    ):
        raise ValueError("is no list of raw counts")
    if len(value) > MOST_LISTED:
        raise ValueError(f"has more than {MOST_LISTED} counts")
    return tuple(value)


def _invalid(value: Any) -> tuple[float, ...]:
    listed = value if isinstance(value, list) else [value]
    if not listed or len(listed) > MOST_LISTED:
        raise ValueError(f"is not 1 to {MOST_LISTED} raw counts")
    return tuple(math.nan if each in ("NaN", "nan") else _number(each) for each in listed)


def _part(value: Any) -> tuple[int, int]:
    first, dash, last = str(value).partition("-")
    ends = [end.strip() for end in (first, last if dash else first)]
    if isinstance(value, (bool, float)) or not all(end.isascii() and end.isdecimal() for end in ends):
        raise ValueError("is no bit, nor its first and last")
    low, high = (int(end[:4]) for end in ends)
    if low > high:
        raise ValueError("is the wrong way round: the lowest bit comes first")
    return low, high


def _one_of(known: Mapping[str, Any], spelling: Callable[[str], str] = str) -> Callable[[Any], Any]:
    def convert(value: Any) -> Any:
        name = spelling(value) if isinstance(value, str) else ""
        if name in known:
            return known[name]
        near = difflib.get_close_matches(str(name), known, n=1) if name else []
        hint = f"did you mean {near[0]}?" if near else f"it is one of {', '.join(known)}"
        raise ValueError(f"is not known: {hint}")

    return convert


def _named(value: Any) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise ValueError("is no table of names with their numbers")
    return value


REGISTER_KEYS: Mapping[str, RegisterKey] = {
    "at": RegisterKey(lambda value: value, 'at = 0x2000, 8192, "2000H" or "40001"'),
    "unit": RegisterKey(_text, 'unit = "Hz"'),
    "values": RegisterKey(_named, "values = { off = 0, on = 1 }", cells.named),
    "bits": RegisterKey(_named, "bits = { ready = 0, tripped = 3 }", cells.named),
    "step": RegisterKey(
        _step, 'step = 0.1, or "unknown" where the manual does not state it', cells.number_or_word
    ),
    "offset": RegisterKey(_number, "offset = -40", cells.number),
    "span": RegisterKey(_span, "span = [0, 50]", cells.numbers),
    "number_format": RegisterKey(_one_of(NumberFormat.__members__, str.upper), 'number_format = "F32"'),
    "order": RegisterKey(_one_of(dict(zip(ORDERS, ORDERS, strict=True)), str.upper), 'order = "CDAB"'),
    "part": RegisterKey(_part, 'part = "3" or "0-7"'),
    "invalid": RegisterKey(_invalid, 'invalid = 0x7FFF, [0x7FFF, 0x8000] or "NaN"', cells.numbers),
    "scale_register": RegisterKey(_text, 'scale_register = "power_of_ten"'),
    "table": RegisterKey(_one_of({name: name for name in TABLES}, str.lower), 'table = "input"'),
    "write": RegisterKey(_one_of(dict(zip(WRITES, WRITES, strict=True))), 'write = "multiple"'),
    "kept": RegisterKey(_one_of(_KEPT, str.lower), 'kept = "ram", "eeprom" or "unknown"'),
    "ram_address": RegisterKey(lambda value: value, "ram_address = 0x1005"),
    "default": RegisterKey(_number, "default = 50", cells.number),
    "at_least": RegisterKey(_text, 'at_least = "minimum_frequency"'),
    "at_most": RegisterKey(_text, 'at_most = "maximum_frequency"'),
    "while_running": RegisterKey(_truth, "while_running = false", cells.truth),
    "moves": RegisterKey(_truth, "moves = false", cells.truth),
    "harmless": RegisterKey(_counts, "harmless = [0x0476]", cells.counts),
    "broadcast": RegisterKey(_counts, "broadcast = [0]", cells.counts),
    "never": RegisterKey(_text, 'never = "the reason"'),
    "never_together": RegisterKey(_counts, "never_together = [0x0088]", cells.counts),
    "place": RegisterKey(_text, 'place = "table 12"'),
    "outside": RegisterKey(_text, 'outside = "another document"'),
    "note": RegisterKey(_text, 'note = "Of the motor."'),
}
NOT_DETAILS = frozenset({"at", "unit", "values", "bits", "table", "write", "ram_address"})
DEFAULT_KEYS = ("table", "unit", "step", "number_format", "order", "invalid", "write", "kept")


def converted(key: str, value: Any) -> Any:
    """Return what the key's value becomes. Raises ValueError with what was wrong and what would be right."""
    try:
        return REGISTER_KEYS[key].convert(value)
    except ValueError as mistake:
        raise ValueError(f"{key} = {shown(value)} {mistake}; write {REGISTER_KEYS[key].example}") from None


def shown(value: Any) -> str:
    """Return a value as a sentence shows it."""
    text = str(value).lower() if isinstance(value, bool) else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
