"""Number formats: the numbers that fit them, and arithmetic with float32 (IEEE 754 binary32)."""

from __future__ import annotations

import math
import struct
from fractions import Fraction

from multidrop.core import NumberFormat

FLOATS = (NumberFormat.F32, NumberFormat.F32_SWAPPED)
LONGS = frozenset(NumberFormat) - {NumberFormat.BIT, NumberFormat.U16, NumberFormat.I16}  # of two words
MOST_DIGITS = 9  # enough to tell any two float32 apart
_SIGNED = (NumberFormat.I16, NumberFormat.I32, NumberFormat.I32_SWAPPED)
_LARGEST_FLOAT = float.fromhex("0x1.fffffep127")


def raw_span(number_format: NumberFormat) -> tuple[Fraction, Fraction]:
    """Return the least and the greatest raw count of a format."""
    if number_format in FLOATS:
        return Fraction(-_LARGEST_FLOAT), Fraction(_LARGEST_FLOAT)
    bits = 1 if number_format is NumberFormat.BIT else 32 if number_format in LONGS else 16
    least = -(1 << bits - 1) if number_format in _SIGNED else 0
    return Fraction(least), Fraction(least + (1 << bits) - 1)


def nearest(value: float | Fraction) -> float:
    """Return the nearest float32; raises OverflowError beyond the largest."""
    (found,) = struct.unpack(">f", struct.pack(">f", value))
    return float(found)


def nearest_or_infinite(value: float) -> float:
    """Return the nearest float32, or an infinity beyond the largest."""
    try:
        return nearest(value)
    except OverflowError:
        return math.copysign(math.inf, value)


def shortest(value: float, scale: Fraction) -> str:
    """Return the shortest decimal that means the float32 nearest to `value`, in units of `scale`."""
    if not math.isfinite(value):
        return str(value)
    held = nearest_or_infinite(value / scale)
    if math.isfinite(held):
        value = held * scale.numerator / scale.denominator
    for digits in range(1, MOST_DIGITS):
        found = float(f"{value:.{digits}g}")
        if nearest_or_infinite(found / scale) == held:
            break
    else:
        found = float(f"{value:.{MOST_DIGITS}g}")
    return repr(found + 0.0).removesuffix(".0")
