"""Numbers in texts of people and programs: decimal digits of ASCII alone.

Python's int() and float() take `1_0` for 10, and digits of all scripts.
"""

from __future__ import annotations

import re

_WHOLE = re.compile(r"[+-]?[0-9]+")
_NUMBER = re.compile(
    r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?|[+-]?(nan|inf)", re.IGNORECASE | re.ASCII
)


def plain_whole(text: str) -> int:
    """Return a whole number. Raises ValueError for any other text."""
    if not _WHOLE.fullmatch(text.strip(" ")):
        raise ValueError(f"{text!r} is no whole number in decimal digits, such as 10")
    return int(text)


def plain_number(text: str) -> float:
    """Return a number with a point, or nan or inf. Raises ValueError for any other text."""
    if not _NUMBER.fullmatch(text.strip(" ")):
        raise ValueError(f"{text!r} is no number in decimal digits, such as 42.5")
    return float(text)
