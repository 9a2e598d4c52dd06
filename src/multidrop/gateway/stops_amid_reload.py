"""Stops amid a reload: what the reload makes of a drive is stopped too, as soon as it is there."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from typing import Protocol, TypeVar

from multidrop import Drive, Plant

LOOK_S = 0.02  # between looks at what a reload changes


class StopEnd(Protocol):
    """The end of a stop."""

    @property
    def is_done(self) -> bool: ...


T = TypeVar("T", bound=StopEnd)


class ChangingLines(Protocol):
    """The lines of a poller, which a reload may change at any moment."""

    @property
    def plant_now(self) -> Plant: ...
    @property
    def is_settled(self) -> bool: ...


def drives_of(plant: Plant) -> dict[str, Drive]:
    return {polled.drive.name: polled.drive for line in plant.lines for polled in line.drives}


async def stop_as_changed(
    lines: ChangingLines,
    drives: Sequence[str] | None,
    stop: Callable[[Plant, list[str]], Awaitable[dict[str, T]]],
) -> dict[str, T]:
    """Stop these drives, or all with None; by drive's name what became of the latest stop of each.

    `stop` is called with the plant as it is polled now. It is called again with the drives that a reload has
    changed since, and with those whose stop failed while anything changed. It ends when no reload is under
    way, and nothing of that is left.
    """
    stopped: dict[str, Drive | None] = {}  # by name, each drive as it was then
    told: dict[str, T] = {}
    plant = lines.plant_now
    while True:
        before, is_settled, plant = plant, lines.is_settled, lines.plant_now
        there = drives_of(plant)
        has_changed = plant.lines != before.lines
        left = [
            name
            for name in dict.fromkeys(there if drives is None else drives)
            if name not in stopped
            or (name in there and there[name] is not stopped[name])
            or (name in there and has_changed and not told[name].is_done)
        ]
        if left:
            stopped |= {name: there.get(name) for name in left}
            told |= await stop(plant, left)
        elif is_settled:
            return told
        else:
            await asyncio.sleep(LOOK_S)
