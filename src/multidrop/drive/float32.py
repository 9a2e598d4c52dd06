"""Single-precision numbers (IEEE 754 binary32): the nearest one, and the shortest text that means it."""

from __future__ import annotations

import math
import struct
from fractions import Fraction

MOST_DIGITS = 9  # enough to tell any two of them apart


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
