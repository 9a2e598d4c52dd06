"""Import of Home Assistant's `modbus:`: layouts and types of all its versions, switches, and lines."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
from commands import Run
from imported import devices, entries, gaps, omissions, only
from tables import table

from multidrop.importers import ImportedDevice, plant_text, read_devices

pytest.importorskip("yaml")


def sensor(folder: Path, keys: str, kind: str = "sensors") -> ImportedDevice:
    """Return the device of a hub with one entity, `a` at address 5, which has these keys."""
    hub = f"modbus:\n  - name: hub\n    {kind}:\n      - {{name: a, slave: 1, address: 5, {keys}}}\n"
    return only(folder, "configuration.yaml", hub)


@table(
    ("keys", "number_format"),
    [
        ("data_type: int", "I16"),
        ("data_type: int, count: 2", "I32"),
        ("data_type: int, count: 4", "I64"),
        ("data_type: uint, count: 2", "U32"),
        ("data_type: float, count: 1", "F16"),
        ("data_type: float, count: 2", "F32"),
        ("data_type: float, count: 4", "F64"),
        ("data_type: float16", "F16"),
        ('data_type: custom, count: 2, structure: ">f"', "F32"),
        ('data_type: custom, count: 1, structure: ">H"', None),
    ],
)
def test_home_assistant_sensor_width_follows_count_or_structure(
    tmp_path: Path, keys: str, number_format: str | None
) -> None:
    device = sensor(tmp_path, keys)
    assert entries(device)["a"].get("number_format") == number_format
    assert gaps(device, "a") == []


def test_a_missing_or_contradictory_sensor_width_is_reported(tmp_path: Path) -> None:
    device = sensor(tmp_path, "data_type: float")
    assert entries(device)["a"]["number_format"] == "F16"
    assert "the width of its type float is not stated" in gaps(device, "a")[0]
    device = sensor(tmp_path, "data_type: int32, count: 3")
    assert gaps(device, "a") == ["its count 3 is not that of int32, which takes 2"]


@pytest.mark.parametrize("keys", ["data_type: int, count: 3", "data_type: uint8", "data_type: custom"])
def test_home_assistant_entity_of_unsupported_type_is_refused(tmp_path: Path, keys: str) -> None:
    with pytest.raises(ValueError, match=r"a: its type \w+ has no number format"):
        sensor(tmp_path, keys)


def test_home_assistant_count_is_shared_by_all_virtual_entities(tmp_path: Path) -> None:
    """See home-assistant/core#97744."""
    found = entries(sensor(tmp_path, "slave_count: 2, count: 6, data_type: int32, swap: word"))
    assert [entry["at"] for entry in found.values()] == [5, 7, 9]
    assert {(entry["number_format"], entry["order"]) for entry in found.values()} == {("I32", "CDAB")}


def test_home_assistant_reverse_order_swaps_the_words(tmp_path: Path) -> None:
    number = "data_type: float, count: 2"
    assert entries(sensor(tmp_path, f"{number}, reverse_order: true"))["a"]["order"] == "CDAB"
    assert "order" not in entries(sensor(tmp_path, f"{number}, reverse_order: false"))["a"]
    both = sensor(tmp_path, f"{number}, reverse_order: true, swap: byte")
    assert gaps(both, "a") == ["only its count is read: it has both swap byte and reverse_order"]


def test_home_assistant_nan_value_is_parsed_as_hex_without_a_prefix(tmp_path: Path) -> None:
    assert entries(sensor(tmp_path, 'nan_value: "7FFF"'))["a"]["invalid"] == 0x7FFF
    assert entries(sensor(tmp_path, 'nan_value: "0x8000"'))["a"]["invalid"] == 0x8000
    assert entries(sensor(tmp_path, "nan_value: 8000"))["a"]["invalid"] == 8000


def test_home_assistant_min_value_0_and_precision_0_are_reported(tmp_path: Path) -> None:
    assert gaps(sensor(tmp_path, "min_value: 0"), "a") == ["min_value was not carried over"]
    assert gaps(sensor(tmp_path, "precision: 0"), "a") == ["precision was not carried over"]


