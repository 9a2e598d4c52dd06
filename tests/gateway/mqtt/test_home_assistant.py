"""The messages by which Home Assistant discovers the drives and their components."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from enum import IntEnum
from typing import Any

from brokers import Broker, Listener, Start, has, publish
from peers import require_module
from tables import table

from multidrop import Drive, InvtCHE
from multidrop.channels import Channel
from multidrop.drive.number_format import NumberFormat
from multidrop.drive.register import Register, reading, setting
from multidrop.families import MODELS
from multidrop.gateway.mqtt.home_assistant import discovery, discovery_topic


def configured(drive: Drive, polled: Iterable[Register[Any]], writable: Sequence[str], page: str = "") -> Any:
    """Return the message by which Home Assistant discovers a drive."""
    topics = {name: f"multidrop/{name}" for name in ("state", "gateway", "available", "set", "stop")}
    details: Any = {"prefix": "works", "version": "1", "every_s": 1.0, "takes_commands": True, "page": page}
    return json.loads(discovery(drive, polled, topics, writable=writable, **details))


def rendered(part: dict[str, Any], said: dict[str, Any]) -> str:
    jinja2 = require_module("jinja2")
    return str(jinja2.Environment().from_string(part["value_template"]).render(value_json=said))


def command_of(part: dict[str, Any], value: object) -> str:
    """Return the message that Home Assistant publishes for a new value of a component."""
    template = require_module("jinja2").Environment().from_string(part["command_template"])
    return str(template.render(value=value, now=lambda: datetime.now(UTC)))


def test_home_assistant_discovers_each_drive(broker: Broker, listener: Listener, start: Start) -> None:
    start(home_assistant=True, commands=True, every="2 s")
    said = listener.wait_for(has("homeassistant/device/multidrop-pump-1/config"))
    found = said.json
    assert found["availability"] == [{"topic": "multidrop/gateway"}, {"topic": "multidrop/pump-1/available"}]
    parts = found["cmps"]
    assert set(parts) == {
        *("state", "problem", "running", "output_frequency", "status", "setpoint_set", "stop")
    }
    assert len({part["unique_id"] for part in parts.values()}) == len(parts)
    sensor = parts["output_frequency"]
    assert (sensor["unit_of_measurement"], sensor["device_class"]) == ("Hz", "frequency")
    assert sensor["expire_after"] == parts["state"]["expire_after"] == 6
    assert "unit_of_measurement" not in parts["status"]
    assert parts["setpoint_set"]["command_topic"] == "multidrop/pump-1/set/setpoint"


def test_a_write_made_from_the_home_assistant_template_is_carried_out(
    broker: Broker, listener: Listener, start: Start
) -> None:
    known, _ = start(home_assistant=True, commands=True)
    said = listener.wait_for(has("homeassistant/device/multidrop-pump-1/config"))
    part = said.json["cmps"]["setpoint_set"]
    publish(broker, part["command_topic"], command_of(part, 12.5).encode())
    assert listener.wait_for(has("multidrop/pump-1/told")).json["done"]
    assert known.commands.noted == [("write", "pump-1", "setpoint", 12.5)]


def test_home_assistant_object_ids_of_different_drives_differ(listener: Listener, start: Start) -> None:
    start(home_assistant=True)
    ids = {
        listener.wait_for(lambda received: received.topic.startswith("homeassistant/")).topic
        for _ in range(2)
    }
    assert len(ids) == 2
    assert all(topic.isascii() for topic in ids)


class Meter(Drive):
    title = "ACME M-1"
    net_energy = reading(0x0000, "kWh", number_format=NumberFormat.I32)
    total_energy = reading(0x0002, "kWh", number_format=NumberFormat.U32)
    float_energy = reading(0x0004, "kWh", number_format=NumberFormat.F32)
    generated = reading(0x0006, "MWh", number_format=NumberFormat.U32)


def test_an_energy_register_is_declared_increasing_only_if_it_cannot_fall() -> None:
    parts = configured(Meter(1), Meter.registers.values(), [])["cmps"]
    assert {name: parts[name]["state_class"] for name in Meter.registers} == {
        "net_energy": "total",
        "total_energy": "total_increasing",
        "float_energy": "total",
        "generated": "total_increasing",
    }
    assert {parts[name]["device_class"] for name in Meter.registers} == {"energy"}


def test_the_computed_energy_of_a_channel_is_not_declared_increasing() -> None:
    energy = Channel("energy", "integral(output_power)", "kWh").register
    assert configured(Meter(1), [energy], [])["cmps"]["energy"]["state_class"] == "total"


class Transmitter(Drive):
    """A user's own device class. Its registers have different numbers of decimals."""

    pressure = setting(1, "Pa", number_format=NumberFormat.F32, moves=False)
    level = setting(3, "m", step=0.01, moves=False)
    count = setting(4, "Pa", step=None, moves=False)  # its manual states a unit but no scale
    power = reading(5, "W", scale_register="power_scale")
    power_scale = reading(6, number_format=NumberFormat.I16)


def test_home_assistant_shows_values_with_the_decimals_of_their_register() -> None:
    names = ("pressure", "level", "count")
    parts = configured(Transmitter(1), Transmitter.registers.values(), names)["cmps"]
    shown = [parts[name].get("suggested_display_precision") for name in ("pressure", "level", "power")]
    assert shown == [None, 2, None]
    assert [parts[f"{name}_set"]["step"] for name in ("pressure", "level")] == [0.001, 0.01]


def test_home_assistant_shows_values_of_unknown_scale_as_raw_counts() -> None:
    parts = configured(Transmitter(1), [Transmitter.count], ["count"])["cmps"]
    assert parts["count_set"]["unit_of_measurement"] == "raw count"
    assert "unit_of_measurement" not in parts["count"]


