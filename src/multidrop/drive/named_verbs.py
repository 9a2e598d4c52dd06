"""Look up the verbs of a drive by name, and convert their options from JSON values."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import isfinite
from typing import Any

from multidrop.drive.family import Drive
from multidrop.drive.state import Direction


def _direction(value: object) -> Direction:
    try:
        return Direction(value)
    except ValueError:
        raise ValueError(f"direction = {value!r} is neither forward nor reverse") from None


def _hertz(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not _is_finite(value):
        raise ValueError(f"hz = {value!r} is not a number")
    return float(value)


def _is_finite(value: float) -> bool:
    try:
        return isfinite(value)
    except OverflowError:  # an int too large for a float
        return False


_OPTIONS: Mapping[str, Mapping[str, Callable[[object], Any]]] = {
    "start": {"direction": _direction},
    "jog": {"direction": _direction},
    "reset_fault": {},
    "set_frequency": {"hz": _hertz},
    "coast": {},  # a hoist drops its load
    "emergency_stop": {},
    "stop": {},
}


def verbs_of(drive: Drive) -> list[str]:
    """Return the names of the drive's verbs that command it."""
    return [name for name in _OPTIONS if getattr(type(drive), name) is not getattr(Drive, name)]


def verb_arguments(verb: str, options: Mapping[str, object]) -> dict[str, Any]:
    """Return a verb's arguments for these options.

    `{"direction": "reverse"}` becomes Direction.REVERSE; `hz` is in Hz. An option that is None is omitted.
    Raises ValueError for an unknown, missing or invalid option, KeyError for an unknown verb.
    """
    takes = _OPTIONS[verb]
    for name in options:
        if name not in takes:
            raise ValueError(f"{verb} has no option {name!r}; it has {', '.join(takes) or 'none'}")
    if "hz" in takes and options.get("hz") is None:
        raise ValueError(f"{verb} needs a frequency: hz = 20.0")
    return {name: takes[name](value) for name, value in options.items() if value is not None}
