"""Look up the verbs of a drive by name, and convert their options from JSON values."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from sys import float_info
from typing import Any

from multidrop.drive.family import Drive
from multidrop.drive.state import Direction
from multidrop.printable import is_number


def _direction(value: object) -> Direction:
    try:
        return Direction(value)
    except ValueError:
        raise ValueError(f"direction = {value!r} is neither forward nor reverse") from None


def _hertz(value: object) -> float:
    if not is_number(value) or not abs(value) <= float_info.max:
        raise ValueError(f"hz = {value!r} is not a number")
    return float(value)


_OPTIONS: Mapping[str, Mapping[str, Callable[[object], Any]]] = {
    "start": {"direction": _direction},
    "jog": {"direction": _direction},
    "reset_fault": {},
    "set_frequency": {"hz": _hertz},
    "coast": {},  # not part of "stop", because coasting lets a hoist drop its load
    "emergency_stop": {},
    "stop": {},
}
LISTED_VERBS = tuple(name for name in _OPTIONS if name != "stop")  # verbs that a plant's list `may` can allow


def verbs_of(drive: Drive) -> list[str]:
    """Return the names of the verbs that command this drive."""
    return [name for name in _OPTIONS if getattr(type(drive), name) is not getattr(Drive, name)]


def verb_arguments(verb: str, options: Mapping[str, object]) -> dict[str, Any]:
    """Convert options with JSON values into the keyword arguments of a verb.

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
