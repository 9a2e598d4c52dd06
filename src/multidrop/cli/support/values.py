"""Register values as text and as JSON; text in aligned columns and in wrapped lines."""

from __future__ import annotations

import math
import os
import textwrap
from collections.abc import Iterable, Sequence
from enum import Flag, IntEnum
from typing import Any, TypeVar
from unicodedata import combining, east_asian_width

from multidrop.cli.support.output import warn
from multidrop.core import NumberFormat
from multidrop.drive.register import Register, chosen_language, unnamed_bits

Row = Sequence[str]
T = TypeVar("T", bound=float)
WIDTH = 80  # limit of characters in a wrapped line of text
# limit of a name's width in columns; longer names are shortened so that tables fit a terminal
LONGEST_NAME = 24
_PRECISIONS = {NumberFormat.F16: "half", NumberFormat.F32: "single", NumberFormat.F64: "double"}


def user_title(register: Register[Any]) -> str:
    """Return the register's title in the language of the environment; "" if it repeats the name."""
    given = next(filter(None, map(os.environ.get, ("LC_ALL", "LC_MESSAGES", "LANG"))), "")
    title = register.title_in(chosen_language([given]))
    return "" if title == register.title else title


def aligned(rows: Iterable[Row], alignment: str, between: str = "  ") -> list[str]:
    """Return one line of text per row, with aligned columns; `alignment` has < or > for each column."""
    rows = list(rows)
    widths = [max(map(columns_of, column), default=0) for column in zip(*rows, strict=True)]
    return [between.join(map(padded, row, alignment, widths)).rstrip() for row in rows]


def columns_of(text: str) -> int:
    """Return a text's width in terminal columns. Some characters take two columns, and some none."""
    return sum((not combining(mark)) + (east_asian_width(mark) in "WF") for mark in text)


def padded(text: str, side: str, width: int) -> str:
    """Pad a text to a width in columns. With `side` "<" the text is on the left, with ">" on the right."""
    blank = " " * (width - columns_of(text))
    return text + blank if side == "<" else blank + text


def wrapped(text: str, first: str = "", rest: str = "", *, breaks_words: bool = True) -> list[str]:
    """Wrap a text to WIDTH. `first` is put before the first line, `rest` before the other lines."""
    return textwrap.wrap(
        text,
        WIDTH,
        initial_indent=first,
        subsequent_indent=rest,
        break_long_words=breaks_words,
        break_on_hyphens=breaks_words,
    )


def counted(count: int, one: str, many: str = "") -> str:
    """Return a number with its noun, such as "1 drive" or "2 drives". `many` is an irregular plural."""
    return f"{count} {one if count == 1 else many or f'{one}s'}"


def shortened(name: str) -> str:
    """Shorten a long name by removing its middle, because names often differ only at their ends."""
    if columns_of(name) <= LONGEST_NAME:
        return name
    return f"{_first(name, 12)}...{_first(name[::-1], LONGEST_NAME - 15)[::-1]}"


def cut_to(text: str, columns: int) -> str:
    """Cut a text to a width in columns. A ~ marks the cut."""
    return text if columns_of(text) <= columns else f"{_first(text, columns - 1)}~"[: max(0, columns)]


def _first(text: str, columns: int) -> str:
    """Return the longest start of a text that fits into these columns."""
    return next(text[:n] for n in range(len(text), -1, -1) if columns_of(text[:n]) <= columns)


def nearest_value(register: Register[T], value: T) -> T:
    """Return the nearest value that the register can hold, and warn if it differs from `value`.

    Raises ValueError if `value` is outside the register's range.
    """
    nearest = register.decode(register.encode(value))
    # 15 digits, because a value in % that was computed from Hz has a rounding error in its last digit
    given = float(f"{value:.15g}") if isinstance(value, float) else value
    if nearest != given and not (register.is_float and register.parse(_number(register, nearest)) == value):
        why = f"has steps of {register.step:g} {register.unit}".rstrip()
        if register.is_float:
            why = f"holds {_PRECISIONS[register.number_format]}-precision numbers"
        shown = register.format(nearest)
        warn(f"{register.name} {why}: {given!r} becomes {shown}")
    return nearest


def value_text(register: Register[Any], value: float) -> str:
    """Return a recorded value as text: its name, a raw count, or a number with its unit."""
    if register.values is not None:
        return register.format(register.decode(value))
    if register.step is None:
        return f"{_number(register, value)} raw"
    return register.format(value)


def _number(register: Register[Any], value: float) -> str:
    return register.format(value).partition(" ")[0]


def as_row(register: Register[Any], value: Any) -> Row:
    """Return a table row: the register's name, the value, and its unit or a remark."""
    if isinstance(value, Flag | IntEnum):
        return register.name, register.format(value), ""
    number, _, unit = register.format(value).partition(" ")
    if register.values is not None:
        unit = "(no name in the manual)"
    return register.name, number, unit


def as_json(register: Register[Any], value: Any) -> dict[str, Any]:
    """Return the value as JSON: with its unit, or as a name with its raw count.

    Without a known scale, `value` is None.
    """
    if isinstance(value, Flag):
        return {"value": [*(member.name for member in value), *unnamed_bits(value)], "raw": value.value}
    if isinstance(value, IntEnum):
        return {"value": value.name, "raw": value.value}
    if register.values is not None or register.step is None:
        whole = math.isfinite(value) and value == int(value)
        return {"value": None, "raw": int(value) if whole else value if math.isfinite(value) else None}
    return {"value": value if math.isfinite(value) else None, "unit": register.unit}
