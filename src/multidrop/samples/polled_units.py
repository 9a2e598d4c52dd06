"""PolledUnits: the unit of each row, from the register's description at the time of the poll."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Any, NamedTuple

import pyarrow as pa

from multidrop.drive import Drive
from multidrop.drive.register import Register
from multidrop.plant.model import PlantLine

RAW = "raw count"  # unit of values whose scale is unknown; histories use the same text


class UnitChange(NamedTuple):
    """A change of a register's unit: until `until_ns` (monotonic), the unit was `code`."""

    until_ns: int
    series: int
    code: int


class UnitTable(NamedTuple):
    """The unit of each register of each drive, as a code.

    The values of one register of one drive are a series. Series are numbered drive * len(registers) +
    register, by the positions of the two names in their lists.
    """

    newest: Any  # pa.Array of the present unit code of each series; null if unknown
    changes: Sequence[UnitChange]  # the newest change comes first
    texts: Sequence[str]  # unit texts by code


class PolledUnits:
    """The units of all polled registers, now and in the past. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._since: dict[tuple[str, str], list[tuple[int, str]]] = {}
        self._made: tuple[Sequence[str], Sequence[str], UnitTable] | None = None

    def note(self, line: PlantLine, since_ns: int) -> None:
        """Set the units of a line's registers for requests sent at or after `since_ns` (monotonic)."""
        with self._lock:
            for polled in line.drives:
                for poll in polled.series:
                    known = self._since.setdefault((polled.drive.name, poll.register.name), [])
                    unit = unit_of(polled.drive, poll.register)
                    if not known or known[-1][1] != unit:
                        known.append((since_ns, unit))
            self._made = None

    def table(self, drives: Sequence[str], registers: Sequence[str]) -> UnitTable:
        """Return the units of the drives' registers. The table is cached until lines or names change."""
        # without the cache, looking up units would cost more than all other work on a row
        with self._lock:
            if self._made is None or self._made[:2] != (drives, registers):
                self._made = drives, registers, self._make(drives, registers)
            return self._made[2]

    def _make(self, drives: Sequence[str], registers: Sequence[str]) -> UnitTable:
        drive_at = {name: at for at, name in enumerate(drives)}
        register_at = {name: at for at, name in enumerate(registers)}
        code: dict[str, int] = {}
        newest: list[int | None] = [None] * (len(drives) * len(registers))
        changes: list[UnitChange] = []
        for (drive, register), known in self._since.items():
            if drive in drive_at and register in register_at:
                series = drive_at[drive] * len(registers) + register_at[register]
                codes = [code.setdefault(unit, len(code)) for _, unit in known]
                newest[series] = codes[-1]
                for (until_ns, _), before in zip(known[1:], codes[:-1], strict=True):
                    changes.append(UnitChange(until_ns, series, before))
        return UnitTable(pa.array(newest, pa.uint16()), sorted(changes, reverse=True), list(code))


def unit_of(drive: Drive, register: Register[Any]) -> str:
    """Return a register's unit: "" for a plain number, "names of yd1000" for named values of a YD1000."""
    if register.values:
        return f"names of {drive.model or type(drive).__name__}"
    return RAW if register.step is None else register.unit
