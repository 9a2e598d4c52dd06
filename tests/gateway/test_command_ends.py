"""Results of commands, the end time of each drive's latest command, and computed channels in a gateway."""

from __future__ import annotations

import asyncio
import json
import math
import struct
import time
from collections.abc import Awaitable, Callable
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from gateways import served
from lines import until
from modbus_gateway import plant_of, serving
from simulated_bus import one
from tables import table

from multidrop import Bus, InvtCHE, Plant
from multidrop.channels import Channel
from multidrop.control import CommandOutcome, CommandResult, Ledger
from multidrop.gateway import commands as commands_module
from multidrop.gateway.commands import Commands
from multidrop.gateway.http.rights import Caller, May, Right
from multidrop.gateway.live.hub import Hub, published_values
from multidrop.gateway.live.views import drive_view
from multidrop.gateway.modbus_server.settings import ModbusSettings
from multidrop.plant.model import PlantLine, PolledDrive

CALLER = Caller("anna", "http", "10.0.0.7", Right.WRITE)
DONE = CommandResult(CommandOutcome.DONE, "done")
MAY = May(write=frozenset({"mill.setpoint"}), verbs=frozenset({"mill.start"}))


class UnopenedLines:
    """Fake lines with two drives and no open port, so that each command ends with a failure."""

    plant: Plant = plant_of(("hall", InvtCHE(1, name="mill")), ("hall", InvtCHE(2, name="fan")), polled=False)

    def bus(self, line: str) -> Bus:
        raise ValueError(f"line {line} is not open")

    @property
    def plant_now(self) -> Plant:
        return self.plant

    @property
    def plant_coming(self) -> None:
        return None  # no reload in progress


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
def test_the_end_time_of_the_last_command_to_a_drive_is_stored(command: Callable[[Commands], Any]) -> None:
    commands = Commands(UnopenedLines(), MAY)
    assert commands.ended_ns("mill") == 0
    begun_ns = time.monotonic_ns()
    asyncio.run(command(commands))
    assert begun_ns <= commands.ended_ns("mill") <= time.monotonic_ns()


