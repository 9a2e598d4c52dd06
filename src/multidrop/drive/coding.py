"""Coding: how a device writes a quantity in its words. The core decodes them by the same rules."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property

from multidrop.core import NumberFormat
from multidrop.drive.number_format import (
    FLOATS,
    ORDERS,
    SIGNED,
    WHOLE,
    WORDS,
    arranged,
    bits_in,
    bits_of,
    nearest,
    number_of,
    raw_span,
    signed,
    width,
)

MOST_POWER = 22  # of ten that a float64 holds exactly


@dataclass(frozen=True)
class Coding:
    """Number format, order of bytes, part of the number, raw counts that mean no value, and exact scale."""

    number_format: NumberFormat
    order: str = "ABCD"
    part: tuple[int, int] | None = None
    invalid: tuple[float, ...] = ()
    step: Fraction = Fraction(1)
    offset: Fraction = Fraction(0)

    @cached_property
    def core_format(self) -> int:
        """The number format with its order, for the core."""
        return self.number_format + (0 if self.number_format is NumberFormat.BIT else ORDERS[self.order])

    @cached_property
    def factors(self) -> tuple[int, int, int]:
        """Multiplier, addend and divisor: the value is exactly (raw * multiplier + addend) / divisor."""
        divisor = math.lcm(self.step.denominator, self.offset.denominator)
        return int(self.step * divisor), int(self.offset * divisor), divisor

    @cached_property
    def raw_span(self) -> tuple[Fraction, Fraction]:
        """The least and the greatest raw count."""
        if self.part is None:
            return raw_span(self.number_format)
        bits = self._part_width
        least = -(1 << bits - 1) if self.number_format in SIGNED else 0
        return Fraction(least), Fraction(least + (1 << bits) - 1)

    @property
    def _part_width(self) -> int:
        low, high = self.part or (0, width(self.number_format) - 1)
        return high - low + 1

    @cached_property
    def mask(self) -> int:
        """Bits of the words that belong to the number."""
        return ((1 << self._part_width) - 1) << (self.part[0] if self.part else 0)

    @cached_property
    def invalid_patterns(self) -> tuple[tuple[int, int], ...]:
        """Mask and pattern of the bits of each invalid count; a NaN is never a value.

        A count that fits into the part is compared with the part, a larger one with the whole number. A count
        outside the format's span names the bits themselves, such as 8000H of a signed number.
        """
        return tuple(self._pattern(count) for count in self.invalid if count == count)

    def _pattern(self, count: float) -> tuple[int, int]:
        whole = (1 << width(self.number_format)) - 1
        if self.number_format in FLOATS:
            mask = whole >> 1 if count == 0 else whole  # a zero has no sign
            return mask, bits_of(count, self.number_format) & mask
        if self.part and self.raw_span[0] <= count < 1 << self._part_width:
            return self.mask, int(count) << self.part[0] & self.mask
        low, high = raw_span(self.number_format)
        bits = bits_of(count, self.number_format) if low <= count <= high else int(count)
        return whole, bits & whole

    # ---- reading ----

    def raw_in(self, data: bytes, at: int) -> float | None:
        """Return the raw count at word (BIT: bit) `at` of a reply's data; None where there is no value."""
        bits = bits_in(data, at, self.number_format, self.order)
        return None if bits is None else self.raw_of(bits)

    def raw_of(self, bits: int) -> float | None:
        """Return the raw count of a number's bits; None where they mean no value."""
        if any(bits & mask == pattern for mask, pattern in self.invalid_patterns):
            return None
        if self.part is None:
            return number_of(bits, self.number_format)
        found = (bits & self.mask) >> self.part[0]
        return signed(found, self._part_width) if self.number_format in SIGNED else found

    def value_of(self, raw: float, power: int = 0) -> float:
        """Return the value of a raw count, times a power of ten.

        A 64-bit number without a fraction is an int, as a float would not hold it exactly.
        """
        multiplier, addend, divisor = self.factors
        multiplier *= int(10 ** max(power, 0))
        divisor *= int(10 ** max(-power, 0))
        if divisor == 1 and self.number_format in WHOLE and isinstance(raw, int):
            return raw * multiplier + addend
        return (raw * multiplier + addend) / divisor + 0.0  # never -0.0

    # ---- writing ----

    def count_of(self, value: float) -> float:
        """Return the nearest raw count; in a float format, the nearest float of its size.

        Raises OverflowError beyond the largest float.
        """
        count = self.exact_count(value)
        return nearest(count, self.number_format) if self.number_format in FLOATS else round(count)

    def exact_count(self, value: float) -> Fraction:
        """Return the raw count that the value would need.

        A float stands for the shortest decimal that reads back as it: 0.3 is three tenths. But a float that
        is a whole count itself, as those of 64 bits may be, is taken exactly.
        """
        count = (Fraction(value) - self.offset) / self.step
        return count if count.denominator == 1 else (Fraction(str(value)) - self.offset) / self.step

    def pack(self, raw: float) -> bytes:
        """Return the words that hold a raw count, as they go over the wire."""
        bits = int(raw) & 0xFFFF if self.number_format is NumberFormat.I8 else None
        whole = bits_of(raw, self.number_format) if bits is None else bits
        return arranged(whole.to_bytes(2 * WORDS[self.number_format]), self.order)
