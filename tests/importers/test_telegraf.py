"""Import of Telegraf's inputs.modbus: unit ids, texts, line settings, and types of each style."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
from imported import devices, entries, gaps, omissions, only
from tables import table

from multidrop.importers import ImportedDevice, plant_text, read_devices

HEAD = '[[inputs.modbus]]\nname = "m"\nslave_id = 1\ncontroller = "tcp://10.0.0.5:502"\n'


def of_registers(folder: Path, keys: str, more: str = "") -> ImportedDevice:
    """Return the device of a configuration in Telegraf's register style with one field, `a`."""
    return only(folder, "t.conf", f'{HEAD}holding_registers = [{{ name = "a", {keys} }}]\n{more}')


def of_a_request(folder: Path, keys: str, more: str = "") -> ImportedDevice:
    """Return the device of a configuration in Telegraf's request style with one field, `a`."""
    request = f'[[inputs.modbus.request]]\nslave_id = 1\nfields = [{{ name = "a", {keys} }}]\n'
    return only(folder, "t.conf", HEAD + request + more)


@table(
    ("keys", "expected"),
    [
        ('byte_order = "AB", data_type = "FLOAT32", scale = 0.1, address = [11003]', {"step": 0.1}),
        (
            'byte_order = "ABCD", data_type = "FLOAT32", scale = 0.001, address = [5, 6]',
            {"number_format": "U32", "step": 0.001},
        ),
        ('byte_order = "ABCD", data_type = "UFIXED", address = [5, 6]', {"number_format": "U32"}),
        ('byte_order = "ABCD", data_type = "FLOAT32-IEEE", address = [5, 6]', {"number_format": "F32"}),
        ('byte_order = "AB", data_type = "FLOAT16-IEEE", address = [5]', {"number_format": "F16"}),
        ('byte_order = "AB", data_type = "BIT", bit = 3, address = [5]', {"part": "3"}),
    ],
)
def test_a_float32_type_is_a_whole_number_in_telegrafs_register_style(
    tmp_path: Path, keys: str, expected: dict[str, object]
) -> None:
    found = entries(of_registers(tmp_path, keys))["a"]
    assert found.pop("at") in (5, 11003)
    assert found == expected


def test_a_float32_type_is_a_float_in_telegrafs_other_styles(tmp_path: Path) -> None:
    assert entries(of_a_request(tmp_path, 'address = 5, type = "FLOAT32"'))["a"]["number_format"] == "F32"
    metric = (
        '[[inputs.modbus.metric]]\nslave_id = 1\nfields = [{ name = "b", address = 5, type = "FLOAT32" }]\n'
    )
    assert entries(only(tmp_path, "t.conf", HEAD + metric))["b"]["number_format"] == "F32"


def test_a_float64_type_is_refused_in_telegrafs_register_style(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="a: its type FLOAT64 has no number format"):
        of_registers(tmp_path, 'byte_order = "ABCD", data_type = "FLOAT64", address = [5, 6, 7, 8]')


def test_missing_telegraf_type_and_output_type_are_reported(tmp_path: Path) -> None:
    assert gaps(of_a_request(tmp_path, "address = 5"), "a") == ["its type is not stated; UINT16 was assumed"]
    device = of_a_request(tmp_path, 'address = 5, type = "INT16", scale = 0.1, output = "INT64"')
    assert gaps(device, "a") == ["output was not carried over"]


@pytest.mark.parametrize(("place", "order"), [("both", None), ("lower", "B")])
def test_telegraf_text_in_the_low_bytes_is_imported(tmp_path: Path, place: str, order: str | None) -> None:
    workaround = f'[inputs.modbus.workarounds]\nstring_register_location = "{place}"\n'
    device = of_a_request(tmp_path, 'address = 5, type = "STRING", length = 4', workaround)
    assert (entries(device)["a"]["length"], entries(device)["a"].get("order")) == (4, order)


def test_telegraf_text_in_the_high_bytes_is_reported_as_not_imported(tmp_path: Path) -> None:
    workaround = '[inputs.modbus.workarounds]\nstring_register_location = "upper"\n'
    with pytest.raises(ValueError, match="a: a text whose string_register_location is upper"):
        of_a_request(tmp_path, 'address = 5, type = "STRING", length = 4', workaround)


