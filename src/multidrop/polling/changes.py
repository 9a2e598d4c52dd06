"""Compare plants: check a plant built by a program, and find the changes to a line's drives."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from copy import copy
from functools import partial
from typing import Any, NamedTuple

from multidrop.drive.family import Drive, check_own, check_readable
from multidrop.drive.line_settings import speaks_tcp
from multidrop.drive.register import Register
from multidrop.plant.loader import PlantError
from multidrop.plant.model import Plant, PlantLine, PolledDrive


class DriveChanges(NamedTuple):
    """Changes to the drives of a line that stays."""

    leaving: list[PolledDrive]
    joining: list[PolledDrive]
    repolled: list[PolledDrive]  # staying drives with changed registers or rates


def check_plant(plant: Plant, *, is_free: Callable[[Drive], bool]) -> None:
    """Raise PlantError with all mistakes of a plant, which a program may have built.

    `is_free` returns False for a drive that is on another bus. Drives take their ports' framing.
    """
    found: list[str] = []
    names: dict[tuple[str, object], str] = {}

    def once(place: str, kind: str, value: object, sentence: str) -> None:
        first = names.setdefault((kind, value), place)
        if first is not place:
            found.append(f"{place}: {sentence.format(first=first)}")

    for line in plant.lines:
        where = f'line "{line.name}"'
        once(where, "line", line.name, "another line has this name too; every line needs its own")
        wire = line.port if speaks_tcp(line.port) else where
        if wire is where:
            once(where, "port", line.port, f"port {line.port} is that of {{first}} too; make them one line")
        for polled in line.drives:
            drive, at = polled.drive, f'{where}, drive "{polled.drive.name}"'
            once(at, "drive", drive.name, "{first} has this name too; every drive needs its own")
            address = f"address {drive.address} is that of {{first}} already; give every drive its own"
            once(at, "address", (wire, drive.address), address)
            if not is_free(drive):
                found.append(f"{at}: it is on another bus: detach it there first, or make another")
            else:
                framed = copy(drive) if drive.bus and drive.bus.is_open else drive
                found += _mistakes(at, partial(framed.take_framing_of, line.port))
            for poll in polled.polls:
                found += _mistakes(at, partial(_check_polled, drive, poll.register))
    if found:
        raise PlantError(tuple(dict.fromkeys(found)))  # many registers may have the same one


def _check_polled(drive: Drive, register: Register[Any]) -> None:
    check_own(drive, register)
    check_readable(drive, register)


def _mistakes(place: str, check: Callable[[], object]) -> list[str]:
    try:
        check()
    except ValueError as mistake:
        return [f"{place}: {mistake}"]
    return []


def has_same_port(line: PlantLine, other: PlantLine) -> bool:
    """Return True if both lines can use the same open port."""
    facts, others = ((each.port, each.echo, each.ids, each.rs485, each.settle) for each in (line, other))
    return facts == others


def is_same_drive(drive: Drive, other: Drive) -> bool:
    """Return True where both describe one drive in the same way."""
    return drive is other or _description(drive) == _description(other)


def _description(drive: Drive) -> tuple[object, ...]:
    return (
        type(drive),
        drive.address,
        drive.name,
        drive.framing,
        drive.settings,
        drive.agreed_silence,
        drive.response_delay,
        drive.response_timeout,
        drive.option,
        drive.ram,
    )


def drive_changes(present: Iterable[PolledDrive], wanted: Iterable[PolledDrive]) -> DriveChanges:
    """Return the changes to a line's drives; staying drives remain the same objects."""
    left = list(present)
    changes = DriveChanges(left, [], [])
    for polled in wanted:
        same = next((each for each in left if is_same_drive(each.drive, polled.drive)), None)
        if same is None:
            changes.joining.append(polled)
            continue
        left.remove(same)
        if same.polls != polled.polls:
            changes.repolled.append(PolledDrive(same.drive, polled.polls))
    return changes
