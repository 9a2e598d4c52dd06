"""Number formats: their width, order and span, and how their bits become numbers and back."""

from __future__ import annotations

import math
import struct
from fractions import Fraction

from multidrop.core import LOW_BYTE_FIRST, LOW_WORD_FIRST
from multidrop.core import NumberFormat as NumberFormat

WORDS = {  # of 16 bits
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
SHORT_FLOATS = frozenset({NumberFormat.F16, NumberFormat.F32})  # a float64 holds each exactly
WHOLE = frozenset({NumberFormat.U64, NumberFormat.I64})  # numbers that a float does not hold exactly
# The bytes as they come on the wire, A the most significant; in a single word only their swap counts.
ORDERS = {
    "AB": 0,
    "BA": LOW_BYTE_FIRST,
    "ABCD": 0,
    "CDAB": LOW_WORD_FIRST,
    "BADC": LOW_BYTE_FIRST,
    "DCBA": LOW_WORD_FIRST | LOW_BYTE_FIRST,
}
MOST_DIGITS = 9  # enough to tell any two float32 apart
SIGNED = frozenset({NumberFormat.I8, NumberFormat.I16, NumberFormat.I32, NumberFormat.I64})
DECIMAL = frozenset({NumberFormat.BCD16, NumberFormat.BCD32})
_LARGEST = {
    NumberFormat.F16: 65504.0,
    NumberFormat.F32: float.fromhex("0x1.fffffep127"),
    NumberFormat.F64: float.fromhex("0x1.fffffffffffffp1023"),
}


def width(number_format: NumberFormat) -> int:
    """Return the bits of a number."""
    if number_format in (NumberFormat.BIT, NumberFormat.I8):
        return 1 if number_format is NumberFormat.BIT else 8
    return 16 * WORDS[number_format]


def raw_span(number_format: NumberFormat) -> tuple[Fraction, Fraction]:
    """Return the least and the greatest raw count of a format."""
    if number_format in FLOATS:
        return Fraction(-_LARGEST[number_format]), Fraction(_LARGEST[number_format])
    bits = width(number_format)
    if number_format in DECIMAL:
        return Fraction(0), Fraction(10 ** (bits // 4) - 1)
    least = -(1 << bits - 1) if number_format in SIGNED else 0
    return Fraction(least), Fraction(least + (1 << bits) - 1)


# ---- bytes, bits and numbers ----


def arranged(data: bytes, order: str) -> bytes:
    """Return the bytes of a number from the wire with the most significant first, or the other way round."""
    flags = ORDERS[order]
    words = [data[at : at + 2] for at in range(0, len(data), 2)]
    if flags & LOW_BYTE_FIRST:
        words = [word[::-1] for word in words]
    return b"".join(reversed(words) if flags & LOW_WORD_FIRST else words)


def bits_in(data: bytes, at: int, number_format: NumberFormat, order: str) -> int | None:
    """Return the bits of the number at word (BIT: bit) `at` of a reply's data; None where it ends before."""
    if number_format is NumberFormat.BIT:
        return data[at // 8] >> at % 8 & 1 if at // 8 < len(data) else None
    size = 2 * WORDS[number_format]
    found = data[2 * at : 2 * at + size] if at >= 0 else b""
    return int.from_bytes(arranged(found, order)) if len(found) == size else None


def number_of(bits: int, number_format: NumberFormat) -> float | None:
    """Return the number that these bits mean; None where they mean none."""
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
    """Return the bits of this number; a whole number loses those that do not fit."""
    if number_format in FLOATS:
        number = nearest_or_infinite(number, number_format)
        return int.from_bytes(struct.pack(FLOATS[number_format], number))
    bits = width(number_format)
    if number_format in DECIMAL:
        return int(str(int(number) % 10 ** (bits // 4)), 16)
    return int(number) & ((1 << bits) - 1)


# ---- floats ----


def nearest(value: float | Fraction, number_format: NumberFormat) -> float:
    """Return the nearest float of this format. Raises OverflowError beyond the largest."""
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
    """Return the shortest decimal that means the F16 or F32 nearest to `value`, in units of `scale`."""
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