def test_home_assistant_unit_given_as_a_secret_is_reported(tmp_path: Path) -> None:
    device = sensor(tmp_path, "unit_of_measurement: !secret unit")
    assert "unit" not in entries(device)["a"]
    assert gaps(device, "a") == ["its unit is !secret unit"]


WRITTEN = "it is written there; what a write does is not known here"


@pytest.mark.parametrize("plural", ["holdings", "coils"])
def test_home_assistant_switch_is_read_from_the_table_that_it_writes(tmp_path: Path, plural: str) -> None:
    device = sensor(tmp_path, f"write_type: {plural}", "switches")
    assert entries(device)["a"].get("table", "holding") == plural.rstrip("s")
    assert gaps(device, "a") == [WRITTEN]


def test_home_assistant_switch_is_read_at_its_verify_address(tmp_path: Path) -> None:
    verify = "verify: {address: 9, input_type: input, state_on: 37, state_off: 36, delay: 1}"
    device = sensor(tmp_path, f"command_on: 24, command_off: 25, {verify}", "switches")
    assert entries(device)["a"] == {"at": 9, "table": "input"}
    assert gaps(device, "a") == [
        WRITTEN,
        "it is written at another address, 0005H",
        "it is on if its count is 37, and off if it is 36",
    ]


def test_brightness_and_colour_of_a_home_assistant_light_are_reported(tmp_path: Path) -> None:
    device = sensor(tmp_path, "brightness_address: 7, color_temp_address: 0", "lights")
    assert gaps(device, "a")[1:] == [
        "brightness_address was not carried over",
        "color_temp_address was not carried over",
    ]


SENSORS = "sensors:\n  - {name: volts, slave: 1, address: 1, data_type: float32}\n"
HUB = f"name: hub\ntype: tcp\nhost: 10.0.0.5\n{SENSORS}"


def indented(text: str, by: int) -> str:
    return "".join(f"{' ' * by}{line}\n" for line in text.splitlines())


@table(
    ("text", "port"),
    [
        (HUB, "tcp://10.0.0.5:502"),
        (f"modbus:\n{indented(HUB, 2)}", "tcp://10.0.0.5:502"),
        (f"modbus hall:\n{indented(HUB, 2)}", "tcp://10.0.0.5:502"),
        (f"meter:\n  modbus:\n{indented(HUB, 4)}", "tcp://10.0.0.5:502"),
        (f"homeassistant:\n  packages:\n    meter:\n      modbus:\n{indented(HUB, 8)}", "tcp://10.0.0.5:502"),
        ("- {name: volts, slave: 1, address: 1, data_type: float32}\n", "/dev/ttyUSB0"),
        ("modbus:\n  - sensors: {name: volts, slave: 1, address: 1, data_type: float32}\n", "/dev/ttyUSB0"),
    ],
)
def test_home_assistant_hub_is_found_in_every_layout(tmp_path: Path, text: str, port: str) -> None:
    device = only(tmp_path, "a.yaml", text)
    assert entries(device)["volts"] == {"at": 1, "number_format": "F32"}
    assert tomllib.loads(plant_text(device, "m.toml"))["line"][0]["port"] == port


LEGACY = """
modbus: {name: hub1, type: serial, port: /dev/ttyS0, method: rtu, baudrate: 9600, stopbits: 1, bytesize: 8,
         parity: N}
sensor:
  - platform: modbus
    registers:
      - {name: volts, hub: hub1, slave: 2, register: 40, register_type: input, count: 2, data_type: float,
         reverse_order: true}
  - platform: template
binary_sensor:
  - {platform: modbus, inputs: [{name: door, hub: hub1, slave: 2, address: 3, input_type: discrete_input}]}
switch:
  - platform: modbus
    coils: [{name: lamp, hub: hub1, slave: 2, coil: 7}]
    registers: [{name: fan, hub: hub1, slave: 2, register: 8, command_on: 1, command_off: 0,
                 verify_register: 9}]
"""


def test_home_assistant_platform_layout_of_before_2021_is_imported(tmp_path: Path) -> None:
    found: dict[str, Any] = {}
    for device in devices(tmp_path, "old.yaml", LEGACY):
        assert (device.address, device.line.port) == (2, "/dev/ttyS0")
        found |= entries(device)
    assert found == {
        "volts": {"at": 40, "table": "input", "number_format": "F32", "order": "CDAB"},
        "door": {"at": 3, "table": "discrete"},
        "fan": {"at": 9},
        "lamp": {"at": 7, "table": "coil"},
    }


