"""No part of another program's register table is ignored silently.

Every key of its schema is imported, ignored or reported. The script bench.questions.files.coverage counts the
entries that can be imported from a folder of tables.
"""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from imported import FILES, entries, gaps, omissions, only
from tables import table

from multidrop.importers import csv_tables, esphome, home_assistant, sunspec, telegraf, wb
from multidrop.importers.device import KeyTable, unimported_keys

# ---- keys ----


# Keys from each program's documentation and schemas, typed independently of the importers.
SCHEMAS: dict[str, tuple[KeyTable, str]] = {
    "home assistant: sensors": (
        home_assistant.KEYS["sensors"],
        "name address slave device_address count data_type device_class state_class input_type min_value "
        "max_value nan_value zero_suppress offset precision scale scan_interval structure swap "
        "reverse_order unit_of_measurement unique_id virtual_count slave_count lazy_error_count",
    ),
    "home assistant: binary_sensors": (
        home_assistant.KEYS["binary_sensors"],
        "name address slave device_address input_type device_class scan_interval unique_id virtual_count "
        "slave_count lazy_error_count",
    ),
    **{
        f"home assistant: {kind}": (
            home_assistant.KEYS[kind],
            "name address slave device_address write_type command_on command_off verify scan_interval "
            "unique_id device_class lazy_error_count",
        )
        for kind in ("switches", "fans")
    },
    "home assistant: lights": (
        home_assistant.KEYS["lights"],
        "name address slave device_address write_type command_on command_off verify scan_interval "
        "unique_id brightness_address color_temp_address min_temp max_temp",
    ),
    "home assistant: verify": (home_assistant.VERIFY_KEYS, "address input_type state_on state_off delay"),
    "home assistant: hub": (
        home_assistant.HUB_KEYS,
        "name type host port baudrate bytesize parity stopbits method delay message_wait_milliseconds "
        "retries retry_on_empty close_comm_on_error timeout sensors binary_sensors switches lights fans "
        "climates covers",
    ),
    "esphome: sensor": (
        esphome.KEYS["sensor"],
        "platform modbus_controller_id id name address register_type value_type bitmask offset "
        "byte_offset skip_updates register_count response_size force_new_range custom_command lambda "
        "filters internal icon unit_of_measurement accuracy_decimals device_class state_class "
        "entity_category force_update expire_after disabled_by_default on_value on_raw_value "
        "on_value_range setup_priority",
    ),
    "esphome: binary_sensor": (
        esphome.KEYS["binary_sensor"],
        "platform modbus_controller_id id name address register_type bitmask offset byte_offset "
        "skip_updates force_new_range response_size custom_command lambda filters device_class "
        "publish_initial_state on_press on_release on_click on_double_click on_multi_click on_state",
    ),
    "esphome: text_sensor": (
        esphome.KEYS["text_sensor"],
        "platform modbus_controller_id id name address register_type register_count response_size "
        "raw_encode offset byte_offset skip_updates force_new_range custom_command lambda filters "
        "on_value on_raw_value",
    ),
    "esphome: switch": (
        esphome.KEYS["switch"],
        "platform modbus_controller_id id name address register_type bitmask offset byte_offset "
        "skip_updates force_new_range custom_command lambda write_lambda use_write_multiple inverted "
        "restore_mode assumed_state on_turn_on on_turn_off",
    ),
    "esphome: number": (
        esphome.KEYS["number"],
        "platform modbus_controller_id id name address register_type value_type bitmask offset "
        "byte_offset skip_updates register_count force_new_range custom_command lambda write_lambda "
        "multiply min_value max_value step mode unit_of_measurement use_write_multiple on_value "
        "on_value_range",
    ),
    "esphome: select": (
        esphome.KEYS["select"],
        "platform modbus_controller_id id name address value_type register_count skip_updates "
        "force_new_range optionsmap use_write_multiple optimistic lambda write_lambda on_value",
    ),
    "esphome: output": (
        esphome.KEYS["output"],
        "platform modbus_controller_id id address register_type value_type offset byte_offset multiply "
        "write_lambda use_write_multiple",
    ),
    "esphome: controller": (
        esphome.CONTROLLER_KEYS,
        "id address modbus_id update_interval command_throttle offline_skip_updates max_cmd_retries "
        "allow_duplicate_commands server_registers server_courtesy_response on_command_sent on_online "
        "on_offline",
    ),
    "telegraf: register": (
        telegraf.FIELD_KEYS["register"],
        "measurement name byte_order data_type scale address bit",
    ),
    "telegraf: request": (
        telegraf.FIELD_KEYS["request"],
        "address name type length scale output measurement omit bit",
    ),
    "telegraf: metric": (telegraf.FIELD_KEYS["metric"], "register address length name type scale output bit"),
    "telegraf: a request": (
        telegraf.BLOCK_KEYS["request"],
        "slave_id byte_order register measurement optimization optimization_max_register_fill fields tags",
    ),
    "telegraf: a metric": (telegraf.BLOCK_KEYS["metric"], "slave_id byte_order measurement fields tags"),
    "telegraf: workarounds": (
        telegraf.WORKAROUND_KEYS,
        "pause_after_connect pause_between_requests close_connection_after_gather one_request_per_field "
        "read_coils_starting_at_zero string_register_location max_bit_registers_per_request "
        "max_word_registers_per_request",
    ),
    "telegraf: the plugin": (
        telegraf.PLUGIN_KEYS,
        "name controller transmission_mode baud_rate data_bits parity stop_bits rs485 timeout "
        "busy_retries busy_retries_wait debug_connection workarounds configuration_type "
        "exclude_register_type_tag slave_id discrete_inputs coils holding_registers input_registers "
        "request metric optimization optimization_max_register_fill",
    ),
    "wb-mqtt-serial: channel": (
        wb.CHANNEL_KEYS,
        "enabled name id type reg_type format units max min scale offset round_to readonly on_value "
        "off_value read_period_ms read_rate_limit_ms error_value unsupported_value word_order byte_order "
        "string_data_size sporadic semi-sporadic enum enum_titles device_type hidden address "
        "write_address oneOf shift stride consists_of condition group fw",
    ),
    "wb-mqtt-serial: parameter": (
        wb.CHANNEL_KEYS,
        "title address write_address reg_type format scale offset round_to enum enum_titles default min "
        "max order required readonly description id condition group fw dependencies",
    ),
    "wb-mqtt-serial: device": (
        wb.DEVICE_KEYS,
        "name id enabled protocol slave_id read_rate_limit_ms min_request_interval password access_level "
        "max_reg_hole max_bit_hole max_read_registers min_read_registers max_write_registers "
        "guard_interval_us frame_timeout_ms force_frame_timeout response_timeout_ms device_timeout_ms "
        "device_max_fail_cycles max_write_fail_time_s preserve_setup_order enable_wb_continuous_read "
        "continue_polling_on_illegal_modbus_exception channels parameters setup groups subdevices "
        "translations",
    ),
    "wb-mqtt-serial: template": (wb.TEMPLATE_KEYS, "device_type title group deprecated hw device"),
    "wb-mqtt-serial: port": (
        wb.PORT_KEYS,
        "enabled port_type path baud_rate parity data_bits stop_bits address port response_timeout_ms "
        "guard_interval_us read_rate_limit_ms connection_timeout_ms connection_max_fail_cycles "
        "connected_to_mge devices",
    ),
    "sunspec: point": (
        sunspec.POINT_KEYS,
        "name value count type size sf units access mandatory static label desc detail notes comments "
        "symbols standards",
    ),
    "sunspec: group": (
        sunspec.GROUP_KEYS,
        "name type count points groups label desc detail notes comments standards",
    ),
    "sunspec: model": (sunspec.MODEL_KEYS, "id group label desc detail notes comments standards"),
}
IOBROKER_COLUMNS = "address name description unit type len factor offset formula role room poll wp cw isscale"
NEURON_COLUMNS = "group interval name address attribute type description decimal precision bias"


