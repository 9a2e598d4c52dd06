"""Import of wb-mqtt-serial's templates and configurations: subdevices, bits, invalid counts and texts."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from imported import devices, entries, gaps, omissions, only
from tables import table

from multidrop import load_family
from multidrop.importers import ImportedDevice, family_text, read_devices


def channel(folder: Path, **keys: Any) -> ImportedDevice:
    """Return the device of a template with one channel, the input register `a` at address 5."""
    given = {"name": "a", "reg_type": "input", "address": 5, **keys}
    return only(folder, "w.json", {"device": {"channels": [given]}})


VOLTAGE = {"name": "Voltage", "reg_type": "input", "address": "0x0010", "format": "u16", "scale": 0.1}
ENERGY = {"name": "Energy", "reg_type": "input", "address": 32, "format": "u32"}


def with_subdevice(*channels: dict[str, Any], **inner: Any) -> dict[str, Any]:
    device = {"channels": [VOLTAGE, ENERGY], **inner}
    return {"device": {"channels": list(channels), "subdevices": [{"device_type": "ch", "device": device}]}}


def places(device: ImportedDevice) -> list[tuple[str, int]]:
    return [(register.name, register.address) for register in device.registers]


def test_registers_of_a_wb_mqtt_subdevice_are_shifted_for_each_channel(tmp_path: Path) -> None:
    first = {"name": "First", "device_type": "ch", "shift": 256}
    second = {"name": "Second", "device_type": "ch", "shift": "0x200", "stride": 2}
    device = only(tmp_path, "w.json", with_subdevice(first, second))
    assert places(device) == [
        ("first_voltage", 0x110),
        ("first_energy", 0x120),
        ("second_voltage", 0x210 + 2),  # each further subdevice adds one stride to the address
        ("second_energy", 0x220 + 4),
    ]
    assert omissions(device) == []


def test_shifts_of_nested_wb_mqtt_serial_subdevices_are_added(tmp_path: Path) -> None:
    inner = {"device_type": "in", "device": {"channels": [VOLTAGE]}}
    used = {"name": "Inner", "device_type": "in", "shift": 3}
    document = with_subdevice(
        {"name": "Outer", "device_type": "ch", "shift": 100}, channels=[used], subdevices=[inner]
    )
    assert places(only(tmp_path, "w.json", document)) == [("outer_inner_voltage", 16 + 103)]


def test_wb_mqtt_subdevice_that_contains_itself_is_cut_off(tmp_path: Path) -> None:
    again = {"name": "Again", "device_type": "ch", "shift": 1}
    device = only(tmp_path, "w.json", with_subdevice(again, channels=[VOLTAGE, again]))
    assert len(device.registers) == 8
    assert "more than 8 subdevices in each other" in omissions(device)[0]


@pytest.mark.parametrize(
    ("used", "reason"),
    [
        (
            {"name": "X", "oneOf": ["ch", "other"]},
            "X: the configuration chooses which subdevice it is: ch, other",
        ),
        ({"name": "X", "device_type": "none"}, "X: its subdevice none is not in this file"),
        ({"name": "X", "address": 1}, "subdevice ch: no channel uses it, so its address is not known"),
    ],
)
def test_wb_mqtt_subdevices_of_unknown_address_are_reported_as_not_imported(
    tmp_path: Path, used: dict[str, Any], reason: str
) -> None:
    document = with_subdevice({"name": "Known", "address": 7}, used)
    device = only(tmp_path, "w.json", document)
    assert ("known", 7) in places(device)
    assert "voltage" not in entries(device)
    assert reason in omissions(device)


@table(
    ("keys", "expected"),
    [
        ({"address": "5:4:2"}, {"part": "4-5"}),
        ({"address": "5:0"}, {}),  # no width is stated, so all bits are used
        ({"address": "5:8", "format": "u8"}, {"part": "8-15"}),
        (
            {"address": "5:8:4", "format": "s16"},
            {"part": "8-11"},
        ),  # wb-mqtt-serial ignores the sign of a number that uses only some bits
        ({"address": "5:8:16", "format": "s16"}, {"number_format": "I32", "part": "8-23"}),
        ({"format": "s24"}, {"number_format": "I32", "part": "0-23"}),
        ({"format": "u8"}, {"part": "0-7"}),
        ({"format": "s8"}, {"number_format": "I8"}),
    ],
)
def test_bits_of_a_wb_mqtt_register_are_imported_as_a_bit_range(
    tmp_path: Path, keys: dict[str, Any], expected: dict[str, Any]
) -> None:
    device = channel(tmp_path, **keys)
    assert entries(device)["a"] == {"at": 5, "table": "input"} | expected
    assert gaps(device, "a") == []


def test_bits_across_three_wb_mqtt_serial_registers_are_reported(tmp_path: Path) -> None:
    device = channel(tmp_path, address="5:30:4")
    assert gaps(device, "a") == ["only its count is read: its bits 30 to 33 of the format u16"]


def test_wb_mqtt_format_of_8_bits_selects_the_low_byte(tmp_path: Path) -> None:
    assert entries(channel(tmp_path, reg_type="holding", format="u8"))["a"] == {"at": 5, "part": "0-7"}


@table(
    ("keys", "invalid"),
    [
        ({"format": "float", "error_value": "0x7FC00000"}, "NaN"),
        ({"format": "float", "error_value": "0xC61C3F9A"}, -9999.900390625),
        ({"format": "u64", "error_value": "0xFFFFFFFFFFFFFFFF"}, -1),
        ({"format": "s16", "error_value": "0x7FFF", "unsupported_value": "0xFFFE"}, [0x7FFF, 0xFFFE]),
    ],
)
def test_wb_mqtt_error_value_is_decoded_in_the_registers_format(
    tmp_path: Path, keys: dict[str, Any], invalid: Any
) -> None:
    device = channel(tmp_path, **keys)
    assert (entries(device)["a"]["invalid"], gaps(device, "a")) == (invalid, [])


@table(
    ("keys", "gap"),
    [
        (
            {"error_value": "0xFFFFFFFF"},
            "error_value 0xFFFFFFFF is no count of 16 bits, and was not carried over",
        ),
        (
            {"enum": [0, 1], "enum_titles": ["a", "b"], "scale": 0.1},
            "enum was not carried over: its names are of values with a step",
        ),
        ({"enum": [0, "x"], "enum_titles": ["a", "b"]}, "1 of the names of its values were not carried over"),
        ({"off_value": 0}, "off_value was not carried over"),
        ({"round_to": 0.1}, "round_to was not carried over"),
        ({"format": "bcd8"}, "its format bcd8 has fewer digits than its registers hold"),
    ],
)
def test_wb_mqtt_keys_that_are_not_imported_are_reported(
    tmp_path: Path, keys: dict[str, Any], gap: str
) -> None:
    assert gaps(channel(tmp_path, **keys), "a") == [gap]


def test_wb_mqtt_text_without_its_size_is_reported(tmp_path: Path) -> None:
    assert gaps(channel(tmp_path, format="string8"), "a") == ["string_data_size is not stated; 1 was assumed"]


def test_parts_of_a_composite_wb_mqtt_serial_channel_are_reported(tmp_path: Path) -> None:
    parts = [{"reg_type": "input", "address": at} for at in (5, 7)]
    device = only(tmp_path, "w.json", {"device": {"channels": [{"name": "a", "consists_of": parts}]}})
    assert places(device) == [("a", 5), ("a_2", 7)]
    assert gaps(device, "a") == ["its place in a larger channel was not carried over"]


def test_wb_mqtt_value_names_are_imported_if_numbers_are_strings(tmp_path: Path) -> None:
    named = channel(tmp_path, enum=["0", "2"], enum_titles=["off", "on"])
    assert entries(named)["a"]["values"] == {"off": 0, "on": 2}


@pytest.mark.parametrize(
    ("keys", "reason"),
    [
        (
            {"format": "string", "byte_order": "little_endian"},
            "a text of one character a register, in its high byte",
        ),
        ({"format": "string8", "word_order": "little_endian"}, "a text whose word_order is little_endian"),
    ],
)
def test_a_wb_mqtt_text_with_unknown_character_order_is_reported(
    tmp_path: Path, keys: dict[str, Any], reason: str
) -> None:
    with pytest.raises(ValueError, match=f"a: {reason}"):
        channel(tmp_path, string_data_size=8, **keys)


CONFIG = {
    "ports": [
        {
            "port_type": "serial",
            "path": "/dev/ttyRS485-1",
            "baud_rate": 19200,
            "parity": "E",
            "devices": [
                {"name": "Meter", "slave_id": "0x0A", "channels": [VOLTAGE]},
                {
                    "name": "Relay",
                    "slave_id": 11,
                    "channels": [{"name": "K1", "reg_type": "coil", "address": 0}],
                },
                {"device_type": "WB-X", "slave_id": 12, "in1_mode": 2},
                {"name": "Other", "protocol": "energomera_iec", "channels": [VOLTAGE]},
            ],
        },
        {
            "port_type": "modbus tcp",
            "address": "10.0.0.7",
            "port": 502,
            "devices": [{"name": "Net", "slave_id": "255", "channels": [VOLTAGE]}],
        },
    ]
}


def test_wb_mqtt_configuration_gives_a_device_for_each_slave(tmp_path: Path) -> None:
    meter, relay, net = devices(tmp_path, "wb-mqtt-serial.json", CONFIG)
    assert [(each.title, each.address, each.line.port) for each in (meter, relay, net)] == [
        ("Meter", 10, "/dev/ttyRS485-1"),
        ("Relay", 11, "/dev/ttyRS485-1"),
        ("Net", 255, "tcp://10.0.0.7:502"),
    ]
    assert str(meter.line) == "19200, 8E1"
    assert places(relay) == [("k1", 0)]


@table(
    ("document", "reason"),
    [
        ({"device_type": "x"}, "has no `device` with channels or parameters (wb-mqtt-serial)"),
        ({"device": {"protocol": "uniel", "channels": []}}, "another protocol than Modbus: 'uniel'"),
        ({"ports": [CONFIG["ports"][0] | {"devices": [{"device_type": "WB-X"}]}]}, "a template of that name"),
        (
            {"device": {"channels": [{"name": "a", "address": "x"}]}},
            "a: it cannot be read: address = 'x' is no",
        ),
        ({"device": {"channels": [{"name": "a"}]}}, "a: it has no address"),
        ({"device": {"channels": [{"address": 1, "word_order": "x"}]}}, "word_order = 'x' is not one of"),
    ],
)
def test_invalid_wb_mqtt_serial_document_raises_value_error_with_the_reason(
    tmp_path: Path, document: dict[str, Any], reason: str
) -> None:
    with pytest.raises(ValueError, match=re.escape(reason)):
        only(tmp_path, "w.json", document)


def test_an_import_error_contains_the_name_of_the_file(tmp_path: Path) -> None:
    (tmp_path / "w.json").write_text("{}")
    with pytest.raises(ValueError, match=re.escape(str(tmp_path / "w.json"))):
        read_devices(tmp_path / "w.json")


def test_translations_of_wb_mqtt_serial_names_become_titles(tmp_path: Path) -> None:
    """For a channel of a subdevice, the translated names of both are joined."""
    words = {"Voltage": "Напряжение", "First": "Первый", "mode_title": "Режим", "Energy": ""}
    document = with_subdevice({"name": "First", "device_type": "ch"}, {**VOLTAGE, "address": 1})
    document["device"]["parameters"] = {"mode": {"title": "mode_title", "address": 2}}
    document["device"]["translations"] = {"ru": words, "en": {"mode_title": "Mode"}, "zh": []}
    path = tmp_path / "w.toml"
    path.write_text(family_text(only(tmp_path, "w.json", document), "w.json"), "utf-8")
    registers = load_family(path).registers
    assert {name: register.title_in("ru") for name, register in registers.items()} == {
        "first_voltage": "Первый Напряжение",
        "first_energy": "first energy",
        "voltage": "Напряжение",
        "mode": "Режим",
    }
