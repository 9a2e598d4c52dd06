"""Quantities of other programs' device templates, and the register that the library makes of each."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from multidrop.core import NumberFormat
from multidrop.drive import Drive
from multidrop.drive.register import (
    COIL,
    DISCRETE,
    HOLDING,
    HOLDING_MULTIPLE,
    INPUT,
    Table,
    command,
    reading,
    setting,
)
from multidrop.drive.text import text

TABLES: dict[str, Table] = {
    "coil": COIL,
    "discrete": DISCRETE,
    "holding": HOLDING,
    "holding by 16": HOLDING_MULTIPLE,
    "input": INPUT,
}
FORMATS = {
    **{f"u{bits}": NumberFormat[f"U{bits}"] for bits in (16, 32, 64)},
    **{f"s{bits}": NumberFormat[f"I{bits}"] for bits in (8, 16, 32, 64)},
    **{"f32": NumberFormat.F32, "f64": NumberFormat.F64},
    **{"bcd16": NumberFormat.BCD16, "bcd32": NumberFormat.BCD32},
}
DETAILS = {  # of a quantity, in the words of the table that is printed
    "offset": "offset",
    "invalid": "invalid counts",
    "part": "bits of a word",
    "64 bit": "numbers of 64 bit",
    "order": "order of bytes or words",
    "bcd": "BCD",
    "s8": "signed 8 bit",
    "negative step": "negative step",
    "text": "text",
    "one character": "text of one character a register",
    "by 16": "written by 16 alone",
    "float written": "float that is written",
    "elsewhere": "written at another address",
}


@dataclass(frozen=True)
class Quantity:
    """One entry of a template. `format` is a key of FORMATS, "text", or what the template calls it."""

    name: str
    table: str
    address: int
    format: str = "u16"
    order: str = "ABCD"
    step: float = 1.0
    offset: float = 0.0
    invalid: tuple[float, ...] = ()
    part: tuple[int, int] | None = None
    length: int = 0  # of a text, in registers
    is_read: bool = True
    is_written: bool = False
    write_address: int | None = None
    lacks: str = ""  # what no register can hold, as the reader of the template knows already
    besides: tuple[str, ...] = ()  # what the entry says and no register does, though it holds the value


@dataclass
class Template:
    """One device of a file; `besides` is what it says of the device that a family does not."""

    path: str
    quantities: list[Quantity] = field(default_factory=list)
    besides: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Holding:
    """The answer for one quantity: it is held, only for reading, or not at all and why."""

    quantity: Quantity
    is_held: bool
    is_written: bool = True  # where the template writes it
    lacks: str = ""


def details(quantity: Quantity) -> Iterator[str]:
    """Yield the keys of DETAILS that a quantity needs beyond 16 and 32 bits with a step."""
    is_number = quantity.table not in ("coil", "discrete")
    needed = {
        "offset": quantity.offset != 0,
        "invalid": bool(quantity.invalid),
        "part": quantity.part is not None,
        "64 bit": quantity.format in ("u64", "s64", "f64"),
        "order": quantity.order != "ABCD" and quantity.format != "text",
        "bcd": quantity.format.startswith("bcd"),
        "s8": quantity.format == "s8",
        "negative step": quantity.step < 0,
        "text": quantity.format == "text",
        "one character": quantity.format == "text" and quantity.order == "B",
        "by 16": quantity.table == "holding by 16" and quantity.is_written,
        "float written": quantity.format in ("f32", "f64") and quantity.is_written,
        "elsewhere": quantity.write_address is not None,
    }
    yield from (key for key, is_needed in needed.items() if is_needed and is_number)


def hold(quantity: Quantity) -> Holding:
    """Declare the quantity in a class of its own, as written where the template writes it, else as read."""
    if quantity.lacks:
        return Holding(quantity, is_held=False, lacks=quantity.lacks)
    reason = _refused(quantity, is_written=quantity.is_written)
    if not reason:
        return Holding(quantity, is_held=True)
    if quantity.is_read and quantity.is_written and not _refused(quantity, is_written=False):
        return Holding(quantity, is_held=True, is_written=False, lacks=reason)
    return Holding(quantity, is_held=False, lacks=reason)


def family_of(quantities: list[Quantity]) -> str:
    """Declare all of these in one class; return why that is refused, or nothing."""
    members = {
        f"quantity_{number}": _declared(quantity, is_written=quantity.is_written)
        for number, quantity in enumerate(quantities)
    }
    return _made(members)


def _refused(quantity: Quantity, *, is_written: bool) -> str:
    """Return why the library refuses the declaration, or nothing."""
    try:
        member = _declared(quantity, is_written=is_written)
    except (ValueError, KeyError, TypeError) as refusal:
        return _reason(refusal)
    return _made({"quantity": member})


def _made(members: Mapping[str, object]) -> str:
    try:
        type("Device", (Drive,), dict(members))
    except ValueError as refusal:
        return _reason(refusal)
    return ""


def _reason(refusal: Exception) -> str:
    """Return a refusal without the name of its entry, so that equal ones are counted together."""
    if isinstance(refusal, KeyError):
        return f"unknown format or table {refusal}"
    sentence = str(refusal).partition("\n")[0]
    return sentence.partition(": ")[2] if sentence.startswith("Device.") else sentence


def _declared(quantity: Quantity, *, is_written: bool) -> object:
    table = TABLES[quantity.table]
    if quantity.format == "text":
        order = {"ABCD": "AB", "BADC": "BA"}.get(quantity.order, quantity.order)
        return text(quantity.address, quantity.length, table=table, order=order)
    given: dict[str, Any] = {"table": table}
    declare = reading if not is_written else setting if quantity.is_read else command
    if table in (COIL, DISCRETE):
        return declare(quantity.address, "", **given)
    given |= {"number_format": FORMATS[quantity.format], "step": quantity.step, "offset": quantity.offset}
    if quantity.order != "ABCD":
        given["order"] = quantity.order
    if quantity.invalid:
        given["invalid"] = tuple(count for count in quantity.invalid if _fits(count, quantity.format))
    if quantity.part is not None:
        given["part"] = quantity.part
    if is_written and quantity.write_address is not None:
        given["ram_address"] = quantity.write_address
    return declare(quantity.address, "", **given)


def _fits(count: float, format: str) -> bool:
    """Return True where a count means anything in this format: templates name 0x7FFF for floats too."""
    return not math.isnan(count) or format in ("f32", "f64")
