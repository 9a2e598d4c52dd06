"""Cells of a CSV file: all are text, and become the values that TOML would have."""

from __future__ import annotations

import re
from typing import Any

_NUMBER = re.compile(r"[+-]?(\d+([.]\d*)?|[.]\d+)([eE][+-]?\d+)?", re.ASCII)
_WHOLE = re.compile(r"[+-]?\d+", re.ASCII)
_HEX = re.compile(r"0[xX]([0-9a-fA-F]{1,16})|([0-9a-fA-F]{1,16})[hH]")
_TRUTHS = {"true": True, "yes": True, "false": False, "no": False}


def text(cell: str) -> str:
    return cell


def number(cell: str) -> int | float:
    """Return a number with a point, or in hex. Raises ValueError with what would be right."""
    if match := _HEX.fullmatch(cell):
        return int(match[1] or match[2], 16)
    if _WHOLE.fullmatch(cell) and len(cell) <= 20:
        return int(cell)
    if _NUMBER.fullmatch(cell) and len(cell) <= 40:
        return float(cell)
    if "," in cell and (_NUMBER.fullmatch(point := cell.replace(".", "").replace(",", "."))):
        raise ValueError(f"{cell!r} has a decimal comma; write {point}")
    raise ValueError(f"{cell!r} is no number; write it as 0.1, 10 or 0x7FFF")


def number_or_word(cell: str) -> int | float | str:
    """Return a number, or a word such as unknown or NaN as it is."""
    return cell if cell.isalpha() else number(cell)


def numbers(cell: str) -> list[int | float | str]:
    """Return the numbers between bars: "0 | 50"."""
    return [number_or_word(part.strip()) for part in cell.split("|")]


def whole(cell: str) -> int:
    """Return a whole number; 1E10 may have been hex before a spreadsheet had it."""
    if _NUMBER.fullmatch(cell) and not _WHOLE.fullmatch(cell):
        right = f"0x{cell}" if cell.isalnum() else "it as 10 or 0x7FFF"
        raise ValueError(f"{cell!r} is no whole number; write {right}")
    found = number(cell)
    if not isinstance(found, int):
        raise ValueError(f"{cell!r} has too many digits")
    return found


def counts(cell: str) -> list[int]:
    """Return the raw counts between bars: "0x0476 | 0x0474"."""
    return [whole(part.strip()) for part in cell.split("|")]


def named(cell: str) -> dict[str, Any]:
    """Return the numbers by name in "off=0 | on=1". Raises ValueError with what would be right."""
    found: dict[str, Any] = {}
    for part in cell.split("|"):
        name, equals, given = (piece.strip() for piece in part.partition("="))
        if not equals or not name or not given:
            raise ValueError(f"{part.strip()!r} is no name with its number; write off=0 | on=1")
        if name in found:
            raise ValueError(f"{name} is there twice; each name has one number")
        found[name] = whole(given)
    return found


def truth(cell: str) -> bool:
    try:
        return _TRUTHS[cell.lower()]
    except KeyError:
        raise ValueError(f"{cell!r} is neither true nor false") from None
