"""Polled units: what the values of a gateway's rows are, by the description that they were polled under."""

from __future__ import annotations

from typing import Any

from multidrop import PlantLine, Register

RAW, NAMED = "raw count", "names"  # as a history calls what has no unit
Since = tuple[tuple[int, str], ...]  # units of a register, each since a time of the monotonic clock in ns


class PolledUnits:
    """The unit of each register, since when. One thread at a time notes a drive; any thread may ask."""

    def __init__(self) -> None:
        self._since: dict[tuple[str, str], Since] = {}

    def note(self, line: PlantLine, since_ns: int) -> None:
        """Note that rows of this line which are asked from now on are of these units."""
        for polled in line.drives:
            for poll in polled.polls:
                series = polled.drive.name, poll.register.name
                unit = unit_of(poll.register)
                known = self._since.get(series, ())
                if not known or known[-1][1] != unit:
                    self._since[series] = (*known, (since_ns, unit))

    def of(self, drive: str, register: str) -> Since:
        """Return the units of a register, the oldest first; none where no line has it."""
        return self._since.get((drive, register), ())


def unit_of(register: Register[Any]) -> str:
    """Return a unit as histories name it: "" is a number without one."""
    if register.values:
        return NAMED
    return RAW if register.step is None else register.unit
