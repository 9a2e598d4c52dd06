"""Check what a declaration says of a register's number: order, part, invalid counts, counts to be written."""

from __future__ import annotations

from collections.abc import Iterator
from enum import IntFlag
from fractions import Fraction
from typing import Any

from multidrop.core import NumberFormat
from multidrop.drive.number_format import FLOATS, WORDS, width
from multidrop.drive.register import Access, Register
from multidrop.drive.table import Carrier

_PARTED = frozenset(
    {
        *(NumberFormat.U16, NumberFormat.U32, NumberFormat.U64),
        *(NumberFormat.I16, NumberFormat.I32, NumberFormat.I64),
    }
)


def number_errors(register: Register[Any]) -> Iterator[str]:
    """Yield a sentence for each error; number format and table fit each other already."""
    yield from _written(register)
    if register.table.carrier is not Carrier.WORD:
        yield from _only_words(register)
        return
    yield from _order(register)
    yield from _part(register)
    yield from _invalid(register)
    yield from _named(register)
    if register.number_format is NumberFormat.I8 and register.access is not Access.READING:
        yield "number_format = I8 is one byte of a word, whose other byte is not known: it is never written"


def _only_words(register: Register[Any]) -> Iterator[str]:
    for name, common in (("part", None), ("invalid", ()), ("order", "ABCD"), ("scale_register", "")):
        if getattr(register, name) != common:
            yield f"{name} is for numbers in words, and a {register.table.name} holds none"


def _order(register: Register[Any]) -> Iterator[str]:
    if register.order == "BA" and WORDS[register.number_format] > 1:
        words = WORDS[register.number_format]
        yield f"order = 'BA' is for one word, and this has {words}: CDAB, BADC or DCBA"
    if register.order != "ABCD" and register.number_format is NumberFormat.U32_EITHER:
        yield "number_format = U32_EITHER leaves the order of its words open: it has no order"


def _part(register: Register[Any]) -> Iterator[str]:
    if register.part is None:
        return
    if register.number_format not in _PARTED:
        yield f"part is for whole numbers, not for number_format = {register.number_format.name}"
    elif register.part[1] >= width(register.number_format):
        bits = width(register.number_format)
        yield f"its part ends at bit {register.part[1]}, and its number has bits 0 to {bits - 1}"
    if register.access is not Access.READING:
        yield "a part is never written, as the other bits of its word would be too: declare a reading"


def _named(register: Register[Any]) -> Iterator[str]:
    """Find names of counts that the register cannot hold: who looks for that fault would never see it."""
    if register.values is None or (register.part is not None and register.number_format not in _PARTED):
        return
    flags = _is_flags(register)
    least, most = _counts(register)
    for member in register.values:
        if least <= member.value <= most:
            continue
        if flags and member.value > 0 and member.value.bit_count() == 1:
            last = register.coding.mask.bit_count() - 1
            yield f"{member.name} is bit {member.value.bit_length() - 1}, and its number has bits 0 to {last}"
        else:
            yield f"{member.name} = {member.value} is not within {least} to {most}, which its number can be"


def _is_flags(register: Register[Any]) -> bool:
    return register.values is not None and issubclass(register.values, IntFlag)


def _counts(register: Register[Any]) -> tuple[Fraction, Fraction]:
    """Return the least and the greatest count; flags have no sign."""
    if _is_flags(register):  # also in a signed format, whose highest bit may have a name
        return Fraction(0), Fraction((1 << register.coding.mask.bit_count()) - 1)
    return register.coding.raw_span


def _written(register: Register[Any]) -> Iterator[str]:
    """Find counts that no write can send: they would allow or forbid something else."""
    least, most = _counts(register)
    for key in ("harmless", "broadcast"):
        for count in getattr(register, key) or ():
            if not least <= count <= most:
                yield f"{key} = {count} is not within {least} to {most}, which its number can be"
    for mask in register.never_together:
        if not _is_flags(register):
            yield f"never_together = {mask:04X}H forbids nothing: only bits with names are checked; name them"
        elif not 0 < mask <= most:
            yield f"never_together = {mask:X}H is no mask of its bits"
    if register.default is not None and register.values is None:
        try:
            register.encode(register.default)
        except ValueError as mistake:
            yield f"its default cannot be: {mistake}"


def _invalid(register: Register[Any]) -> Iterator[str]:
    if register.invalid and register.number_format is NumberFormat.U32_EITHER:
        yield "number_format = U32_EITHER leaves its words open: no count of it can be told to be invalid"
        return
    if register.number_format in FLOATS:
        return
    bits = width(register.number_format)
    for count in register.invalid:
        if count != count:
            yield "invalid = nan is for floats, and this is a whole number"
        elif not -(1 << bits - 1) <= count < 1 << bits or count != int(count):
            yield f"invalid = {count:g} is no count of {bits} bits"
