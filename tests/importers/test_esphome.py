"""Import of ESPHome's `modbus_controller`: entities, devices, offsets, masks, filters and packages."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from commands import Run
from imported import devices, entries, gaps, omissions, only
from tables import table

from multidrop.importers import ImportedDevice, read_devices

pytest.importorskip("yaml")

CONTROLLER = "modbus_controller: {id: dev, address: 1}\n"


def entity(folder: Path, keys: str, kind: str = "sensor") -> ImportedDevice:
    """Return the device with the entity `a` at holding register 5, which has these keys."""
    item = f"{{platform: modbus_controller, name: a, address: 5, register_type: holding, {keys}}}"
    return only(folder, "node.yaml", f"{CONTROLLER}{kind}:\n  - {item}\n")


@table(
    ("keys", "expected"),
    [
        ("value_type: U_WORD, bitmask: 0x00F0", {"part": "4-7"}),
        ("value_type: S_WORD, bitmask: 0xFF00", {"part": "8-15"}),  # in ESPHome a masked number is unsigned
        ("value_type: S_WORD, bitmask: 0xFFFF", {"number_format": "I16"}),
        ("value_type: U_DWORD, bitmask: 0xFFFF", {"number_format": "U32", "part": "0-15"}),
        (
            "value_type: U_QWORD, bitmask: 0xFFFF",
            {"number_format": "U64"},
        ),  # ESPHome ignores the bit mask of 64-bit numbers
        ("value_type: S_DWORD_R", {"number_format": "I32", "order": "CDAB"}),
        ("offset: 4", {"at": 7}),
        ("byte_offset: 2", {"at": 6}),
        ("filters: [{multiply: 0.1}, {offset: -40}]", {"step": 0.1, "offset": -40}),
        ("filters: [{offset: -40}, {multiply: 0.1}]", {"step": 0.1, "offset": -4}),
        ("filters: {multiply: 0.5}", {"step": 0.5}),
    ],
)
def test_esphome_entity_becomes_a_register(tmp_path: Path, keys: str, expected: dict[str, object]) -> None:
    device = entity(tmp_path, keys)
    assert entries(device)["a"] == {"at": 5} | expected
    assert gaps(device, "a") == []


@table(
    ("keys", "gap"),
    [
        ("byte_offset: 3", "only its count is read: its offset is half a register"),
        ("lambda: !lambda 'return x;'", "only its count is read: its lambda is a program"),
        ("value_type: FP32, bitmask: 0xFF", "only its count is read: its bitmask 0xff is of a float"),
        ("filters: [{multiply: !lambda x}]", "not all of its filters were carried over: multiply"),
        (
            "filters: [{clamp: {min_value: 0}}, {multiply: 2}]",
            "not all of its filters were carried over: clamp, multiply",
        ),
        ("unit_of_measurement: '${unit}'", "its unit is ${unit}"),
    ],
)
def test_unsupported_esphome_filters_are_reported(tmp_path: Path, keys: str, gap: str) -> None:
    assert gaps(entity(tmp_path, keys), "a") == [gap]


def test_the_factor_of_an_esphome_number_becomes_a_divisor(tmp_path: Path) -> None:
    """ESPHome multiplies values by `multiply` when it writes them, so a read divides by it."""
    assert entries(entity(tmp_path, "multiply: 10", "number"))["a"] == {"at": 5, "step": 0.1}


def test_esphome_binary_sensor_with_several_mask_bits_is_reported(tmp_path: Path) -> None:
    one = entity(tmp_path, "bitmask: 0x8", "binary_sensor")
    assert (entries(one)["a"], gaps(one, "a")) == ({"at": 5, "part": "3"}, [])
    several = entity(tmp_path, "bitmask: 0xC", "binary_sensor")
    assert (entries(several)["a"]["part"], gaps(several, "a")) == (
        "2-3",
        ["it is true where one of its bits is"],
    )


def test_esphome_number_wider_than_its_register_count_is_reported(tmp_path: Path) -> None:
    """Some devices, such as the JSY-MK meters, send 32 bits for one register."""
    narrow = entity(tmp_path, "value_type: U_DWORD, register_count: 1")
    assert gaps(narrow, "a") == ["U_DWORD needs more than register_count = 1: is a register wider?"]
    assert gaps(entity(tmp_path, "value_type: U_DWORD, register_count: 4"), "a") == []


def test_inverted_esphome_switch_is_reported(tmp_path: Path) -> None:
    assert "inverted was not carried over" in gaps(entity(tmp_path, "inverted: true", "switch"), "a")


def test_esphome_text_sensor_without_response_size_is_reported(tmp_path: Path) -> None:
    device = entity(tmp_path, "register_count: 4", "text_sensor")
    assert entries(device)["a"]["length"] == 4
    assert gaps(device, "a") == ["its response_size is not stated; 8 bytes were assumed"]
    device = entity(tmp_path, "response_size: 8, raw_encode: HEXBYTES, filters: [to_upper]", "text_sensor")
    assert gaps(device, "a") == [
        "raw_encode was not carried over: the characters are shown",
        "filters was not carried over",
    ]


def test_esphome_entity_with_custom_command_is_reported_as_not_imported(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="a: it is read by a custom_command, which is no read of registers"):
        entity(tmp_path, "custom_command: [1, 3]")


ONE = "{{platform: modbus_controller, {}name: {}, register_type: read, address: {}}}"


def node(controllers: str, *entities: str) -> str:
    return f"esphome: {{name: node}}\nmodbus_controller:\n{controllers}sensor:\n" + "".join(
        f"  - {entity}\n" for entity in entities
    )


VOLTS, AMPS = ONE.format("modbus_controller_id: fast, ", "volts", 3), ONE.format("", "amps", 4)
FAST = "  - {id: fast, address: 1, modbus_id: m}\n"


def test_esphome_entity_without_controller_id_belongs_to_the_only_controller(tmp_path: Path) -> None:
    assert list(entries(only(tmp_path, "node.yaml", node(FAST, VOLTS, AMPS)))) == ["volts", "amps"]


def test_esphome_controllers_with_the_same_bus_and_address_are_one_device(tmp_path: Path) -> None:
    slow = ONE.format("modbus_controller_id: slow, ", "amps", 4)
    controllers = FAST + "  - {id: slow, address: 0x01, modbus_id: m}\n"
    assert list(entries(only(tmp_path, "node.yaml", node(controllers, VOLTS, slow)))) == ["volts", "amps"]
    first, second = devices(
        tmp_path, "node.yaml", node(controllers.replace("0x01, modbus_id: m", "1, modbus_id: n"), VOLTS, slow)
    )
    assert (first.title, second.title) == ("node", "node 2")


def test_esphome_entity_that_names_none_of_several_controllers_is_not_imported(tmp_path: Path) -> None:
    controllers = FAST + "  - {id: slow, address: 2, modbus_id: m}\n"
    device = only(tmp_path, "node.yaml", node(controllers, VOLTS, AMPS))
    assert omissions(device) == [
        "amps: it cannot be read: modbus_controller_id is missing, and there are several controllers"
    ]


def test_esphome_line_settings_come_from_the_uart_of_the_controllers_bus(tmp_path: Path) -> None:
    text = (
        "uart: [{id: u, baud_rate: 4800, parity: EVEN}, {id: w, baud_rate: 19200, parity: NONE}]\n"
        "modbus: [{id: m, uart_id: w}, {id: n, uart_id: u}]\n"
    )
    assert str(only(tmp_path, "node.yaml", text + node(FAST, VOLTS)).line) == "19200, 8N1"


def test_substitutions_and_packages_in_an_esphome_file_are_resolved(tmp_path: Path) -> None:
    text = """
