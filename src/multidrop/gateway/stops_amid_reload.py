"""Stops during a reload: if the reload changes a drive, stop the drive again when it is attached."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from typing import Protocol, TypeVar

from multidrop import Drive, Plant, PlantLine
from multidrop.plant import drive_meant
from multidrop.supervisor import supervisor

LOOK_S = 0.02  # between checks for drives that a reload has changed


class StopEnd(Protocol):
    """The result of a stop."""

    @property
    def ok(self) -> bool: ...


T = TypeVar("T", bound=StopEnd)


class ChangingLines(Protocol):
    """The lines of a poller, which a reload may change at any moment."""

    @property
    def plant_now(self) -> Plant: ...
    @property
    def plant_coming(self) -> Plant | None:
        """The plant of a reload in progress; None without one."""


def drives_of(plant: Plant) -> dict[str, Drive]:
    return {polled.drive.name: polled.drive for line in plant.lines for polled in line.drives}


def names_of(lines: ChangingLines) -> dict[str, None]:
    """Return the names of all drives of the present plant, and of the new plant during a reload."""
    plants = (lines.plant_now, lines.plant_coming or lines.plant_now)
    return dict.fromkeys(name for plant in plants for name in drives_of(plant))


async def stop_meant(
    lines: ChangingLines,
    drives: Sequence[str] | None,
    stop: Callable[[Plant, list[str]], Awaitable[dict[str, T]]],
) -> dict[str, T]:
    """Stop the drives with these names; during a reload, also those with these names in the new plant.

    Names may have another spelling (see `drive_meant`). Return the result of each drive's latest stop by
    name. `stop` is the same as in `stop_as_changed`.
    """
    if drives is None:
        return await stop_as_changed(lines, None, stop)
    names = names_of(lines)
    meant = {name: drive_meant(name, names) for name in drives}
    others = _also_meant(lines, [*meant.values()])
    results = await stop_as_changed(lines, [*meant.values(), *others], stop)
    return {name: results[meant.get(name, name)] for name in (*meant, *others)}


def _also_meant(lines: ChangingLines, drives: Sequence[str]) -> list[str]:
    """Return the present names of drives that have one of these names in the new plant.

    A stop by such a name may mean either drive. A drive is left out if the new plant has another family at
    its address, because the same stop frame may mean something else there.
    """
    if lines.plant_coming is None:
        return []
    coming = _by_place(lines.plant_coming)
    wanted = {place: type(drive) for place, drive in coming.items() if drive.name in drives}
    return [
        drive.name
        for place, drive in _by_place(lines.plant_now).items()
        if wanted.get(place) is type(drive) and drive.name not in drives
    ]


def _by_place(plant: Plant) -> dict[tuple[str, int], Drive]:
    return {(line.port, polled.drive.address): polled.drive for line in plant.lines for polled in line.drives}


class _Latest:
    """The latest stop of one drive, with the drive (None if missing) and the lines at that time."""

    def __init__(self, drive: Drive | None, lines: Sequence[PlantLine]) -> None:
        self.drive = drive
        self.lines = lines
        self.has_failed = False


async def stop_as_changed(
    lines: ChangingLines,
    drives: Sequence[str] | None,
    stop: Callable[[Plant, list[str]], Awaitable[dict[str, T]]],
) -> dict[str, T]:
    """Stop these drives, or all if None; return the result of each drive's latest stop by name.

    `stop` is called with the present plant and the names. During a reload it is called again for drives that
    the reload has changed since, even if their earlier stops continue, and for drives whose stop failed, if
    any line has changed since. Return when no reload is in progress and all stops have ended.
    """
    latest: dict[str, _Latest] = {}
    results: dict[str, T] = {}
    under_way: set[asyncio.Task[None]] = set()

    async def begin(plant: Plant, begun: dict[str, _Latest]) -> None:
        for name, end in (await stop(plant, [*begun])).items():
            if latest[name] is begun[name]:
                results[name] = end
                begun[name].has_failed = not end.ok

    try:
        while True:
            is_settled, plant = lines.plant_coming is None, lines.plant_now
            there = drives_of(plant)
            left = {
                name: _Latest(there.get(name), plant.lines)
                for name in dict.fromkeys(there if drives is None else drives)
                if _is_left(latest.get(name), there.get(name), plant.lines)
            }
            if left:
                latest |= left
                under_way.add(supervisor().start("stop", begin(plant, left)))
            elif is_settled and not under_way:
                return results
            if under_way:
                over, under_way = await asyncio.wait(
                    under_way, timeout=LOOK_S, return_when=asyncio.FIRST_COMPLETED
                )
                for task in over:
                    task.result()
            else:
                await asyncio.sleep(LOOK_S)
    finally:
        for task in under_way:  # the stops themselves continue
            task.cancel()


def _is_left(before: _Latest | None, drive: Drive | None, lines: Sequence[PlantLine]) -> bool:
    """Return True if this drive must be stopped, or stopped again."""
    if before is None:
        return True
    if drive is None:
        return False
    return drive is not before.drive or (before.has_failed and lines != before.lines)
