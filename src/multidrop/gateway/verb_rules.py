"""Verbs that a gateway carries out: the rights that each needs, and its options."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from multidrop import Direction, Drive
from multidrop.gateway.rights import Right


class VerbRule(NamedTuple):
    """The rights that a verb needs, and its options."""

    role: Right
    is_listed: bool  # it must stand in [serve.may] verbs
    options: Mapping[str, Callable[[object], Any]]

    def arguments(self, verb: str, options: Mapping[str, object]) -> dict[str, Any]:
        """Return the verb's arguments. Raises ValueError for an option that it has not, or that it lacks."""
        for name in options:
            if name not in self.options:
                known = ", ".join(self.options) or "none"
                raise ValueError(f"{verb} has no option {name!r}; it has {known}")
        if "hz" in self.options and "hz" not in options:
            raise ValueError(f"{verb} needs a frequency: hz = 20.0")
        return {name: self.options[name](value) for name, value in options.items() if value is not None}


def _direction(value: object) -> Direction:
    try:
        return Direction(value)
    except ValueError:
        raise ValueError(f"direction = {value!r} is neither forward nor reverse") from None


def _hertz(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f"hz = {value!r} is no number")
    return float(value)


VERBS: Mapping[str, VerbRule] = {
    "start": VerbRule(Right.WRITE, True, {"direction": _direction}),
    "jog": VerbRule(Right.WRITE, True, {"direction": _direction}),
    "reset_fault": VerbRule(Right.WRITE, True, {}),
    "set_frequency": VerbRule(Right.WRITE, True, {"hz": _hertz}),
    "coast": VerbRule(Right.STOP, True, {}),  # a hoist would drop its load
    "emergency_stop": VerbRule(Right.STOP, True, {}),
    "stop": VerbRule(Right.STOP, False, {}),
}


def verbs_of(drive: Drive) -> list[str]:
    """Return the verbs of these that the drive's family has."""
    return [name for name in VERBS if getattr(type(drive), name) is not getattr(Drive, name)]