@table("source", SCHEMAS)
def test_every_key_of_another_programs_schema_is_handled(source: str) -> None:
    table, keys = SCHEMAS[source]
    assert [key for key in keys.split() if key not in table] == []


@table("columns", [IOBROKER_COLUMNS, NEURON_COLUMNS])
def test_every_column_of_a_known_csv_layout_is_handled(columns: str) -> None:
    carried = {alias for aliases in csv_tables.COLUMNS.values() for alias in aliases}
    known = carried | csv_tables.IRRELEVANT | csv_tables.GAPS
    assert [column for column in columns.split() if column not in known] == []


def test_keys_that_are_not_imported_are_reported_unless_empty() -> None:
    table = home_assistant.KEYS["sensors"]
    given = {"name": "a", "icon": "x", "min_value": 0, "max_value": None, "zero_suppress": False, "new": 1}
    assert unimported_keys(given, table) == [
        "min_value was not carried over",
        "new is not known here, and was not carried over",
    ]


SENSOR = "{name: a, address: 1, slave: 1"
UNKNOWN: dict[str, tuple[str, str | dict[str, Any]]] = {
    "home assistant": ("a.yaml", f"modbus:\n  - sensors:\n    - {SENSOR}, novel: 1}}\n"),
    "esphome": (
        "b.yaml",
        "modbus_controller: {address: 1}\nsensor:\n  - {platform: modbus_controller, name: a, address: 1, "
        "register_type: read, novel: 1}\n",
    ),
    "telegraf": (
        "t.conf",
        '[[inputs.modbus]]\nholding_registers = [{name = "a", address = [1], byte_order = "AB", '
        'data_type = "INT16", novel = 1}]\n',
    ),
    "wb-mqtt-serial": ("w.json", {"device": {"channels": [{"name": "a", "address": 1, "novel": 1}]}}),
    "sunspec": ("s.json", {"group": {"points": [{"name": "a", "type": "int16", "size": 1, "novel": 1}]}}),
}


