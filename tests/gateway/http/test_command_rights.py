"""Rights checked by Commands, for every interface that sends commands."""

from __future__ import annotations

import asyncio
import threading
from typing import Any, NoReturn

import pytest
from lines import PATIENCE
from modbus_gateway import plant_of

from multidrop import Drive, InvtCHE, Plant, WriteForbidden
from multidrop.control import CommandOutcome, CommandResult
from multidrop.gateway import commands
from multidrop.gateway.commands import BUSY, STOPPING, VERBS, Commands
from multidrop.gateway.http.rights import NEVER_THIS_WAY, NOT_ALLOWED, NOT_LISTED, Caller, May, Right

ALL = May(write=frozenset({"mill.setpoint"}), verbs=frozenset(f"mill.{verb}" for verb in VERBS))
WAYS = ("page", "http", "mqtt", "modbus")


class GuardedLines:
    """A plant with one drive, whose bus must never be requested: all commands here must be refused."""

    plant: Plant = plant_of(("hall", InvtCHE(1, name="mill")), polled=False)

    def bus(self, line: str) -> NoReturn:
        raise AssertionError("a command that nobody may send came to the line")

    @property
    def plant_now(self) -> Plant:
        return self.plant

    plant_coming = None


def rules_of(may: May, way: str, role: Right) -> dict[str, str | None]:
    """Return, for each command, the rule by which it is refused; None if its caller had all rights."""
    caller = Caller("anna", way, "10.0.0.7", role)

    async def carried_out() -> dict[str, Any]:
        control = Commands(GuardedLines(), may)  # type: ignore[arg-type]
        told: dict[str, Any] = {verb: await control.act("mill", verb, {}, caller) for verb in VERBS}
        told["write"] = await control.write("mill", "setpoint", 10.0, caller)
        stopped = await control.stop(["mill"], caller)
        return told | {"stop all": stopped["mill"]}

    return {
        what: told.error.rule if isinstance(told.error, WriteForbidden) else None
        for what, told in asyncio.run(carried_out()).items()
    }


@pytest.mark.parametrize("way", WAYS)
def test_callers_with_the_role_look_can_send_no_command(way: str) -> None:
    by_verb = NEVER_THIS_WAY if way == "modbus" else NOT_ALLOWED
    expected = dict.fromkeys(VERBS, by_verb) | {"write": NOT_ALLOWED, "stop all": NOT_ALLOWED}
    assert rules_of(ALL, way, Right.LOOK) == expected


@pytest.mark.parametrize("way", WAYS)
def test_callers_with_the_role_stop_can_only_stop(way: str) -> None:
    rules = rules_of(ALL, way, Right.STOP)
    moving = [rules[verb] for verb in VERBS if verb not in STOPPING]
    assert {*moving} == {NEVER_THIS_WAY if way == "modbus" else NOT_ALLOWED}
    assert rules["write"] == NOT_ALLOWED
    assert rules["stop all"] not in (NOT_ALLOWED, NOT_LISTED)


@pytest.mark.parametrize("way", WAYS)
def test_unlisted_writes_are_refused_to_writers(way: str) -> None:
    rules = rules_of(May(), way, Right.WRITE)
    listed = {verb: rules[verb] for verb in VERBS if verb != "stop"}
    assert {*listed.values()} == {NEVER_THIS_WAY if way == "modbus" else NOT_LISTED}
    assert rules["write"] == NOT_LISTED
    assert rules["stop all"] not in (NOT_ALLOWED, NOT_LISTED)


def test_verbs_over_modbus_are_refused_even_if_listed() -> None:
    """Modbus has no dialog in which a person could confirm a verb."""
    rules = rules_of(ALL, "modbus", Right.WRITE)
    assert {rules[verb] for verb in VERBS} == {NEVER_THIS_WAY}


def test_concurrent_writes_per_line_are_limited_and_stops_are_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each write uses a thread, so a blocked line could otherwise use any number of threads."""
    go_on = threading.Event()

    def slow(drive: Drive, **command: object) -> CommandResult:
        assert go_on.wait(PATIENCE)
        return CommandResult(CommandOutcome.DONE, "done")

    async def carry_out() -> None:
        control = Commands(GuardedLines(), ALL)  # type: ignore[arg-type]
        writer = Caller("anna", "http", "10.0.0.7", Right.WRITE)
        some = [asyncio.ensure_future(control.write("mill", "setpoint", at, writer)) for at in range(8)]
        await asyncio.sleep(0)  # all writes are in progress now
        for further in (
            control.write("mill", "setpoint", 9.0, writer),
            control.act("mill", "start", {}, writer),
        ):
            told = await further
            assert isinstance(told.error, WriteForbidden)
            assert told.error.rule == BUSY
        stopped = await control.stop(["mill"], writer)
        assert not isinstance(stopped["mill"].error, WriteForbidden)
        go_on.set()
        await asyncio.gather(*some)
        assert (await control.write("mill", "setpoint", 9.0, writer)).ok  # one of the writes has ended

    for work in ("write_register", "carry_out_verb"):
        monkeypatch.setattr(commands, work, slow)
    try:
        asyncio.run(carry_out())
    finally:
        go_on.set()
