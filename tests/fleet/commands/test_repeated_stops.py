"""Stops of one silent drive: the gateway repeats one of the stops, and sends each of the others once."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from functools import partial
from math import inf
from pathlib import Path
from typing import Any

import pytest
from command_desks import LINE, Desks, desks
from lines import PATIENCE

from multidrop.control.commands import RepeatedStops, Results, begin_stops, stop_drive, stop_line
from multidrop.fleet.commands import desk as desk_module
from multidrop.fleet.commands.messages import (
    CommandAnswer,
    CommandOutcome,
)


@pytest.mark.slow
def test_only_one_of_many_stops_of_a_silent_drive_is_repeated(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Each stop is sent after its call. All calls get the answer of the stop that is repeated."""
    repeated: list[float | None] = []

    are_all_called = threading.Event()

    def noted(*details: Any, stop: Callable[..., Results]) -> Results:
        repeated.append(details[-1])
        if repeated[1:]:
            are_all_called.wait(PATIENCE)
        return stop(*details)

    monkeypatch.setattr(desk_module, "stop_line", partial(noted, stop=stop_line))
    monkeypatch.setattr(
        RepeatedStops.__init__, "__defaults__", (partial(noted, stop=stop_drive), begin_stops)
    )

    async def stopped(desk: Desks) -> list[CommandAnswer | None]:
        desk.sim.deaf_until = inf
        called = [asyncio.create_task(desk.stop())]
        async with asyncio.timeout(PATIENCE):
            while not desk.lines.for_stop(LINE).bus.stops_under_way():  # type: ignore[union-attr]
                await asyncio.sleep(0.002)
            called += [asyncio.create_task(desk.stop()) for _ in range(8)]
            while len(desk.stops._repeated._tasks) < 8:
                await asyncio.sleep(0.002)
            are_all_called.set()
            while len(repeated) < 3 or desk.stops._repeated._sent:
                await asyncio.sleep(0.002)
        desk.sim.deaf_until = 0.0
        return await asyncio.gather(*called)

    with desks(tmp_path) as desk:
        answers = asyncio.run(stopped(desk))
    assert [answer.outcome for answer in answers if answer] == [CommandOutcome.DONE] * 9
    assert repeated == [None, 0.0, 0.0]  # the last stop answers seven calls