async def test_a_pause_between_two_clock_reads_never_makes_the_deadline_of_a_write_later(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Here both clocks show the same time, and the process is suspended for a second before each read."""
    times = count(0, 10**9)
    deadlines: list[float] = []

    def begin(work: object, limit_ns: Callable[[], float], why_not: object) -> Any:
        deadlines.append(limit_ns())
        return asyncio.get_running_loop().create_task(asyncio.sleep(0, DONE))

    for clock in ("now_ns", "boottime_ns"):
        monkeypatch.setattr(commands_module, clock, lambda: next(times))
    monkeypatch.setattr(commands_module, "begin_command", begin)
    commands = Commands(UnopenedLines(), MAY)
    until_ns = 10**12
    assert await commands.write("mill", "setpoint", 10.0, CALLER, lambda what: until_ns) == DONE
    assert len(deadlines) == 1
    assert deadlines[0] <= until_ns


@pytest.mark.parametrize(
    "command",
    [
        lambda commands: commands.write("mill", "setpoint", 10.0, CALLER),
        lambda commands: commands.act("mill", "start", {}, CALLER),
    ],
    ids=["a write", "a verb"],
)
async def test_the_error_of_a_command_names_the_removed_drive(
    command: Callable[[Commands], Awaitable[CommandResult]],
) -> None:
    told = await command(Commands(UnopenedLines(), MAY))
    assert not told.ok
    assert told.text.startswith("mill is ")


@table(
    "value",
    [10**400, -(10**400), float("inf"), float("nan"), 1.5],
    ids=["huge", "huge below 0", "inf", "nan", "1.5"],
)
@table("register", ["setpoint", "control"])
def test_an_invalid_number_in_a_write_is_reported(register: str, value: float) -> None:
    """JSON allows integers that are too large for a float."""
    line, mill, _ = one(InvtCHE(1, name="mill", maximum_frequency=50))
    lines = UnopenedLines()
    lines.plant = plant_of(("hall", mill))
    may = May(write=frozenset({"mill.control", "mill.setpoint"}))
    told = asyncio.run(Commands(lines, may).write("mill", register, value, CALLER))
    assert told.ok == (register == "setpoint" and value == 1.5)
    assert told.text.startswith(("mill: setpoint", "setpoint ", "control takes"))
    assert len(line.written) == told.ok


async def test_a_refused_command_has_no_end_time() -> None:
    commands = Commands(UnopenedLines(), MAY)
    await commands.write("fan", "setpoint", 10.0, CALLER)
    assert commands.ended_ns("fan") == 0


@pytest.mark.parametrize("verb", ["stop", "coast"])
async def test_only_stops_accept_another_unicode_spelling_of_a_drive_name(verb: str) -> None:
    """A u with two dots is one character (U+00FC) on some keyboards, and two (U+0075 U+0308) on others."""
    fan, spelt = "L\u00fcfter", "Lu\u0308fter"
    line, known, _ = one(InvtCHE(1, name=fan, maximum_frequency=50))
    lines = UnopenedLines()
    lines.plant = plant_of(("hall", known))
    lines.bus = lambda name: known.bus  # type: ignore[method-assign, assignment, return-value]
    may = May(write=frozenset({f"{spelt}.setpoint"}), verbs=frozenset({f"{spelt}.start", f"{fan}.coast"}))
    commands = Commands(lines, may)
    assert not (await commands.act(spelt, "start", {}, CALLER)).ok
    assert not (await commands.write(spelt, "setpoint", 10.0, CALLER)).ok
    assert line.written == []
    stopped = await commands.stop([spelt], CALLER) if verb == "stop" else {}
    for told in (*stopped.values(), await commands.act(spelt, verb, {}, CALLER)):
        assert told.ok, told.text
    assert [*stopped] == [spelt] * (verb == "stop")
    assert line.written
    assert commands.stopped_ns(fan) is not None


async def test_the_view_of_a_drive_is_found_by_another_unicode_spelling_of_its_name(tmp_path: Path) -> None:
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


# ---- computed channels in a gateway: on the page, in metrics, MQTT, Modbus TCP and limits ----


CHANNELS = """
[[line.drive.channel]]
name = "half"
value = "output_frequency / 2 + 25"
unit = "Hz"
[[line.drive.channel]]
name = "charge"
value = "integral(output_current + pump-1.output_current)"
unit = "A*h"
[[serve.limit]]
drive = "pump-2"
register = "half"
above = 10
"""


@pytest.mark.slow
def test_computed_channels_appear_on_the_page_in_metrics_and_in_mqtt(tmp_path: Path) -> None:
    with served(tmp_path, CHANNELS) as gateway:
        until(lambda: gateway.frame()["drives"]["pump-2"]["values"]["half"][0] == 25.0)
        drive = gateway.get("/api/plant").json["lines"][0]["drives"][1]
        about = next(register for register in drive["registers"] if register["name"] == "charge")
        assert (about["unit"], about["access"], about["note"][:19]) == (
            "A*h",
            "reading",
            "computed: integral(",
        )
        assert about["period_s"] == 0.1
        metrics = gateway.get("/metrics").body.decode()
        assert 'multidrop_register_hertz{line="hall",drive="pump-2",register="half"} 25' in metrics
        hub = gateway.gateway.hub
        assert published_values(hub, "pump-2")["half"] == 25.0
        until(lambda: any("half above 10 Hz" in alarm["text"] for alarm in gateway.frame()["alarms"]))
        gateway.sims["pump-2"].deaf_until = math.inf
        gateway.await_state("pump-2", "silent")
        assert published_values(hub, "pump-2")["half"] is None
    kept = json.loads((tmp_path / "plant.simulated.totals.json").read_text())
    assert kept["pump-2.charge"]["value"].startswith("integral(")


def with_channels() -> Plant:
    """Return a plant whose drive has two computed channels."""
    drive = InvtCHE(1, name="mill")
    channels = (
        Channel("power", "output_voltage * output_current", "W"),
        Channel("starts", "count(status == 1)"),
    )
    polled = PolledDrive(drive, ["output_voltage", "output_current", "status"], channels=channels)
    return Plant([PlantLine("hall", "/dev/hall", drives=[polled])], Path("plant.toml"))


def test_a_computed_channel_stays_fresh_as_long_as_its_slowest_input() -> None:
    slow = PolledDrive(InvtCHE(1, name="fan"), ["output_voltage"], every=60)
    channels = Channel("other", "fan.output_voltage", "V"), Channel("own", "output_voltage", "V")
    fast = PolledDrive(InvtCHE(1, name="mill"), ["output_voltage"], every=1, channels=channels)
    lines = [PlantLine("hall", "/dev/hall", drives=[fast]), PlantLine("roof", "/dev/roof", drives=[slow])]
    hub = Hub(Plant(lines, Path("plant.toml")))
    assert [hub.holds_s("mill", name) for name in ("other", "own")] == [180, 3]


def test_modbus_clients_read_computed_channels_as_floats() -> None:
    with (
        serving(with_channels(), ModbusSettings(listen="127.0.0.1:0")) as gateway,
        gateway.client() as client,
    ):
        gateway.hub.values[("mill", "power")] = 1234.5
        words = client.ask(1, 3, 0xF100, 4).words
        power, starts = struct.unpack(">2f", struct.pack(">4H", *words))
        assert power == 1234.5
        assert math.isnan(starts)
        assert client.ask(1, 4, 0xF102, 2).words == [0x7FC0, 0]
        assert client.ask(1, 3, 0xF103, 2).code == 2  # beyond the last computed channel
        gateway.hub.values[("mill", "starts")] = 1e300
        assert client.ask(1, 3, 0xF102, 2).words == [0x7F80, 0]
    assert gateway.line.asked == []


@pytest.mark.parametrize("channels", [0xF00E, 0xFFFE, 0x3003])
def test_overlapping_modbus_addresses_of_computed_channels_are_reported(channels: int) -> None:
    (sentence,) = ModbusSettings(channels=channels).check(with_channels())
    assert sentence.startswith("mill: the 4 words of its channels do not fit at ")
    assert ModbusSettings(channels=channels).check(plant_of(("hall", InvtCHE(1, name="mill")))) == []