# For each platform: the keys that Home Assistant requires, and the optional keys that we use. Source: Home
# Assistant's documentation of MQTT, version 2026.11 (device discovery, sensor, binary sensor, number, select,
# button).
HA_KEYS = {
    "sensor": (
        {"state_topic"},
        {"value_template", "expire_after", "device_class", "options", "state_class", "entity_category"}
        | {"unit_of_measurement", "suggested_display_precision"},
    ),
    "binary_sensor": ({"state_topic"}, {"value_template", "expire_after", "device_class"}),
    "number": (
        {"command_topic", "min", "max"},  # without min and max, Home Assistant allows 1 to 100
        {"state_topic", "value_template", "command_template", "retain", "step", "mode", "entity_category"}
        | {"unit_of_measurement"},
    ),
    "select": (
        {"command_topic", "options"},
        {"state_topic", "value_template", "command_template", "retain", "entity_category"},
    ),
    "button": ({"command_topic"}, {"payload_press", "availability"}),
}


def check_components(found: Any) -> None:
    # only the components of a device may have these keys
    assert not {"state_topic", "command_topic", "value_template"} & found.keys()
    assert found["dev"]["ids"]
    for part in found["cmps"].values():
        needed, known = HA_KEYS[part["p"]]
        given = part.keys() - {"p", "unique_id", "name"}
        assert needed <= given <= needed | known
        assert ("state_topic" in part) == ("value_template" in part)
        if part["p"] == "number":
            assert part["min"] < part["max"]
            assert part["step"] >= 0.001
        if part.get("device_class") == "enum":
            assert part["options"]
            assert not {"unit_of_measurement", "state_class"} & part.keys()
        assert part.get("entity_category") in (None, "diagnostic", *["config"] * (part["p"] != "sensor"))
    ids = [part["unique_id"] for part in found["cmps"].values()]
    assert len(set(ids)) == len(ids)


@table("model", MODELS)
def test_components_of_each_family_have_valid_home_assistant_keys(model: str) -> None:
    drive = MODELS[model](1, name="pump-1")
    polled = [one for one in drive.registers.values() if one.readable]
    writable = [one.name for one in drive.registers.values() if one.writable]
    found = configured(drive, polled, writable)
    check_components(found)
    assert len(found["cmps"]) == 4 + len(polled) + len(writable)


class Awkward(Drive):
    """A user's drive class whose registers have the names of Home Assistant components of the gateway."""

    title = "ACME A-1"
    running = reading(1, "Hz")
    problem = reading(2, "V")
    value = reading(3, "A")
    level = setting(4, "m", moves=False)
    level_set = reading(5, "m")
    mode = setting(6, values=IntEnum("Mode", {"SLOW": 1, "FAST": 7}), moves=False)


def test_registers_named_like_home_assistant_components_get_other_keys() -> None:
    found = configured(
        Awkward(1, name="a"), Awkward.registers.values(), ["level", "mode"], "http://hall:8750"
    )
    check_components(found)
    assert found["dev"] == {
        **{"ids": "works-a", "name": "a", "mdl": "ACME A-1", "mf": "ACME", "cu": "http://hall:8750"}
    }
    parts = {part["unique_id"]: part for part in found["cmps"].values()}
    assert parts["works-a-running"]["p"] == "binary_sensor"
    assert parts["works-a-running-value"]["unit_of_measurement"] == "Hz"
    assert parts["works-a-level-set"]["state_topic"] == "multidrop/state"
    assert (parts["works-a-level-set"]["min"], parts["works-a-level-set"]["max"]) == (0, 65535)
    mode = parts["works-a-mode-set"]
    assert (mode["p"], mode["options"]) == ("select", ["SLOW", "FAST"])
    assert json.loads(command_of(mode, "FAST"))["value"] == 7


def test_a_home_assistant_number_of_an_unpolled_register_has_no_state() -> None:
    part = configured(InvtCHE(1, name="a"), [], ["setpoint"])["cmps"]["setpoint_set"]
    assert not {"state_topic", "value_template"} & part.keys()


@table(
    ("state", "problem", "running"),
    [
        ("runs", "OFF", "ON"),
        ("stands", "OFF", "OFF"),
        ("fault", "ON", "None"),
        ("unknown", "None", "None"),
        ("silent", "None", "None"),
    ],
)
def test_home_assistant_sensors_follow_the_drives_state(state: str, problem: str, running: str) -> None:
    parts = configured(InvtCHE(1, name="a"), [], [])["cmps"]
    assert [rendered(parts[key], {"state": state}) for key in ("problem", "running")] == [problem, running]
    assert rendered(parts["state"], {"state": state}) in parts["state"]["options"]


def test_a_status_value_without_a_name_is_shown_as_unknown_in_home_assistant() -> None:
    """Home Assistant ignores a state outside the options, and would keep showing the previous one."""
    part = configured(InvtCHE(1, name="a"), [InvtCHE.status], [])["cmps"]["status"]
    values = [rendered(part, {"values": {"status": value}}) for value in ("FORWARD", "77", None)]
    assert values == ["FORWARD", "None", "None"]


def test_the_home_assistant_stop_button_is_available_while_its_drive_is_silent() -> None:
    parts = configured(InvtCHE(1, name="a"), [], [])["cmps"]
    assert parts["stop"]["availability"] == [{"topic": "multidrop/gateway"}]


def test_home_assistant_ids_of_two_gateways_differ() -> None:
    names = [("a-b", "c"), ("a", "b-c"), ("a_2d_b", "c"), ("a", "b_c"), ("a", "b c")]
    assert len({discovery_topic(*one) for one in names}) == len(names)