@pytest.mark.parametrize("source", UNKNOWN)
def test_key_that_an_importer_does_not_know_is_reported_with_its_register(
    tmp_path: Path, source: str
) -> None:
    pytest.importorskip("yaml")
    device = only(tmp_path, *UNKNOWN[source])
    assert list(entries(device)) == ["a"]
    assert "novel is not known here, and was not carried over" in gaps(device, "a")


def test_unimported_settings_of_a_home_assistant_hub_are_reported(tmp_path: Path) -> None:
    pytest.importorskip("yaml")
    hub = f"modbus:\n  - name: hub\n    delay: 5\n    novel: 1\n    timeout: 3\n    sensors: [{SENSOR}}}]\n"
    assert omissions(only(tmp_path, "a.yaml", hub)) == [
        "the hub: delay was not carried over",
        "the hub: novel is not known here, and was not carried over",
    ]


# ---- entries of whole tables ----


ROOT = Path(__file__).parents[2]
SCRIPT = [sys.executable, "-m", "bench.questions.files.coverage"]

HELD = [  # entries that the register model can describe
    {"name": "voltage", "reg_type": "input", "address": "0x10", "format": "s16", "scale": 0.1},
    {"name": "relay", "reg_type": "coil", "address": 0},
    {"name": "door", "reg_type": "discrete", "address": 3},
    {"name": "setpoint", "reg_type": "holding", "address": 4, "write_address": 104},
    {"name": "energy", "reg_type": "input", "address": 20, "format": "u64", "word_order": "little_endian"},
    {"name": "power", "reg_type": "input", "address": 24, "format": "double"},
    {"name": "limit", "reg_type": "holding", "address": 30, "format": "float", "byte_order": "little_endian"},
    {"name": "cold", "reg_type": "input", "address": 40, "format": "s16", "error_value": "0x7FFF"},
    {"name": "mode", "reg_type": "input", "address": "50:4:2", "enum": [0, 1], "enum_titles": ["a", "b"]},
    {"name": "flag", "reg_type": "holding", "address": "50:0:1", "readonly": True},
    {"name": "small", "reg_type": "input", "address": 51, "format": "u8", "sporadic": True},
    {"name": "frost", "reg_type": "input", "address": 52, "format": "s8", "offset": -40},
    {"name": "count", "reg_type": "input", "address": 53, "format": "bcd32", "scale": -1},
    {"name": "alone", "reg_type": "holding_multi", "address": 60},
    {"name": "serial", "reg_type": "input", "address": 70, "format": "string8", "string_data_size": 5},
    {"name": "only this", "reg_type": "holding", "write_address": 91},
    {"name": "version", "reg_type": "input", "address": 80, "format": "string", "string_data_size": 16},
]
READ_ONLY = [{"name": "bit", "reg_type": "holding", "address": "55:1:1"}]
LACKING = [
    {"name": "presses", "reg_type": "press_counter", "address": 0},
    {"name": "odd", "reg_type": "input", "address": 90, "format": "s48"},
    {"name": "far", "reg_type": "input", "address": 70000},
]


