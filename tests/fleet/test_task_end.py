"""Tasks that ignore cancellations are still ended in finite time."""

from __future__ import annotations

import asyncio
from pathlib import Path

from multidrop.fleet.commands.fleet_commands import FleetCommands
from multidrop.supervisor import end_tasks

PATIENCE_S = 60.0


async def deaf(times: int) -> str:
    """Ignore this many cancellations, as a path does if a pong arrives at the same moment."""
    for _ in range(times):
        try:
            await asyncio.sleep(3600)
        except asyncio.CancelledError:
            continue
    await asyncio.sleep(3600)
    return "never"


async def _begun(times: int) -> asyncio.Task[str]:
    task = asyncio.create_task(deaf(times))
    await asyncio.sleep(0)
    return task


async def test_a_task_is_cancelled_until_it_has_ended() -> None:
    tasks = [await _begun(times) for times in (0, 1, 3)]
    found = await asyncio.wait_for(end_tasks(*tasks), PATIENCE_S)
    assert [type(one) for one in found] == [asyncio.CancelledError] * 3
    assert await end_tasks() == []


async def test_the_error_of_an_ended_task_is_returned() -> None:
    async def failing() -> None:
        raise OSError("the disk is full")

    failed = asyncio.create_task(failing())
    await asyncio.wait({failed})
    (found,) = await end_tasks(failed)
    assert str(found) == "the disk is full"


async def test_closing_a_commander_ends_a_path_that_ignored_a_cancellation(tmp_path: Path) -> None:
    fleet = FleetCommands(["nats://127.0.0.1:1"], by="anna", log=tmp_path / "commands.jsonl")
    fleet._keeping = [await _begun(1)]  # type: ignore[list-item]
    await asyncio.wait_for(fleet.close(), PATIENCE_S)