@table(
    ("text", "reason"),
    [
        ("a: 1\nb: 2\n", "and is no hub and no list of sensors: its keys are a, b"),
        ("modbus: !include modbus.yaml\n", "`modbus:` stands in another file: !include modbus.yaml"),
        ("modbus:\n  - {type: tcp, host: h}\n", "`modbus:` has no sensors, binary_sensors"),
        ("modbus:\n  - sensors: !include s.yaml\n", "sensors: '!include s.yaml' stands in another file"),
        ("modbus:\n  - sensors: [{name: a, slave: 300, address: 1}]\n", "slave = '300' is not a unit id"),
        ("modbus:\n  - sensors: [{name: a}]\n", "a: it has no address"),
        (
            "modbus:\n  - sensors: [{name: a, address: x}]\n",
            "a: it cannot be read: address = 'x' is not a whole",
        ),
        ("[]", "it is list"),
        ("- {name: a, address: 1, data_type: string}\n", "a: it has no count"),
    ],
)
def test_invalid_home_assistant_document_raises_value_error(tmp_path: Path, text: str, reason: str) -> None:
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(ValueError, match=re.escape(reason)):
        read_devices(tmp_path / "a.yaml")


@table(
    ("hub", "port"),
    [
        ("type: tcp, host: !secret inverter, port: 502", "tcp://HOST:502"),
        ("type: rtuovertcp, host: !secret inverter, port: 4001", "socket://HOST:4001"),
        ("type: tcp, host: 10.0.0.5, port: !secret port", "tcp://10.0.0.5:502"),
        ("type: udp, host: 10.0.0.5, port: 502", "tcp://10.0.0.5:502"),
        ("type: serial, port: !secret port", "/dev/ttyUSB0"),
    ],
)
def test_an_unknown_home_assistant_host_is_replaced_by_a_placeholder(
    tmp_path: Path, hub: str, port: str
) -> None:
    device = only(tmp_path, "a.yaml", f"modbus:\n  - {{{hub}, sensors: [{{slave: 1, address: 1}}]}}\n")
    assert tomllib.loads(plant_text(device, "m.toml"))["line"][0]["port"] == port
    assert ("the hub: its type udp is not spoken here" in omissions(device)) == ("udp" in hub)


@pytest.mark.parametrize("unit", [0, 248, 255])
def test_a_home_assistant_slave_above_247_is_imported_only_on_tcp(
    run: Run, tmp_path: Path, unit: int
) -> None:
    source, family, plant = (tmp_path / name for name in ("a.yaml", "m.toml", "plant.toml"))
    hub = f"type: tcp, host: 10.0.0.5, sensors: [{{name: a, slave: {unit}, address: 1}}]"
    source.write_text(f"modbus:\n  - {{{hub}}}\n")
    assert run("import", source, "--out", family, "--plant", plant)[0] == 0
    assert tomllib.loads(family.read_text())["family"]["addresses"] == [0, 255]
    assert run("plan", plant)[0] == 0
    source.write_text(f"modbus:\n  - {{{hub.replace('tcp, host: 10.0.0.5', 'serial, port: /dev/ttyS0')}}}\n")
    with pytest.raises(ValueError, match=f"its address {unit} is valid only on Modbus TCP, and its port"):
        plant_text(read_devices(source)[0], "m.toml")


def test_home_assistant_hubs_with_the_same_name_can_be_selected(run: Run, tmp_path: Path) -> None:
    source = tmp_path / "a.yaml"
    source.write_text(
        "modbus:\n"
        "  - {name: hub, sensors: [{name: amp, slave: 1, address: 1}]}\n"
        "  - {name: hub, sensors: [{name: volt, slave: 1, address: 1}, {name: watt, address: 2}]}\n"
    )
    status, _, err = run("import", source)
    assert status == 2
    assert "devices, at 1 of 'hub', 1 of 'hub 2', an unknown address of 'hub 3'" in err
    for title, name in (("hub", "amp"), ("hub 2", "volt"), ("hub 3", "watt")):
        status, out, _ = run("import", source, "--title", title)
        assert (status, f"{name} = " in out) == (0, True)
