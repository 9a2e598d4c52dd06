"""Places in a family's file, and the kinds of values that TOML has there."""

from __future__ import annotations

import math
from typing import Any


def number(value: Any) -> bool:
    """Return True for a finite number."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def whole(value: Any) -> bool:
    """Return True for a whole number."""
    return isinstance(value, int) and not isinstance(value, bool)


def sentence(value: Any) -> bool:
    """Return True for a text that fits into a sentence of an error."""
    return isinstance(value, str) and bool(value.strip()) and value.isprintable() and len(value) <= 200
