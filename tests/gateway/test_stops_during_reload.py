"""Stops during a reload that moves drives' names from one line to another."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field

import pytest
from lines import PATIENCE, line, plant, polled

from multidrop import Drive, InvtCHE, Plant
from multidrop.gateway.commands import stop_meant

Names = dict[str, Drive]


@dataclass
class End:
    """The result of a stop, with the drive that was stopped."""

    drive: Drive | None
    ok: bool = True


@dataclass
class Lines:
    """Lines of a poller that a test changes, and whose stops it can delay."""

    plant_now: Plant
    plant_coming: Plant | None = None
    held: dict[int, asyncio.Event] = field(default_factory=dict)  # by drive address: a stop waits for it
    failing: set[int] = field(default_factory=set)
    begun: list[Drive | None] = field(default_factory=list)

    async def stop(self, now: Plant, names: list[str]) -> dict[str, End]:
        """Stop these drives; the stop of a held drive waits for the drive's event."""
        there = {polled.drive.name: polled.drive for line in now.lines for polled in line.drives}
        found = {name: there.get(name) for name in names}
        self.begun += found.values()
        for drive in found.values():
            if drive is not None and drive.address in self.held:
                await self.held[drive.address].wait()
        return {
            name: End(drive, drive is not None and drive.address not in self.failing)
            for name, drive in found.items()
        }


def plant_of(*drives: Drive) -> Plant:
    """Return a plant with a line for each drive."""
    return plant(
        *(
            line(f"/dev/tty{number}", polled(drive, []), name=f"hall-{number}")
            for number, drive in enumerate(drives)
        )
    )


async def until(met: Callable[[], object]) -> None:
    async with asyncio.timeout(PATIENCE):
        while not met():
            await asyncio.sleep(0)


def told(ends: dict[str, End]) -> Names:
    return {name: end.drive for name, end in ends.items() if end.drive is not None}


FAN, PUMP = InvtCHE(1, name="fan"), InvtCHE(2, name="pump")
NEW_FAN = InvtCHE(2, name="fan")


@pytest.mark.parametrize("names", [["fan"], None])
def test_new_drive_is_stopped_while_the_stop_of_its_predecessor_continues(
    names: list[str] | None,
) -> None:
    """The predecessor's stop may take half a minute, for example if that drive is silent."""
    silent = asyncio.Event()
    lines = Lines(plant_of(PUMP, FAN), held={FAN.address: silent})

    async def main() -> dict[str, End]:
        stopping = asyncio.create_task(stop_meant(lines, names, lines.stop))
        await until(lambda: FAN in lines.begun)
        lines.plant_coming = lines.plant_now = plant_of(NEW_FAN)
        await until(lambda: NEW_FAN in lines.begun)
        assert not stopping.done()
        lines.plant_coming = None
        silent.set()
        return await stopping

    ends = asyncio.run(main())
    assert (
        ends["fan"].drive is NEW_FAN
    )  # the result is the new drive's, although the old drive's result came later
    assert lines.begun.count(NEW_FAN) == 1


def test_a_stop_that_fails_while_lines_change_is_sent_again() -> None:
    silent = asyncio.Event()
    lines = Lines(plant_of(PUMP, FAN), held={FAN.address: silent}, failing={FAN.address})

    async def main() -> dict[str, End]:
        stopping = asyncio.create_task(stop_meant(lines, ["fan"], lines.stop))
        await until(lambda: FAN in lines.begun)
        lines.plant_now = plant_of(PUMP, FAN, InvtCHE(3, name="mill"))
        silent.set()
        return await stopping

    assert not asyncio.run(main())["fan"].ok
    assert lines.begun == [FAN, FAN]


async def test_stop_by_a_name_of_the_new_plant_is_sent_once_the_drive_is_attached() -> None:
    """The name may have another spelling. Other drives of the present plant are not stopped."""
    new = InvtCHE(2, name="L\u00fcfter")
    lines = Lines(plant_of(PUMP, FAN), plant_of(new, FAN))
    stopping = asyncio.create_task(stop_meant(lines, ["Lu\u0308fter"], lines.stop))
    await until(lambda: lines.begun)
    lines.plant_now, lines.plant_coming = plant_of(new, FAN), None
    assert told(await stopping) == {"Lu\u0308fter": new}
    assert lines.begun == [None, new]


async def test_without_a_reload_only_the_named_drives_are_stopped() -> None:
    lines = Lines(plant_of(PUMP, FAN))
    assert told(await stop_meant(lines, ["fan", "nobody"], lines.stop)) == {"fan": FAN}
    assert lines.begun == [FAN, None]
