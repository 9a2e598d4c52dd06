"""Describe a plant for the readers of its recordings: drives, registers, and what each line should reach."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Flag
from typing import TYPE_CHECKING, Any

from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.planning.blocks import Planned, planned
from multidrop.planning.prediction import prediction_metadata

if TYPE_CHECKING:
    from multidrop.plant.model import Plant, PlantLine, PolledDrive


def planned_on(line: PlantLine, delays: Mapping[Drive, float] | None = None) -> list[Planned]:
    """Return all that is polled on a line; `delays` are response delays in s that were measured."""
    known = delays or {}
    return [
        each
        for polled in line.drives
        for each in planned(polled.drive, polled.wanted, known.get(polled.drive))
    ]


def of_plant(plant: Plant) -> dict[str, Any]:
    from importlib.metadata import version  # takes a fifth of the time in which a poller is imported

    return {
        "multidrop": version("multidrop"),
        "plant": str(plant.path),
        "planned": {line.name: prediction_metadata(planned_on(line), line.switching) for line in plant.lines},
        "drives": {
            polled.drive.name: _of_drive(line, polled) for line in plant.lines for polled in line.drives
        },
    }


def _of_drive(line: PlantLine, polled: PolledDrive) -> dict[str, Any]:
    drive = polled.drive
    return {
        "line": line.name,
        "model": drive.model,
        "address": drive.address,
        "settings": str(drive.settings),
        "framing": str(drive.framing),
        "registers": {poll.register.name: _of_register(poll.register) for poll in polled.polls},
    }


def _of_register(register: Register[Any]) -> dict[str, Any]:
    values = register.values
    return {
        "unit": register.unit,
        "step": register.step,
        "values": {member.name: member.value for member in values} if values else None,
        "bits": values is not None and issubclass(values, Flag),
        "function": register.table.read,
        "address": register.reach.start,
        "words": len(register.reach),
    }
