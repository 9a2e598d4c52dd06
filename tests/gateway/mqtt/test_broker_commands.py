"""BrokerCommands: the limit of concurrent commands from a broker, which does not apply to stops."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Any

from multidrop.control import CommandOutcome, CommandResult
from multidrop.gateway.http.rights import Caller, Right
from multidrop.gateway.mqtt.broker_commands import MOST_UNDER_WAY, BrokerCommands

CALLER = Caller("anyone", "mqtt", "broker", Right.WRITE)
NOW_MS = 1_000_000


class HeldCommands:
    """Commands that end when the test releases them; stops end immediately."""

    plant_ns = None

    def __init__(self) -> None:
        self.go_on = asyncio.Event()
        self.begun: list[float] = []
        self.stopped: list[Sequence[str] | None] = []

    def stopped_ns(self, drive: str) -> None:
        return None

    async def write(self, drive: str, register: str, value: float, caller: Caller) -> CommandResult:
        self.begun.append(value)
        await self.go_on.wait()
        return CommandResult(CommandOutcome.DONE, "done")

    async def stop(self, drives: Sequence[str] | None, caller: Caller) -> dict[str, CommandResult]:
        self.stopped.append(drives)
        return {"pump-1": CommandResult(CommandOutcome.DONE, "stopped")}


async def test_concurrent_broker_writes_are_limited_and_stops_are_not() -> None:
    told: list[tuple[str, str]] = []
    commands: Any = HeldCommands()
    orders = BrokerCommands(
        commands, CALLER, lambda: NOW_MS, lambda drive, what, end, _: told.append((what, end.text))
    )
    for value in range(MOST_UNDER_WAY + 2):
        orders.write("pump-1", "setpoint", value, NOW_MS)
    await asyncio.sleep(0)  # the commands start
    assert commands.begun == [*range(MOST_UNDER_WAY)]
    refused = f"not sent: {MOST_UNDER_WAY} others are under way"
    assert told == [(f"setpoint = {MOST_UNDER_WAY + at}", refused) for at in range(2)]
    for _ in range(3):
        orders.stop(["pump-1"])
    await asyncio.sleep(0)
    assert commands.stopped == [["pump-1"]] * 3
    commands.go_on.set()
    await asyncio.gather(*asyncio.all_tasks() - {asyncio.current_task()})
    orders.write("pump-1", "setpoint", 99.0, NOW_MS)
    await asyncio.gather(*asyncio.all_tasks() - {asyncio.current_task()})
    assert commands.begun[-1] == 99.0