substitutions: { unit_id: 7, volt: 0x10, u: V }
packages:
  meter:
    modbus_controller: { id: dev, address: "${unit_id}" }
    sensor:
      - { platform: modbus_controller, name: volts, register_type: read, address: "${volt}",
           unit_of_measurement: $u }
"""
    device = only(tmp_path, "node.yaml", text)
    assert device.address == 7
    assert entries(device)["volts"] == {"at": 16, "table": "input", "unit": "V"}


@pytest.mark.parametrize("text", [f"sensor:\n  - {VOLTS}\n", f"- {VOLTS}\n"])
def test_esphome_package_without_controller_has_no_address(run: Run, tmp_path: Path, text: str) -> None:
    device = only(tmp_path, "package.yaml", text)
    assert (device.title, device.address, list(entries(device))) == ("fast", None, ["volts"])
    source, family, plant = (tmp_path / name for name in ("package.yaml", "m.toml", "plant.toml"))
    status, _, err = run("import", source, "--out", family, "--plant", plant)
    assert (status, "does not state its address" in err) == (2, True)


@table(
    ("text", "reason"),
    [
        (CONTROLLER, "has no entity with `platform: modbus_controller` in sensor, binary_sensor"),
        ("modbus_controller: {address: 300}\n", "modbus_controller: address = '300' is not a unit id"),
        (node(FAST, VOLTS.replace("read", "custom")), "volts: its register_type custom is not known"),
        (node(FAST, VOLTS.replace("address: 3", "id: 3")), "volts: it has no address"),
    ],
)
def test_invalid_esphome_document_raises_value_error(tmp_path: Path, text: str, reason: str) -> None:
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(ValueError, match=re.escape(reason)):
        read_devices(tmp_path / "a.yaml")
