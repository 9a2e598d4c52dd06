"""Every key of another program's schema is imported, ignored or marked as a gap (a property not imported)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from imported import entries, gaps, omissions, only
from tables import table

from multidrop.importers import csv_tables, esphome, home_assistant, sunspec, telegraf, wb
from multidrop.importers.device import KeyTable, Treatment, unimported_keys

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
    assert set(table.values()) <= set(Treatment)


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


def test_settings_of_a_hub_that_are_not_imported_are_reported(tmp_path: Path) -> None:
    pytest.importorskip("yaml")
    hub = f"modbus:\n  - name: hub\n    delay: 5\n    novel: 1\n    timeout: 3\n    sensors: [{SENSOR}}}]\n"
    assert omissions(only(tmp_path, "a.yaml", hub)) == [
        "the hub: delay was not carried over",
        "the hub: novel is not known here, and was not carried over",
    ]
