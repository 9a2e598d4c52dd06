"""Reads a plant file: which drives are on which lines, and what is polled. Opens no port.

Every mistake in the file is found before anything is done with it, and all are reported at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Flag
from importlib.metadata import version
from pathlib import Path
from typing import Any

from multidrop.core import Echo
from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.planning.blocks import Plan, Planned, plan
from multidrop.planning.forecast import forecast


@dataclass(frozen=True)
class Polled:
    """A register that is read every so many seconds; None: as fast as the line allows."""

    register: Register[Any]
    every: float | None


@dataclass(frozen=True)
class PolledDrive:
    """A drive and what is read from it, again and again."""

    drive: Drive
    polls: tuple[Polled, ...]

    def plan(self, delay: float | None = None) -> Plan:
        """The best blocks; `delay` is the drive's response delay in s, where it was measured."""
        return plan(self.drive, [(poll.register, poll.every) for poll in self.polls], delay)


@dataclass(frozen=True)
class PlantLine:
    """A port with its drives; its baud rate and format are already in the drives' settings."""

    name: str
    port: str
    baudrate: int | None
    format: str | None
    drives: tuple[PolledDrive, ...]
    switching: float = 0.0  # s that the port needs to change them
    echo: Echo = Echo.AUTO

    def planned(self, delays: Mapping[Drive, float] | None = None) -> list[Planned]:
        """All that is polled on it, in blocks; `delays` are response delays in s that were measured."""
        known = delays or {}
        return [one for polled in self.drives for one in polled.plan(known.get(polled.drive)).planned]


@dataclass(frozen=True)
class Plant:
    """All lines of a plant file."""

    lines: tuple[PlantLine, ...]
    path: Path

    def metadata(self) -> dict[str, Any]:
        """What a reader of a recording must know that its rows do not say."""
        return {
            "multidrop": version("multidrop"),
            "plant": str(self.path),
            "planned": {line.name: forecast(line.planned(), line.switching) for line in self.lines},
            "drives": {
                polled.drive.name: _described(line, polled) for line in self.lines for polled in line.drives
            },
        }


def _described(line: PlantLine, polled: PolledDrive) -> dict[str, Any]:
    drive = polled.drive
    return {
        "line": line.name,
        "model": drive.model,
        "address": drive.address,
        "settings": str(drive.settings),
        "framing": str(drive.framing),
        "registers": {poll.register.name: _meaning(poll.register) for poll in polled.polls},
    }


def _meaning(register: Register[Any]) -> dict[str, Any]:
    values = {it.name: it.value for it in register.values} if register.values else None
    place = {"function": register.table.read, "address": register.address, "words": register.words}
    bits = register.values is not None and issubclass(register.values, Flag)
    return {"unit": register.unit, "step": register.step, "values": values, "bits": bits, **place}
