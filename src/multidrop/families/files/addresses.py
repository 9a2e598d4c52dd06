"""Addresses as manuals write them, turned into those that are sent: 0x2000, 8192, "2000H", "40001"."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from multidrop.drive.register import COIL, DISCRETE, HOLDING, INPUT, Table

TABLES: Mapping[str, Table] = {"holding": HOLDING, "input": INPUT, "coil": COIL, "discrete": DISCRETE}
_TABLE_OF_DIGIT = {"0": "coil", "1": "discrete", "3": "input", "4": "holding"}
_DIGIT_OF_TABLE = {table: digit for digit, table in _TABLE_OF_DIGIT.items()}
LAST_ADDRESS = 0xFFFF

_HEX = re.compile(r"0[xX]([0-9a-fA-F]{1,8})|([0-9a-fA-F]{1,8})[hH]")
_NUMBERED = re.compile(
    r"[0134](\d{4}|\d{5})", re.ASCII
)  # 40001 or 400001: a table's digit, and a number from 1
_EXPONENT = re.compile(r"\d+([.]\d+)?[eE][+-]?\d+", re.ASCII)


@dataclass(frozen=True)
class Counting:
    """The number that the manual gives to the address 0 of the wire; None where the file does not say.

    `assumed` has the numbers for which 0 was assumed, so that their other mistakes are found.
    """

    counts_from: int | None
    assumed: list[int | str] = field(default_factory=list)

    def address(self, given: Any, table: str | None, default: str) -> tuple[int, str]:
        """Return the address on the wire, and the table's name, of a value of TOML.

        `table` is what the register says of itself, `default` what holds where it says nothing. Raises
        ValueError with what would be right.
        """
        if isinstance(given, bool) or not isinstance(given, (int, str)):
            raise ValueError(f'{given!r} is no address; write 0x2000, 8192, "2000H" or "40001"')
        if isinstance(given, int):
            return self._number(given, table or default), table or default
        text = given.strip()
        if match := _HEX.fullmatch(text):
            return self._sent(int(match[1] or match[2], 16), given), table or default
        if _NUMBERED.fullmatch(text):
            return _numbered(text, table)
        if text.isascii() and text.isdecimal():
            raise ValueError(f'"{text}" may be decimal or hex; write {int(text[:12])}, or "{text}H"')
        raise ValueError(f'"{text}" is no address; write 0x2000, 8192, "2000H" or "40001"')

    def address_in_cell(self, text: str, table: str | None, default: str) -> tuple[int, str]:
        """Return the same of a cell of a CSV file, in which a number of 40001's kind has no quotes.

        Where the file says `counts_from`, it is a number unless its digit names the table it is in.
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
            raise ValueError(f"{text} is a power of ten, which a spreadsheet makes of hex; write {digits}H")
        return self.address(text, table, default)

    def _number(self, number: int, table: str) -> int:
        digit = _DIGIT_OF_TABLE[table]
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
    """Return the TOML of an address that is sent as it is, where `counts_from` is 0."""
    is_plain = not _NUMBERED.fullmatch(str(address)) or _TABLE_OF_DIGIT[str(address)[0]] != table
    return f"0x{address:04X}" if is_plain else f'"{address:X}H"'


def _ambiguous(text: str, number: int) -> str:
    right = f'"{number:X}H" for that number' if number <= LAST_ADDRESS + 1 else "a smaller number"
    table = _TABLE_OF_DIGIT[text[0]]
    numbered = int(text[1:])
    return (
        f"{text} may be the number {text}, or register {numbered} of table {table}; write {right}, "
        f'or "{text}" in quotes in the TOML file (in a CSV file without counts_from) for that of the table'
    )


def _numbered(text: str, table: str | None) -> tuple[int, str]:
    named, number = _TABLE_OF_DIGIT[text[0]], int(text[1:])
    if table is not None and table != named:
        raise ValueError(
            f'"{text}" begins with {text[0]}, which is table {named}, and table is "{table}"; '
            "leave table out, or write the number that its table has"
        )
    if not 1 <= number <= LAST_ADDRESS + 1:
        raise ValueError(f'"{text}" is outside "{text[0]}{1:0{len(text) - 1}}" to "{text[0]}65536"')
    return number - 1, named
