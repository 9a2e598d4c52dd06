"""The time when a drive's latest command ended, and outcomes of commands, for all interfaces."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from modbus_gateway import plant_of
from simulated_bus import one
from tables import table

from multidrop import Bus, InvtCHE, Plant
from multidrop.control import CommandResult, Ledger
from multidrop.gateway.commands import Commands
from multidrop.gateway.http.rights import Caller, May, Right
from multidrop.gateway.live.views import drive_view

CALLER = Caller("anna", "http", "10.0.0.7", Right.WRITE)
MAY = May(write=frozenset({"mill.setpoint"}), verbs=frozenset({"mill.start"}))


class UnopenedLines:
    """A plant of two drives whose line is not polled: each command fails, and so ends."""

    plant: Plant = plant_of(("hall", InvtCHE(1, name="mill")), ("hall", InvtCHE(2, name="fan")), polled=False)

    def bus(self, line: str) -> Bus:
        raise ValueError(f"line {line} is not open")

    @property
    def plant_now(self) -> Plant:
        return self.plant

    @property
    def plant_coming(self) -> None:
        return None  # no reload is in progress


@table(
    "command",
    [
        lambda commands: commands.write("mill", "setpoint", 10.0, CALLER),
        lambda commands: commands.act("mill", "start", {}, CALLER),
        lambda commands: commands.stop(["mill"], CALLER),
        lambda commands: commands.stop(None, CALLER),
    ],
    ids=["a write", "a verb", "a stop", "a stop of all"],
)
def test_time_of_the_latest_commands_end_is_known(command: Callable[[Commands], Awaitable[Any]]) -> None:
    commands = Commands(UnopenedLines(), MAY)
    assert commands.ended_ns("mill") == 0
    begun_ns = time.monotonic_ns()

    async def carry_out() -> None:
        await command(commands)

    asyncio.run(carry_out())
    assert begun_ns <= commands.ended_ns("mill") <= time.monotonic_ns()


@pytest.mark.parametrize(
    "command",
    [
        lambda commands: commands.write("mill", "setpoint", 10.0, CALLER),
        lambda commands: commands.act("mill", "start", {}, CALLER),
    ],
    ids=["a write", "a verb"],
)
def test_result_names_a_drive_that_was_removed_from_its_line(
    command: Callable[[Commands], Awaitable[CommandResult]],
) -> None:
    async def carry_out() -> CommandResult:
        return await command(Commands(UnopenedLines(), MAY))

    told = asyncio.run(carry_out())
    assert not told.ok
    assert told.text.startswith("mill is ")


@pytest.mark.parametrize(
    "value",
    [10**400, -(10**400), float("inf"), float("nan"), 1.5],
    ids=["huge", "huge below 0", "inf", "nan", "1.5"],
)
@pytest.mark.parametrize("register", ["setpoint", "control"])
def test_an_invalid_number_is_reported(register: str, value: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """JSON allows integers that are too large for a float."""
    line, mill, _ = one(monkeypatch, InvtCHE(1, name="mill", maximum_frequency=50))
    lines = UnopenedLines()
    lines.plant = plant_of(("hall", mill))
    may = May(write=frozenset({"mill.control", "mill.setpoint"}))

    async def carry_out() -> CommandResult:
        return await Commands(lines, may).write("mill", register, value, CALLER)

    told = asyncio.run(carry_out())
    assert told.ok == (register == "setpoint" and value == 1.5)
    assert told.text.startswith(("mill: setpoint", "setpoint ", "control takes"))
    assert len(line.written) == told.ok


async def test_refused_command_has_no_end_time() -> None:
    commands = Commands(UnopenedLines(), MAY)
    await commands.write("fan", "setpoint", 10.0, CALLER)
    assert commands.ended_ns("fan") == 0


@pytest.mark.parametrize("verb", ["stop", "coast"])
def test_other_unicode_spelling_of_a_drive_works_for_stops_only(
    verb: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Depending on the keyboard, a u with two dots is one character (U+00FC) or two (U+0075 U+0308)."""
    fan, spelt = "L\u00fcfter", "Lu\u0308fter"
    line, known, _ = one(monkeypatch, InvtCHE(1, name=fan, maximum_frequency=50))
    lines = UnopenedLines()
    lines.plant = plant_of(("hall", known))
    lines.bus = lambda name: known.bus  # type: ignore[method-assign, assignment, return-value]
    may = May(write=frozenset({f"{spelt}.setpoint"}), verbs=frozenset({f"{spelt}.start", f"{fan}.coast"}))
    commands = Commands(lines, may)

    async def carry_out() -> list[CommandResult]:
        started = [
            await commands.act(spelt, "start", {}, CALLER),
            await commands.write(spelt, "setpoint", 10.0, CALLER),
        ]
        assert line.written == []
        assert {told.ok for told in started} == {False}
        if verb == "stop":
            stopped = await commands.stop([spelt], CALLER)
            assert [*stopped] == [spelt]
            return [stopped[spelt], await commands.act(spelt, verb, {}, CALLER)]
        return [await commands.act(spelt, verb, {}, CALLER)]

    for told in asyncio.run(carry_out()):
        assert told.ok, told.text
    assert line.written
    assert commands.stopped_ns(fan) is not None


async def test_view_of_a_drive_is_found_by_another_unicode_spelling(tmp_path: Path) -> None:
    gateway: Any = SimpleNamespace(
        plant=plant_of(("hall", InvtCHE(1, name="L\u00fcfter"))),
        ledger=Ledger(tmp_path / "wear.sqlite"),
        poller=None,
        side_reads=SimpleNamespace(look=lambda plant, name: {"of": name}),
        recent=SimpleNamespace(drive=lambda line, name: None),
    )
    found = await drive_view(gateway, "Lu\u0308fter")
    assert found["drive"] == "L\u00fcfter"
    assert found["values"] == {"of": "L\u00fcfter"}