def wb(channels: list[dict[str, Any]], **device: Any) -> str:
    return json.dumps({"device_type": "x", "device": {"name": "x", "channels": channels, **device}})


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(ROOT))
    return importlib.import_module("bench.questions.files.coverage")


def covered(bench: Any, folder: Path) -> Any:
    devices, unread = bench.load(folder)
    assert unread == []
    return bench.Coverage(devices)


def shares(coverage: Any) -> dict[str, tuple[int, int]]:
    entries = coverage.entries
    return {
        "templates": (len(coverage.by_device), coverage.whole),
        "entries": (len(entries), sum(entry.is_whole for entry in entries)),
        "read": (len(entries), sum(entry.is_held for entry in entries)),
    }


def test_every_supported_key_of_a_register_template_is_converted(bench: Any, tmp_path: Path) -> None:
    (tmp_path / "all.json").write_text(wb(HELD))
    coverage = covered(bench, tmp_path)
    whole = (len(HELD), len(HELD))
    assert shares(coverage) == {"templates": (1, 1), "entries": whole, "read": whole}
    assert {words: (count, held) for words, count, held in coverage.needed()} == {
        "offset": (1, 1),
        "invalid counts": (1, 1),
        "bits of a word": (3, 3),
        "numbers of 64 bit": (2, 2),
        "order of bytes or words": (2, 2),
        "BCD": (1, 1),
        "signed 8 bit": (1, 1),
        "negative step": (1, 1),
        "scale register": (0, 0),
        "named values or bits": (1, 1),
        "text": (2, 2),
        "text of one character a register": (1, 1),
        "written by 16 alone": (1, 1),
        "float that is written": (1, 1),
        "written at another address": (1, 1),
    }


def test_template_entries_without_required_keys_are_counted_with_reasons(bench: Any, tmp_path: Path) -> None:
    (tmp_path / "some.json").write_text(wb([*HELD, *READ_ONLY, *LACKING, *LACKING]))
    (tmp_path / "more.json").write_text(wb(LACKING[:1]))
    whole = len(HELD) + 1 + 2 * len(LACKING) + 1
    coverage = covered(bench, tmp_path)
    assert shares(coverage) == {
        "templates": (2, 0),
        "entries": (whole, len(HELD)),
        "read": (whole, len(HELD) + 1),
    }
    lacking = {reason: (count, found) for reason, count, found in coverage.lacking()}
    (part,) = [reason for reason in lacking if reason.startswith("is read, and not written: a part of")]
    assert lacking.pop(part) == (1, 1)
    assert lacking == {
        "its register type press_counter has no table": (3, 2),
        "its format s48 has no number format": (2, 1),
        "its address is not from N to N": (2, 1),
    }


