"""Answers to who asked for a stop, by what its drive did: none that was sent is told as unsent."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from simulated_bus import is_write, one

from multidrop import InnovertIBD
from multidrop.core import Message, build_reply
from multidrop.fleet.command_words import CommandAnswer, CommandOutcome
from multidrop.fleet.drive_commands import answers_of_stops, stop_drive

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
