"""Limits of values (`[[serve.limit]]` of a plant file), and which limits are exceeded now."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from math import isfinite
from typing import Any, NamedTuple

from multidrop import Plant
from multidrop.gateway.live.alarms import SEPARATOR
from multidrop.gateway.live.hub import Hub
from multidrop.toml_check import DURATION, Key, TomlPlace, duration_of

LIMIT_KEYS = {
    "drive": Key(str, 'drive = "pump-1"', needed=True),
    "register": Key(str, 'register = "output_current"', needed=True),
    "above": Key((int, float), "above = 30.0"),
    "below": Key((int, float), "below = 5.0"),
    "for": Key(str, 'for = "5 s"', keywords=DURATION),
    "hysteresis": Key((int, float), "hysteresis = 2.0", keywords={"minimum": 0}),
}


class Limit(NamedTuple):
    """A bound of a polled value. It is exceeded once the value has been beyond it for `lasting_s` seconds.

    It stays exceeded until the value is back within the bound by `hysteresis`, in the register's unit.
    """

    drive: str
    register: str
    unit: str
    is_above: bool  # True: the bound is an upper limit; False: a lower limit
    bound: float
    lasting_s: float = 0.0
    hysteresis: float = 0.0

    def __str__(self) -> str:
        side = "above" if self.is_above else "below"
        return f"{self.register} {side} {self.bound:g} {self.unit}".rstrip()

    def is_beyond(self, value: float, margin: float) -> bool:
        """Return True if the value is beyond the bound, or back by less than `margin`."""
        return value > self.bound - margin if self.is_above else value < self.bound + margin


class Limits:
    """The limits of a plant, and for each of them the time when its value went beyond the bound."""

    def __init__(self, limits: Iterable[Limit]) -> None:
        self._of: dict[str, list[Limit]] = {}
        self._since_s: dict[Limit, float] = {}
        for limit in limits:
            self._of.setdefault(limit.drive, []).append(limit)

    def __contains__(self, drive: str) -> bool:
        return drive in self._of

    def exceeded(self, now_s: float, drive: str, values: Mapping[str, float], before: str) -> str:
        """Return the drive's exceeded limits as a text; "" if there are none.

        `values` has the current values by register. While a value is missing, its limit keeps its state,
        and `lasting_s` starts again afterwards. `before` is the text that the previous call returned, or
        the text of an alarm of an earlier run.
        """
        found = []
        for limit in self._of.get(drive, ()):
            was = str(limit) in before.split(SEPARATOR)
            value = values.get(limit.register)
            if value is None:
                self._since_s.pop(limit, None)
                is_exceeded = was
            elif limit.is_beyond(value, limit.hysteresis if was else 0.0):
                since_s = self._since_s.setdefault(limit, now_s)
                is_exceeded = was or now_s - since_s >= limit.lasting_s
            else:
                self._since_s.pop(limit, None)
                is_exceeded = False
            found += [str(limit)] if is_exceeded else []
        return SEPARATOR.join(found)


def current_values(hub: Hub, drive: str) -> dict[str, float]:
    """Return the newest values of a drive's polled registers by name, without those that are too old."""
    return {
        register.name: good[2]
        for register, _, good, is_current in hub.known(drive)
        if is_current and good is not None
    }


def read_limits(tables: Any, plant: Plant, place: TomlPlace) -> tuple[Limit, ...]:
    """Return the limits in the tables `[[serve.limit]]`; mistakes are added to `place`."""
    units = {
        (polled.drive.name, poll.register.name): poll.register.unit
        for line in plant.lines
        for polled in line.drives
        for poll in polled.series
    }
    found = []
    for table, inside in place.inside("limit", tables):
        before = len(place.config_errors)
        given = inside.check(table, LIMIT_KEYS)
        lasting_s = duration_of(given, "for", inside) or 0.0
        if len(place.config_errors) == before:
            found.append(inside.attempt(_limit, given, lasting_s, units if plant.lines else None))
    return tuple(limit for limit in found if limit is not None)


def _limit(given: Mapping[str, Any], lasting_s: float, units: Mapping[tuple[str, str], str] | None) -> Limit:
    """Return a limit. `units` has the unit of each polled register, or is None if the plant has no lines.

    Raises ValueError for an invalid limit.
    """
    drive, register = given["drive"], given["register"]
    if units is not None and (drive, register) not in units:
        raise ValueError(f"{drive}.{register} is not polled: only polled values can have a limit")
    sides = [side for side in ("above", "below") if side in given]
    if len(sides) != 1:
        raise ValueError("give either above or below; a value with both bounds has two [[serve.limit]]")
    bound, hysteresis = float(given[sides[0]]), float(given.get("hysteresis", 0.0))
    if not isfinite(bound) or not 0 <= hysteresis < float("inf"):
        raise ValueError(f"{sides[0]} and hysteresis must be finite, and hysteresis not below 0")
    unit = units[drive, register] if units is not None else ""
    return Limit(drive, register, unit, sides[0] == "above", bound, lasting_s, hysteresis)
