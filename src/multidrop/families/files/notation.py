"""Parse addresses and CSV cells in the notations of manuals: 0x2000, 8192, "2000H", "40001", off=0 | on=1."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from multidrop.drive.register import COIL, DISCRETE, HOLDING, INPUT, Table

TABLES: Mapping[str, Table] = {"holding": HOLDING, "input": INPUT, "coil": COIL, "discrete": DISCRETE}
_TABLE_OF_DIGIT = {"0": "coil", "1": "discrete", "3": "input", "4": "holding"}
DIGIT_OF_TABLE = {table: digit for digit, table in _TABLE_OF_DIGIT.items()}
LAST_ADDRESS = 0xFFFF

_HEX = re.compile(r"0[xX]([0-9a-fA-F]{1,8})|([0-9a-fA-F]{1,8})[hH]")
# addresses such as 40001 or 400001: a digit for the table, then a number from 1
_NUMBERED = re.compile(r"[0134](\d{4}|\d{5})", re.ASCII)
_EXPONENT = re.compile(r"\d+([.]\d+)?[eE][+-]?\d+", re.ASCII)


@dataclass(frozen=True)
class Counting:
    """Converts the addresses that a manual prints to the addresses that requests contain.

    `counts_from` is the number that the manual prints for the address 0 of a request; None if the file does
    not state it. Then 0 is assumed, so that other mistakes can still be found. `assumed` lists the addresses
    that were converted with this assumption.
    """

    counts_from: int | None
    assumed: list[int | str] = field(default_factory=list)

    def address(self, given: Any, table: str | None, default: str) -> tuple[int, str]:
        """Parse a register's address in a TOML file. Return the address in requests, and the table's name.

        `table` is the table that the register states, `default` the table if it states none. Raises
        ValueError if the address is invalid; the error gives a valid example.
        """
        if isinstance(given, bool) or not isinstance(given, (int, str)):
            raise ValueError(f'{given!r} is not an address; write 0x2000, 8192, "2000H" or "40001"')
        if isinstance(given, int):
            return self._number(given, table or default), table or default
        text = given.strip()
        if match := _HEX.fullmatch(text):
            return self._sent(int(match[1] or match[2], 16), given), table or default
        if _NUMBERED.fullmatch(text):
            return _numbered(text, table)
        if text.isascii() and text.isdecimal():
            raise ValueError(f'"{text}" may be decimal or hex; write {int(text[:12])}, or "{text}H"')
        raise ValueError(f'"{text}" is not an address; write 0x2000, 8192, "2000H" or "40001"')

    def address_in_cell(self, text: str, table: str | None, default: str) -> tuple[int, str]:
        """Convert an address in a CSV cell to an address in requests, and the name of its table.

        Cells have no quotes, so 40001 may be an address or the first holding register. In a file without
        `counts_from`, it is the first holding register. In a file with `counts_from`, it is an address; for
        a holding register it is ambiguous, and raises ValueError.
        """
        text = text.strip()
        if text.isascii() and text.isdecimal():
            if not _NUMBERED.fullmatch(text):
                return self._number(int(text[:12]), table or default), table or default
            if self.counts_from is None:
                return _numbered(text, table)
            if _TABLE_OF_DIGIT[text[0]] == (table or default):
                raise ValueError(_ambiguous(text, int(text)))
            return self._sent(int(text), text), table or default
        if _EXPONENT.fullmatch(text):
            digits = text.upper().replace("+", "")
            raise ValueError(
                f"{text} is a power of ten, into which a spreadsheet has converted a hex number; write "
                f"{digits}H"
            )
        return self.address(text, table, default)

    def _number(self, number: int, table: str) -> int:
        digit = DIGIT_OF_TABLE[table]
        if digit != "0" and str(number).startswith(digit) and _NUMBERED.fullmatch(str(number)):
            raise ValueError(_ambiguous(str(number), number))
        return self._sent(number, number)

    def _sent(self, number: int, given: int | str) -> int:
        first = self.counts_from or 0
        if self.counts_from is None:
            self.assumed.append(given)
        if not first <= number <= LAST_ADDRESS + first:
            raise ValueError(f"{given} is outside {first} to {LAST_ADDRESS + first:X}H")
        return number - first


def sent_as(address: int, table: str) -> str:
    """Return an address of a request as TOML text, for a file with `counts_from = 0`."""
    is_plain = not _NUMBERED.fullmatch(str(address)) or _TABLE_OF_DIGIT[str(address)[0]] != table
    return f"0x{address:04X}" if is_plain else f'"{address:X}H"'


def _ambiguous(text: str, number: int) -> str:
    right = f'"{number:X}H" for that number' if number <= LAST_ADDRESS + 1 else "a smaller number"
    table = _TABLE_OF_DIGIT[text[0]]
    numbered = int(text[1:])
    return (
        f"{text} may be the number {text}, or register {numbered} of table {table}; write {right}, "
        f'or "{text}" in quotes for the register of the table (in a CSV file, remove counts_from)'
    )


def _numbered(text: str, table: str | None) -> tuple[int, str]:
    named, number = _TABLE_OF_DIGIT[text[0]], int(text[1:])
    if table is not None and table != named:
        raise ValueError(
            f'"{text}" begins with {text[0]}, which stands for table {named}, but table = "{table}"; '
            f"remove the key table, or write an address of table {table}"
        )
    if not 1 <= number <= LAST_ADDRESS + 1:
        first, last = f"{text[0]}{1:0{len(text) - 1}}", f"{text[0]}65536"
        raise ValueError(f'"{text}" is outside "{first}" to "{last}"')
    return number - 1, named


_NUMBER = re.compile(r"[+-]?(\d+([.]\d*)?|[.]\d+)([eE][+-]?\d+)?", re.ASCII)
_WHOLE = re.compile(r"[+-]?\d+", re.ASCII)
_HEX_COUNT = re.compile(r"0[xX]([0-9a-fA-F]{1,16})|([0-9a-fA-F]{1,16})[hH]")
_TRUTHS = {"true": True, "yes": True, "false": False, "no": False}


def text(cell: str) -> str:
    return cell


def number(cell: str) -> int | float:
    """Parse a decimal or hex number. Raises ValueError with a valid example for any other text."""
    if match := _HEX_COUNT.fullmatch(cell):
        return int(match[1] or match[2], 16)
    if _WHOLE.fullmatch(cell) and len(cell) <= 20:
        return int(cell)
    if _NUMBER.fullmatch(cell) and len(cell) <= 40:
        return float(cell)
    if "," in cell and (_NUMBER.fullmatch(point := cell.replace(".", "").replace(",", "."))):
        raise ValueError(f"{cell!r} has a decimal comma; write {point}")
    raise ValueError(f"{cell!r} is not a number; write it as 0.1, 10 or 0x7FFF")


def number_or_word(cell: str) -> int | float | str:
    """Parse a number; return a word such as "unknown" or "NaN" unchanged."""
    return cell if cell.isalpha() else number(cell)


def numbers(cell: str) -> list[int | float | str]:
    """Parse numbers separated by bars: "0 | 50"."""
    return [number_or_word(part.strip()) for part in cell.split("|")]


def whole(cell: str) -> int:
    """Parse a whole number. Refuse 1E10: a spreadsheet may have converted a hex number to this."""
    if _NUMBER.fullmatch(cell) and not _WHOLE.fullmatch(cell):
        right = f"0x{cell}" if cell.isalnum() else "it as 10 or 0x7FFF"
        raise ValueError(f"{cell!r} is not a whole number; write {right}")
    found = number(cell)
    if not isinstance(found, int):
        raise ValueError(f"{cell!r} has too many digits")
    return found


def counts(cell: str) -> list[int]:
    """Parse raw counts separated by bars: "0x0476 | 0x0474"."""
    return [whole(part.strip()) for part in cell.split("|")]


def named(cell: str) -> dict[str, Any]:
    """Parse "off=0 | on=1" into numbers by name. Raises ValueError with a valid example for other texts."""
    return {name: whole(given) for name, given in _pairs(cell, "name=number", "off=0 | on=1")}


def titles(cell: str) -> dict[str, Any]:
    """Parse "ru=ток | zh=电流" into texts by language. Raises ValueError with a valid example otherwise."""
    return dict(_pairs(cell, "language=title", "ru=ток | zh=电流"))


def _pairs(cell: str, form: str, example: str) -> Iterator[tuple[str, str]]:
    found: set[str] = set()
    for part in cell.split("|"):
        name, equals, given = (piece.strip() for piece in part.partition("="))
        if not equals or not name or not given:
            raise ValueError(f"{part.strip()!r} is not of the form {form}; write {example}")
        if name in found:
            raise ValueError(f"{name} is given twice; give it once")
        found.add(name)
        yield name, given


def truth(cell: str) -> bool:
    try:
        return _TRUTHS[cell.lower()]
    except KeyError:
        raise ValueError(f"{cell!r} is neither true nor false") from None
