"""Answers to who asked for a stop, by what its drive did: none that was sent is told as unsent."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from math import inf
from pathlib import Path
from typing import Any

import pytest
from command_desks import LINE, Desks, desks
from lines import PATIENCE
from simulated_bus import is_write, one

from multidrop import InnovertIBD
from multidrop.core import Message, build_reply
from multidrop.fleet.commands import stop_desk
from multidrop.fleet.commands.drive_commands import answers_of_stops, stop_drive
from multidrop.fleet.commands.words import CommandAnswer, CommandOutcome

Stop = Callable[[InnovertIBD], dict[str, CommandAnswer]]
WAYS: dict[str, Stop] = {
    "the line": lambda drive: answers_of_stops(drive.bus.stop_all()),
    "the drive": lambda drive: stop_drive(drive, None),
}


@pytest.mark.parametrize("way", WAYS)
def test_a_stop_that_is_refused_was_sent(monkeypatch: pytest.MonkeyPatch, way: str) -> None:
    line, drive, _ = one(monkeypatch, InnovertIBD(1))

    def refuse(request: Message) -> bytes | None:
        if not is_write(request):
            return None
        refusal = Message(request.address, request.function, request.start, exception=1)
        return build_reply(drive.framing, refusal)

    line.answers = refuse
    found = WAYS[way](drive)[drive.name]
    assert found.outcome is CommandOutcome.FAILED
    assert "refuses" in found.text
    assert line.written


@pytest.mark.parametrize("way", WAYS)
def test_a_stop_that_is_not_confirmed_is_unknown(monkeypatch: pytest.MonkeyPatch, way: str) -> None:
    line, drive, _ = one(monkeypatch, InnovertIBD(1))
    line.loses = is_write
    assert WAYS[way](drive)[drive.name].outcome is CommandOutcome.UNKNOWN


@pytest.mark.slow
def test_of_many_stops_of_a_silent_drive_one_is_repeated(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Each is sent after its call, and all have the answer of the one that is repeated."""
    repeated: list[float | None] = []

    def noted(seconds: float | None, work: Callable[..., dict[str, CommandAnswer]], of: object) -> Any:
        repeated.append(seconds)
        return work(of, seconds)

    for name in ("_stop_line", "stop_drive"):
        work = getattr(stop_desk, name)
        monkeypatch.setattr(stop_desk, name, lambda of, seconds, work=work: noted(seconds, work, of))

    async def stopped(desk: Desks) -> list[CommandAnswer | None]:
        desk.sim.deaf_until = inf
        called = [asyncio.create_task(desk.stop())]
        async with asyncio.timeout(PATIENCE):
            while not desk.lines.for_stop(LINE).bus.stops_under_way():  # type: ignore[union-attr]
                await asyncio.sleep(0.002)
            called += [asyncio.create_task(desk.stop()) for _ in range(8)]
            while len(repeated) < 3 or desk.stops._repeated._sent:
                await asyncio.sleep(0.002)
        desk.sim.deaf_until = 0.0
        return await asyncio.gather(*called)

    with desks(tmp_path) as desk:
        answers = asyncio.run(stopped(desk))
    assert [answer.outcome for answer in answers if answer] == [CommandOutcome.DONE] * 9
    assert repeated == [None, 0.0, 0.0]  # the second of these for seven that waited for the first one's reply
