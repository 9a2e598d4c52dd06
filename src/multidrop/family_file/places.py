"""Places in a family's file, and the kinds of values that TOML has there."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from multidrop.toml_check import TomlPlace


def under(place: TomlPlace, label: str) -> TomlPlace:
    """Return the place within this one that has this label."""
    return replace(place, labels=(*place.labels, label))


def number(value: Any) -> bool:
    """Return True for a finite number."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def whole(value: Any) -> bool:
    """Return True for a whole number."""
    return isinstance(value, int) and not isinstance(value, bool)


def sentence(value: Any) -> bool:
    """Return True for a text that fits into a sentence of an error."""
    return isinstance(value, str) and bool(value.strip()) and value.isprintable() and len(value) <= 200