def test_telegraf_fields_are_ignored_if_another_style_is_stated(tmp_path: Path) -> None:
    both = f'{HEAD}configuration_type = "request"\ncoils = [{{ name = "old", address = [1] }}]\n'
    request = (
        '[[inputs.modbus.request]]\nslave_id = 1\nfields = [{ name = "new", address = 1, type = "INT16" }]\n'
    )
    assert list(entries(only(tmp_path, "t.conf", both + request))) == ["new"]


def test_telegraf_request_without_a_slave_id_is_reported(tmp_path: Path) -> None:
    request = '[[inputs.modbus.request]]\nfields = [{ name = "a", address = 1, type = "INT16" }]\n'
    device = only(tmp_path, "t.conf", HEAD + request)
    assert device.address == 1
    assert omissions(device) == [
        "request: it has no slave_id, for which Telegraf asks unit 0; the plugin's was taken"
    ]


def test_telegraf_pause_settings_are_reported_as_not_imported(tmp_path: Path) -> None:
    workaround = '[inputs.modbus.workarounds]\npause_after_connect = "1s"\n'
    device = of_a_request(tmp_path, 'address = 5, type = "INT16"', workaround)
    assert omissions(device) == ["workarounds: pause_after_connect was not carried over"]


@table(
    ("line", "expected"),
    [
        ('controller = "tcp://gate:4001"\ntransmission_mode = "RTUoverTCP"', {"port": "socket://gate:4001"}),
        (
            'controller = "tcp://gate:4001"\ntransmission_mode = "ASCIIoverTCP"',
            {"port": "socket://gate:4001", "framing": "ascii"},
        ),
        ('controller = "tcp://${GATE}:502"', {"port": "tcp://HOST:502"}),
        ('controller = "tcp://gate:${PORT}"', {"port": "tcp://HOST:502"}),
    ],
)
def test_a_telegraf_controller_url_sets_port_and_framing(
    tmp_path: Path, line: str, expected: dict[str, str]
) -> None:
    field = 'holding_registers = [{ name = "a", byte_order = "AB", data_type = "INT16", address = [7] }]\n'
    (device,) = devices(tmp_path, "t.conf", f"[[inputs.modbus]]\nslave_id = 1\n{line}\n{field}")
    (plant,) = tomllib.loads(plant_text(device, "m.toml"))["line"]
    framing = {key: plant["drive"][0][key] for key in ("framing",) if key in plant["drive"][0]}
    assert {"port": plant["port"], **framing} == expected


@pytest.mark.parametrize("unit", [0, 255])
def test_telegraf_slave_ids_0_and_255_are_valid_addresses(tmp_path: Path, unit: int) -> None:
    text = HEAD.replace("slave_id = 1", f"slave_id = {unit}")
    field = 'coils = [{ name = "a", address = [7] }]\n'
    assert only(tmp_path, "t.conf", text + field).address == unit


@table(
    ("text", "reason"),
    [
        ("[agent]\n", "has no [[inputs.modbus]] (Telegraf): it has agent"),
        (HEAD, "[[inputs.modbus]] has no field in holding_registers"),
        (HEAD + 'coils = [{ name = "a" }]\n', "a: it has no address"),
        (
            f'{HEAD}[[inputs.modbus.request]]\nfields = [{{ name = "a", address = 1, type = "STRING" }}]\n',
            "a: it has no length",
        ),
        (
            HEAD + 'coils = [{ name = "a", address = "x" }]\n',
            "a: it cannot be read: address = 'x' is not a whole",
        ),
        (
            HEAD.replace("= 1", "= 900") + 'coils = [{ name = "a", address = [1] }]\n',
            "slave_id = '900' is no",
        ),
    ],
)
def test_invalid_telegraf_file_raises_value_error(tmp_path: Path, text: str, reason: str) -> None:
    (tmp_path / "t.conf").write_text(text)
    with pytest.raises(ValueError, match=re.escape(reason)):
        read_devices(tmp_path / "t.conf")
