"""Registers whose documents state no scale: raw counts are never reported in amperes, volts or hertz."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest
from lines import line, plant, polled

from multidrop import Drive, PolledDrive, reading, setting
from multidrop.core import NumberFormat
from multidrop.families import MODELS, DelixiModbus, InvtCHE
from multidrop.gateway.live.descriptions import describe_line
from multidrop.gateway.live.hub import Hub, Known, Newest
from multidrop.gateway.metrics import OTHER, base_unit, plant_families
from multidrop.gateway.modbus_server.common_block import CURRENT, FREQUENCY, NO_NUMBER, SETPOINT, CommonBlock
from multidrop.gateway.mqtt.home_assistant import discovery


class FullHub(Hub):
    """A hub in which every polled register has a fresh value of 25."""

    def newest(self, drive: str, register: str) -> Newest | None:
        return Newest(1, 1, 25.0, "ok", 1)

    def known(self, drive: str) -> Iterator[Known]:
        for register, *_ in super().known(drive):
            yield register, (1, 1, 25.0, 0), (1, 1, 25.0, 0), True


class Fan(Drive):
    """A user's own drive, whose manual states a unit but no scale."""

    pressure = setting(1, "Pa", step=None, moves=False)


def described(*drives: PolledDrive) -> dict[str, Any]:
    hub = Hub(plant(line("/dev/null", *drives)))
    return describe_line(hub, hub.plant.lines[0])


def number(words: list[int], at: int) -> int:
    return int.from_bytes(bytes([*divmod(words[at], 256), *divmod(words[at + 1], 256)]), "big", signed=True)


@pytest.mark.parametrize("model", MODELS)
def test_only_scaled_values_have_a_unit(model: str) -> None:
    drive = MODELS[model](1)
    for register in described(polled(drive, drive.readings()))["drives"][0]["registers"]:
        known = drive.registers[register["name"]]
        assert register["unit"] == ("raw count" if known.step is None else known.unit)
        if known.writable and known.values is None:  # the page's dialog needs a range
            assert register["least"] < register["most"], known.name
            known.encode(register["least"])
            known.encode(register["most"])
            assert (register["at_least"], register["at_most"]) == (known.at_least, known.at_most)


def test_the_common_block_has_no_number_for_a_raw_count() -> None:
    delixi, che = DelixiModbus(1, name="fan"), InvtCHE(2, name="pump", maximum_frequency=50)
    names = ("output_frequency", "output_current")
    drives = [polled(drive, [drive.registers[name] for name in names]) for drive in (delixi, che)]
    hub = FullHub(plant(line("/dev/null", *drives)))
    (fan, pump) = (CommonBlock(each).words(hub, 1) for each in drives)
    assert [number(fan, at) for at in (FREQUENCY, CURRENT, SETPOINT)] == [2500, NO_NUMBER, NO_NUMBER]
    assert [number(pump, at) for at in (FREQUENCY, CURRENT, SETPOINT)] == [2500, 2500, NO_NUMBER]


def test_metric_of_raw_counts_is_named_raw() -> None:
    drive = DelixiModbus(1, name="fan")
    hub = FullHub(plant(line("/dev/null", polled(drive, [drive.output_frequency, drive.output_current]))))
    found = {
        family.name: [labels["register"] for _, labels, _ in family.samples]
        for family in plant_families(hub, {})
        if family.name.startswith("multidrop_register_") and "age" not in family.name
    }
    assert found == {
        "multidrop_register_hertz": ["output_frequency"],
        "multidrop_register_raw": ["output_current"],
    }


def test_metrics_are_in_base_units() -> None:
    registers = {
        register.value_unit: base_unit(register)
        for family in MODELS.values()
        for register in family.registers.values()
        if register.values is None
    }
    assert {unit for unit, base in registers.items() if base is OTHER} == set()
    assert (registers["V"], registers["%"]) == (("volts", 1.0), ("ratio", 0.01))
    assert base_unit(reading(0, "kW")) == ("watts", 1000.0)
    assert base_unit(reading(0, "m³/h")) is OTHER
    assert base_unit(InvtCHE(1).status).name == "code"


def test_home_assistant_number_of_raw_counts_has_that_unit() -> None:
    topics = dict.fromkeys(("set", "stop", "state", "gateway", "available"), "topic")
    details = {"prefix": "", "version": "1", "every_s": 1.0, "writable": ["pressure"], "takes_commands": True}
    found = json.loads(discovery(Fan(1), [Fan.pressure], topics, **details))  # type: ignore[arg-type]
    assert found["cmps"]["pressure_set"]["unit_of_measurement"] == "raw count"
    assert "unit_of_measurement" not in found["cmps"]["pressure"]


class Transmitter(Drive):
    """A user's own device, whose registers have different numbers of digits."""

    pressure = setting(1, "Pa", number_format=NumberFormat.F32, moves=False)
    level = setting(3, "m", step=0.01, moves=False)
    power = reading(4, "W", scale_register="power_scale")
    power_scale = reading(5, number_format=NumberFormat.I16)


def test_description_gives_no_digits_for_a_float() -> None:
    told = described(polled(Transmitter(1), Transmitter.readings()))
    registers = {each["name"]: each for each in told["drives"][0]["registers"]}
    assert [registers[name]["digits"] for name in ("pressure", "level", "power")] == [None, 2, None]
    assert [registers[name]["step"] for name in ("pressure", "level")] == [None, 0.01]


def test_home_assistant_gets_no_precision_for_a_float() -> None:
    topics = dict.fromkeys(("set", "stop", "state", "gateway", "available"), "topic")
    details = {"prefix": "", "version": "1", "every_s": 1.0, "writable": ["pressure", "level"]}
    drive = Transmitter(1, name="tank")
    said = json.loads(discovery(drive, drive.registers.values(), topics, takes_commands=True, **details))
    parts = said["cmps"]
    shown = [parts[name].get("suggested_display_precision") for name in ("pressure", "level", "power")]
    assert shown == [None, 2, None]
    assert [parts[f"{name}_set"]["step"] for name in ("pressure", "level")] == [0.001, 0.01]
