"""Check a step's commands against the rules that need no open port."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any

from multidrop.control.ramp import check_worn
from multidrop.control.rules import check_plain, conditions, raw_count, refused, wears
from multidrop.drive.family import Drive
from multidrop.drive.register import Kept
from multidrop.drive.state import Direction
from multidrop.drive.verbs import Write
from multidrop.errors import Unsupported
from multidrop.plant.model import Plant
from multidrop.runs.model import RunStep


def contradictions(step: RunStep, frequency: Collection[str]) -> Iterator[tuple[str, str]]:
    """Yield key and error sentence of each command that contradicts another one to the same drive.

    `frequency` has the names of the drives whose frequency the step sets.
    """
    for name in dict.fromkeys(step.stop):
        if name in (*frequency, *step.write, *step.start):
            yield "stop", f"{name} is stopped and commanded in one step; make two steps"
    for name in step.start:
        if step.rate and name in frequency:
            yield "start", f"{name} cannot be started by a ramp; start it in a step before"


def check_step(step: RunStep, plant: Plant) -> None:
    """Raise ValueError for a command that a rule forbids, such as a write that wears EEPROM."""
    for _, sentence in contradictions(step, step.frequency):
        raise ValueError(f"{step.name}: {sentence}")
    for name in step.drives:
        _, drive = plant.find_drive(name)
        if name in step.stop:
            check_stop(drive)
        for register, value in step.write.get(name, {}).items():
            check_write(drive, register, value)
        if name in step.frequency:
            check_frequency(drive, step.frequency[name])
        if name in step.start:
            check_start(drive, step.direction)


def _rehearse(script: Any, *arguments: Any) -> Any:
    """Return the first step of a verb's script; nothing is sent.

    Raises ValueError if the family lacks or forbids the verb.
    """
    try:
        return next(script(*arguments))
    except Unsupported as lacking:
        raise ValueError(str(lacking)) from lacking


def check_stop(drive: Drive) -> None:
    """Raise ValueError if the family has no stop."""
    _rehearse(drive.stop.script)


def check_start(drive: Drive, direction: Direction | None) -> None:
    """Raise ValueError if the drive may not be started."""
    drive.check_confirmed("start")
    _rehearse(drive.start.script, direction)


def check_frequency(drive: Drive, hz: float) -> None:
    """Raise ValueError for a frequency that a step may not set on this drive."""
    drive.check_confirmed("set_frequency")
    first = _rehearse(drive.set_frequency.script, hz)
    check_worn(drive, "steps")
    if isinstance(first, Write):
        value = first.register.decode(raw_count(drive, first.register, first.value))
        # only rules that need no reads from the drive; the run checks all
        next(conditions(drive, first.register, value), None)


def check_write(drive: Drive, name: str, value: Any) -> None:
    """Raise ValueError if a step may not write this value (a number or a value's name) to this register."""
    register = drive.register(name)
    if isinstance(value, str):
        value = register.parse(value)
    check_plain(drive, register, raw_count(drive, register, value))
    if wears(drive, register) is not Kept.RAM:
        rule = "it may be kept in EEPROM, which steps would wear out"
        raise refused(drive, register, f'{rule}; declare ram = ["{name}"] if this drive keeps it in RAM')
