"""The core's field of a register: where it lies in a reply, and how a row's number is made of it."""

from __future__ import annotations

from typing import Any

from multidrop.core import Extra, Field
from multidrop.drive.register import Register


def row_field(register: Register[Any], at: int, code: int) -> Field:
    """Return the field of a register at word (coils: bit) `at` of a reply; `code` is that of its name."""
    multiplier, _, divisor = register.coding.factors
    return Field(at, register.coding.core_format, code, multiplier, divisor, _extra(register, at))


def _extra(register: Register[Any], at: int) -> Extra | None:
    coding, power = register.coding, register.scaled_by
    if not (register.offset or register.part or coding.invalid_patterns or power):
        return None
    low, high = register.part or (0, -1)
    return Extra(
        addend=coding.factors[1],
        low=low,
        bits=high - low + 1,
        scale_at=at + power.address - register.address if power else None,
        scale_format=power.coding.core_format if power else 0,
        invalid=coding.invalid_patterns,
        scale_invalid=power.coding.invalid_patterns if power else (),
    )
