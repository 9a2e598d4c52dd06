"""Number formats: encode and decode the numbers in 16-bit registers.

The C core decodes by the same rules.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property

from multidrop.core import LOW_BYTE_FIRST, LOW_WORD_FIRST
from multidrop.core import NumberFormat as NumberFormat

WORDS = {  # number of 16-bit words of each format
    NumberFormat.U16: 1,
    NumberFormat.I16: 1,
    NumberFormat.I8: 1,
    NumberFormat.BCD16: 1,
    NumberFormat.F16: 1,
    NumberFormat.U32: 2,
    NumberFormat.I32: 2,
    NumberFormat.U32_EITHER: 2,
    NumberFormat.F32: 2,
    NumberFormat.BCD32: 2,
    NumberFormat.U64: 4,
    NumberFormat.I64: 4,
    NumberFormat.F64: 4,
}
FLOATS = {NumberFormat.F16: ">e", NumberFormat.F32: ">f", NumberFormat.F64: ">d"}
# float formats whose values a float64 always holds exactly
SHORT_FLOATS = frozenset({NumberFormat.F16, NumberFormat.F32})
# whole-number formats with values that a float64 cannot hold exactly
WHOLE = frozenset({NumberFormat.U64, NumberFormat.I64})
# The order of a number's bytes on the wire, for one, two and four words; A is the most significant byte.
ORDERS = {
    "AB": 0,
    "BA": LOW_BYTE_FIRST,
    "ABCD": 0,
    "CDAB": LOW_WORD_FIRST,
    "BADC": LOW_BYTE_FIRST,
    "DCBA": LOW_WORD_FIRST | LOW_BYTE_FIRST,
}
MOST_DIGITS = 9  # number of decimal digits that distinguishes any two float32 values
SIGNED = frozenset({NumberFormat.I8, NumberFormat.I16, NumberFormat.I32, NumberFormat.I64})
DECIMAL = frozenset({NumberFormat.BCD16, NumberFormat.BCD32})
_LARGEST = {
    NumberFormat.F16: 65504.0,
    NumberFormat.F32: float.fromhex("0x1.fffffep127"),
    NumberFormat.F64: float.fromhex("0x1.fffffffffffffp1023"),
}


def width(number_format: NumberFormat) -> int:
    """Return the number of bits in this format."""
    if number_format in (NumberFormat.BIT, NumberFormat.I8):
        return 1 if number_format is NumberFormat.BIT else 8
    return 16 * WORDS[number_format]


def raw_span(number_format: NumberFormat) -> tuple[Fraction, Fraction]:
    """Return the smallest and the largest raw count of a format."""
    if number_format in FLOATS:
        return Fraction(-_LARGEST[number_format]), Fraction(_LARGEST[number_format])
    bits = width(number_format)
    if number_format in DECIMAL:
        return Fraction(0), Fraction(10 ** (bits // 4) - 1)
    least = -(1 << bits - 1) if number_format in SIGNED else 0
    return Fraction(least), Fraction(least + (1 << bits) - 1)


# ---- bytes, bits and numbers ----


def arranged(data: bytes, order: str) -> bytes:
    """Convert a number's bytes from wire order to most significant first, or back."""
    flags = ORDERS[order]
    words = [data[at : at + 2] for at in range(0, len(data), 2)]
    if flags & LOW_BYTE_FIRST:
        words = [word[::-1] for word in words]
    return b"".join(reversed(words) if flags & LOW_WORD_FIRST else words)


