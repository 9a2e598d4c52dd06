"""Registers' values as people read them, in aligned columns, and as JSON."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Sequence
from enum import Flag, IntEnum
from typing import Any, TypeVar

from multidrop.cli.support.saying import say
from multidrop.drive.register import Register

Row = Sequence[str]
T = TypeVar("T", bound=float)


def aligned(rows: Iterable[Row], alignment: str) -> list[str]:
    """One line a row, its columns as wide as their widest text; `alignment` has < or > for each column."""
    rows = list(rows)
    widths = [max((len(text) for text in column), default=0) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            f"{text:{side}{width}}" for text, side, width in zip(row, alignment, widths, strict=True)
        ).rstrip()
        for row in rows
    ]


def taken(register: Register[T], value: T) -> T:
    """What the register can take of a value, said on stderr where that is another one.

    Raises ValueError for what it cannot take at all.
    """
    nearest = register.decode(register.encode(value))
    if nearest != value and not (register.is_float and register.parse(_number(register, nearest)) == value):
        why = f"has steps of {register.step:g} {register.unit}".rstrip()
        if register.is_float:
            why = "holds single-precision numbers"
        shown = register.format(nearest)
        say(f"multidrop: {register.name} {why}: {value!r} is taken as {shown}", file=sys.stderr)
    return nearest


def _number(register: Register[Any], value: float) -> str:
    """The shown value without its unit."""
    return register.format(value).partition(" ")[0]


def as_row(register: Register[Any], value: Any) -> Row:
    """Name, value, and unit or what is to be known about the value."""
    if isinstance(value, Flag | IntEnum):
        return register.name, register.format(value), ""
    number, _, unit = register.format(value).partition(" ")
    if register.values is not None:
        unit = "(the document has no name for it)"
    return register.name, number, unit


def as_json(register: Register[Any], value: Any) -> dict[str, Any]:
    """`value` is null, and the count is in `raw`, where the scale is not stated."""
    if isinstance(value, Flag):
        return {"value": [member.name for member in value], "raw": value.value}
    if isinstance(value, IntEnum):
        return {"value": value.name, "raw": value.value}
    if register.values is not None or register.step is None:
        whole = math.isfinite(value) and value == int(value)
        return {"value": None, "raw": int(value) if whole else value if math.isfinite(value) else None}
    return {"value": value if math.isfinite(value) else None, "unit": register.unit}
