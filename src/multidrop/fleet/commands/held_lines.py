"""HeldLines: the lines for which this gateway accepts commands and stops."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import count
from typing import Any

from multidrop import Bus, Drive

LISTS = ("write", "verbs")  # the two lists in the plant file's table [fleet.may]


class HeldLine:
    """A line that this gateway polls. `number` is new each time this gateway becomes the line's master."""

    _numbers = count(1)

    def __init__(self, name: str, bus: Bus, may: Mapping[str, frozenset[str]]) -> None:
        self.number = next(self._numbers)
        self.is_leaving = False
        self.name = name
        self.bus = bus
        self.may = may

    @property
    def drives(self) -> dict[str, Drive]:
        return {drive.name: drive for drive in self.bus.drives}

    def drive(self, name: str) -> Drive:
        """Return the drive of this name. Raises ValueError if the line has no such drive."""
        drives = self.drives
        if name not in drives:
            raise ValueError(f"line {self.name} has no drive {name!r}; it has {', '.join(drives) or 'none'}")
        return drives[name]


class HeldLines:
    """The lines for which this gateway accepts commands and stops.

    `bus` returns the bus of a polled line. `may_stop` returns True while this gateway is the line's master.
    `may_command` returns True once no frame of the previous master can still be on the line. A stop that
    collides with such a frame is repeated, but a command would be lost.
    """

    def __init__(
        self,
        bus: Callable[[str], Bus],
        *,
        may_command: Callable[[str], bool],
        may_stop: Callable[[str], bool],
    ) -> None:
        self._bus = bus
        self._may_command = may_command
        self._may_stop = may_stop
        self._held: dict[str, HeldLine] = {}

    def open(self, line: str, description: Mapping[str, Any]) -> None:
        """Accept commands and stops for a line from now on."""
        self._held[line] = HeldLine(line, self._bus(line), lists_of(description))

    def leave(self, line: str) -> None:
        """Accept only stops for the line from now on."""
        if held := self._held.get(line):
            held.is_leaving = True

    def shut(self, line: str) -> None:
        """Accept neither commands nor stops for the line from now on."""
        self._held.pop(line, None)

    def for_command(self, line: str) -> HeldLine | None:
        """Return the line if a command may be sent on it now, else None."""
        held = self._held.get(line)
        return held if held and not held.is_leaving and self._may_command(line) else None

    def for_stop(self, line: str) -> HeldLine | None:
        """Return the line if a stop may be sent on it now, else None."""
        return self._held.get(line) if self._may_stop(line) else None


def lists_of(description: Mapping[str, Any]) -> dict[str, frozenset[str]]:
    """Return the registers and verbs that a line's record allows; an invalid list counts as empty."""
    may = description.get("may")
    given = may if isinstance(may, dict) else {}
    return {key: _entries(given.get(key)) for key in LISTS}


def _entries(given: object) -> frozenset[str]:
    return frozenset(one for one in given if isinstance(one, str)) if isinstance(given, list) else frozenset()
