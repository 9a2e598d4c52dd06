"""Plant: the drives on each line, and what is polled of them. Data alone."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from multidrop.core import Echo, TransactionIds
from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.plant import metadata


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

    @property
    def wanted(self) -> list[tuple[Register[Any], float | None]]:
        """Registers and their periods in s, as planning takes them."""
        return [(poll.register, poll.every) for poll in self.polls]


@dataclass(frozen=True)
class PlantLine:
    """A port with its drives; its baud rate and format are already in the drives' settings."""

    name: str
    port: str
    baudrate: int | None
    format: str | None
    drives: tuple[PolledDrive, ...]
    switching: float = 0.0  # s that the port takes to change them
    echo: Echo = Echo.AUTO
    ids: TransactionIds = TransactionIds.MATCH


@dataclass(frozen=True)
class Plant:
    """All lines of a plant file."""

    lines: tuple[PlantLine, ...]
    path: Path

    def metadata(self) -> dict[str, Any]:
        """Return what a reader of a recording must know that its rows do not say."""
        return metadata.of_plant(self)