def test_template_parameters_nested_devices_and_comments_are_read(bench: Any, tmp_path: Path) -> None:
    parameters = {"p": {"title": "p", "address": 5, "condition": "q==1"}}
    within = [{"device_type": "y", "device": {"channels": [HELD[0]], "parameters": [{"address": 6}]}}]
    used = {"name": "inner", "device_type": "y", "shift": 100}
    text = wb([HELD[0], used], parameters=parameters, subdevices=within, setup=[{"address": 1, "value": 2}])
    (tmp_path / "a.json").write_text(
        "// http://x\n" + text.replace("}", "} /* so */ // too\n", 1).replace("]", ",\n]", 1)
    )
    coverage = covered(bench, tmp_path)
    assert (len(coverage.entries), coverage.whole) == (4, 1)
    assert dict(coverage.besides()) == {
        "it is written there; what a write does is not known here": 2,
        "condition was not carried over": 1,
        "setup (devices)": 1,
    }


def test_template_with_conflicting_entries_is_counted_as_refused(bench: Any, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(wb([{"address": 5, "scale": 0.1}, {"address": 5, "scale": 1}]))
    coverage = covered(bench, tmp_path)
    assert (coverage.whole, coverage.refused.total()) == (0, 1)
    assert "is written at the same address" in next(iter(coverage.refused))


def test_templates_of_other_protocols_and_invalid_files_are_skipped(bench: Any, tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "modbus.json").write_text(wb(HELD[:1]))
    (tmp_path / "other.json").write_text(wb(HELD[:1], protocol="uniel"))
    (tmp_path / "broken.json").write_text("{")
    (tmp_path / "list.json").write_text("[]")
    (tmp_path / "empty.json").write_text(wb([]))
    (tmp_path / "table.csv").write_text("name,value\nvoltage,1\n")
    (tmp_path / "notes.txt").write_text("no template")
    devices, unread = bench.load(tmp_path)
    assert len(devices) == 1
    names = [Path(sentence.partition(": ")[0].partition(" is not")[0]).name for sentence in unread]
    assert names == ["broken.json", "empty.json", "list.json", "other.json", "table.csv"]


def test_example_files_of_every_supported_program_are_counted(bench: Any, tmp_path: Path) -> None:
    pytest.importorskip("yaml")
    for suffix, texts in FILES.items():
        for number, text in enumerate(texts):
            (tmp_path / f"{number}{suffix}").write_text(text)
    coverage = covered(bench, tmp_path)
    assert shares(coverage) == {"templates": (10, 2), "entries": (85, 70), "read": (85, 71)}
    lacking = {reason: count for reason, count, _ in coverage.lacking()}
    assert sum(lacking.values()) == 85 - 70
    assert lacking.keys() >= {
        "which bits bool8 means is not known",
        "its order of bytes #WS",
        "its formula is a program",
        "its group repeats as often as the device says",
    }


@pytest.mark.slow
def test_template_coverage_script_prints_its_tables(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(wb([*HELD, *LACKING]))
    (tmp_path / "b.json").write_text("{")
    done = subprocess.run([*SCRIPT, str(tmp_path)], capture_output=True, text=True, cwd=ROOT, check=True)
    whole = len(HELD) + len(LACKING)
    lines = [" ".join(line.split()) for line in done.stdout.splitlines()]
    assert "templates, whole 1 0 0.0%" in lines
    assert f"entries, as they are {whole} {len(HELD)} {len(HELD) / whole:.1%}" in lines
    assert "its register type press_counter has no table 1 1" in lines
    assert lines[-1].startswith(f"not read: {tmp_path / 'b.json'}: ")


@pytest.mark.slow
@pytest.mark.parametrize(("folder", "sentence"), [("none", "is no folder"), (".", "has no template")])
def test_folder_without_register_templates_is_reported(tmp_path: Path, folder: str, sentence: str) -> None:
    command = [*SCRIPT, str(tmp_path / folder)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert sentence in done.stderr