def bits_in(data: bytes, at: int, number_format: NumberFormat, order: str) -> int | None:
    """Return the bits of the number at word `at` of a reply's data; None if the data is too short.

    In the format BIT, `at` counts bits instead of words.
    """
    if number_format is NumberFormat.BIT:
        return data[at // 8] >> at % 8 & 1 if at // 8 < len(data) else None
    size = 2 * WORDS[number_format]
    found = data[2 * at : 2 * at + size] if at >= 0 else b""
    return int.from_bytes(arranged(found, order)) if len(found) == size else None


def number_of(bits: int, number_format: NumberFormat) -> float | None:
    """Return the number that these bits encode; None for NaN and invalid BCD digits."""
    if number_format in FLOATS:
        (number,) = struct.unpack(FLOATS[number_format], bits.to_bytes(2 * WORDS[number_format]))
        return None if math.isnan(number) else float(number)
    if number_format in DECIMAL:
        digits = f"{bits:x}"
        return int(digits) if digits.isdecimal() else None
    if number_format is NumberFormat.U32_EITHER:
        return (bits >> 16 | bits) & 0xFFFF
    if number_format in SIGNED:
        return signed(bits, width(number_format))
    return bits


def signed(bits: int, count: int) -> int:
    """Return the two's complement number in the lowest `count` bits."""
    sign = 1 << count - 1
    return ((bits & (2 * sign - 1)) ^ sign) - sign


def bits_of(number: float, number_format: NumberFormat) -> int:
    """Return the bits that encode this number. Bits or BCD digits that do not fit are dropped."""
    if number_format in FLOATS:
        number = nearest_or_infinite(number, number_format)
        return int.from_bytes(struct.pack(FLOATS[number_format], number))
    bits = width(number_format)
    if number_format in DECIMAL:
        return int(str(int(number) % 10 ** (bits // 4)), 16)
    return int(number) & ((1 << bits) - 1)


# ---- floats ----


def nearest(value: float | Fraction, number_format: NumberFormat) -> float:
    """Return the nearest float of this format. Raises OverflowError if `value` is beyond the largest one."""
    code = FLOATS[number_format]
    (found,) = struct.unpack(code, struct.pack(code, value))
    return float(found)


def nearest_or_infinite(value: float, number_format: NumberFormat) -> float:
    """Return the nearest float of this format, or an infinity beyond the largest."""
    try:
        return nearest(value, number_format)
    except OverflowError:
        return math.copysign(math.inf, value)


def shortest(value: float, scale: Fraction, number_format: NumberFormat) -> str:
    """Return the shortest decimal number that the drive stores as the same F16 or F32 as `value`.

    The stored number is the value divided by `scale`.
    """
    if not math.isfinite(value):
        return str(value)
    held = nearest_or_infinite(value / scale, number_format)
    if math.isfinite(held):
        value = held * scale.numerator / scale.denominator
    for digits in range(1, MOST_DIGITS):
        found = float(f"{value:.{digits}g}")
        if nearest_or_infinite(found / scale, number_format) == held:
            break
    else:
        found = float(f"{value:.{MOST_DIGITS}g}")
    return repr(found + 0.0).removesuffix(".0")


MOST_POWER = 22  # 10 ** 22 is the largest power of ten that a float64 holds exactly


@dataclass(frozen=True)
class Coding:
    """The encoding of a register: number format, byte order, bit range, invalid counts, exact scale."""

    number_format: NumberFormat
    order: str = "ABCD"
    part: tuple[int, int] | None = None
    invalid: tuple[float, ...] = ()
    step: Fraction = Fraction(1)
    offset: Fraction = Fraction(0)

    @cached_property
    def core_format(self) -> int:
        """The number format and byte order as one number, as the C core expects it."""
        return self.number_format + (0 if self.number_format is NumberFormat.BIT else ORDERS[self.order])

    @property
    def wire_order(self) -> str:
        """The order of the number's bytes on the wire, A the most significant, such as "BA" or "CDAB"."""
        return arranged(b"ABCDEFGH"[: 2 * WORDS[self.number_format]], self.order).decode()

    @cached_property
    def factors(self) -> tuple[int, int, int]:
        """Multiplier, addend and divisor: the value is exactly (raw * multiplier + addend) / divisor."""
        divisor = math.lcm(self.step.denominator, self.offset.denominator)
        return int(self.step * divisor), int(self.offset * divisor), divisor

    @cached_property
    def raw_span(self) -> tuple[Fraction, Fraction]:
        """The smallest and the largest raw count."""
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
        """A mask of the number's bits that belong to the register's `part`; all bits if it has no `part`."""
        return ((1 << self._part_width) - 1) << (self.part[0] if self.part else 0)

    @cached_property
    def invalid_patterns(self) -> tuple[tuple[int, int], ...]:
        """Pairs of mask and bit pattern: one pair for each raw count that means "no value", except NaN.

        The mask selects the bits of `part` if the raw count fits into them, otherwise all bits. A raw count
        outside the format's range is taken as a bit pattern, such as 8000H for an I16.
        """
        return tuple(self._pattern(count) for count in self.invalid if count == count)

    def _pattern(self, count: float) -> tuple[int, int]:
        whole = (1 << width(self.number_format)) - 1
        if self.number_format in FLOATS:
            mask = whole >> 1 if count == 0 else whole  # +0.0 and -0.0 are the same count
            return mask, bits_of(count, self.number_format) & mask
        if self.part and self.raw_span[0] <= count < 1 << self._part_width:
            return self.mask, int(count) << self.part[0] & self.mask
        low, high = raw_span(self.number_format)
        bits = bits_of(count, self.number_format) if low <= count <= high else int(count)
        return whole, bits & whole

    # ---- reading ----

    def raw_in(self, data: bytes, at: int) -> float | None:
        """Return the raw count at word `at` of a reply's data, or at bit `at` in the format BIT.

        Return None if the count is invalid or missing.
        """
        bits = bits_in(data, at, self.number_format, self.order)
        return None if bits is None else self.raw_of(bits)

    def raw_of(self, bits: int) -> float | None:
        """Return the raw count of a number that was read, given its bits; None if it means "no value"."""
        if any(bits & mask == pattern for mask, pattern in self.invalid_patterns):
            return None
        if self.part is None:
            return number_of(bits, self.number_format)
        found = (bits & self.mask) >> self.part[0]
        return signed(found, self._part_width) if self.number_format in SIGNED else found

    def value_of(self, raw: float, power: int = 0) -> float:
        """Return the value of a raw count, times 10 to the `power`.

        A whole 64-bit number is an int, because a float would not hold it exactly.
        """
        multiplier, addend, divisor = self.factors
        multiplier *= int(10 ** max(power, 0))
        divisor *= int(10 ** max(-power, 0))
        if divisor == 1 and self.number_format in WHOLE and isinstance(raw, int):
            return raw * multiplier + addend
        return (raw * multiplier + addend) / divisor + 0.0  # never -0.0

    # ---- writing ----

    def count_of(self, value: float) -> float:
        """Return the raw count nearest to a value; in a float format, the nearest float of its width.

        Raises OverflowError if the raw count is beyond the format's largest float.
        """
        count = self.exact_count(value)
        return nearest(count, self.number_format) if self.number_format in FLOATS else round(count)

    def exact_count(self, value: float) -> Fraction:
        """Return the exact raw count of a value.

        If the exact binary value of a float gives a whole raw count, this count is returned. Otherwise the
        float stands for its shortest decimal: 0.3 is 3/10. For large 64-bit numbers that may be inexact.
        """
        count = (Fraction(value) - self.offset) / self.step
        return count if count.denominator == 1 else (Fraction(str(value)) - self.offset) / self.step

    def pack(self, raw: float) -> bytes:
        """Return the bytes of a raw count in wire order."""
        bits = int(raw) & 0xFFFF if self.number_format is NumberFormat.I8 else None
        whole = bits_of(raw, self.number_format) if bits is None else bits
        return arranged(whole.to_bytes(2 * WORDS[self.number_format]), self.order)
