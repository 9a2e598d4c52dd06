"""Import Telegraf's inputs.modbus in its three configuration styles: register, request and metric.

The key tables follow the plugin's README and its configuration structs.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from multidrop.importers.device import (
    ImportedDevice,
    ImportedRegister,
    LineSettings,
    key_table,
    network_settings,
    serial_settings,
    unimported_keys,
    unit_address,
)
from multidrop.importers.parsing import TABLES, number_format, put_number, scaled, whole, words_of

_REGISTER_STYLE = {
    "holding_registers": "holding",
    "input_registers": "input",
    "coils": "coil",
    "discrete_inputs": "discrete",
}
_ORDERS = {  # byte orders by the plugin's names; they also apply to 16-bit and 64-bit numbers
    **dict.fromkeys(("ABCD", "AB", "ABCDEFGH", "MSW", "MSW-BE"), ""),
    **dict.fromkeys(("BADC", "BADCFEHG", "MSW-LE"), "BADC"),
    **dict.fromkeys(("CDAB", "GHEFCDAB", "LSW-BE"), "CDAB"),
    **dict.fromkeys(("DCBA", "BA", "HGFEDCBA", "LSW", "LSW-LE"), "DCBA"),
}
FIELD_KEYS = {  # how to treat each key, by configuration style
    "register": key_table(imported="name byte_order data_type scale address bit", irrelevant="measurement"),
    "request": key_table(
        imported="address name type length scale omit bit", irrelevant="measurement", gap="output"
    ),
    "metric": key_table(imported="register address length name type scale bit", gap="output"),
}
_PLACE = "slave_id byte_order fields"
BLOCK_KEYS = {
    "request": key_table(
        imported=f"{_PLACE} register",
        irrelevant="measurement optimization optimization_max_register_fill tags",
    ),
    "metric": key_table(imported=_PLACE, irrelevant="measurement tags"),
}
WORKAROUND_KEYS = key_table(
    imported="string_register_location",
    irrelevant="close_connection_after_gather read_coils_starting_at_zero",
    gap="pause_after_connect pause_between_requests one_request_per_field max_bit_registers_per_request "
    "max_word_registers_per_request",
)
PLUGIN_KEYS = key_table(
    imported="name controller transmission_mode baud_rate data_bits parity stop_bits configuration_type "
    f"slave_id workarounds request metric {' '.join(_REGISTER_STYLE)}",
    irrelevant="timeout busy_retries busy_retries_wait debug_connection log_level exclude_register_type_tag "
    "optimization optimization_max_register_fill alias interval precision collection_jitter "
    "collection_offset name_override name_prefix name_suffix tags namepass namedrop fieldpass fielddrop "
    "fieldinclude fieldexclude tagpass tagdrop taginclude tagexclude metricpass startup_error_behavior "
    "always_include_local_tags always_include_global_tags skip_processors_after_aggregators",
    gap="rs485",
)


class _Field(NamedTuple):
    """A field of Telegraf's plugin inputs.modbus, with the settings of the TOML tables that contain it."""

    given: Mapping[str, Any]
    style: str
    slave: Any
    table: Any
    order: str
    text_bytes: str


def read_telegraf(document: Mapping[str, Any]) -> list[ImportedDevice]:
    """Return a device for each slave id on each line. Raises ValueError if the file has no fields."""
    inputs = document.get("inputs")
    plugins = inputs.get("modbus") if isinstance(inputs, dict) else None
    if plugins is None:
        tables = ", ".join(str(key)[:40] for key in list(document)[:8]) or "nothing"
        raise ValueError(f"the file has no [[inputs.modbus]] (Telegraf): it has {tables}")
    found: dict[tuple[LineSettings, int | None], ImportedDevice] = {}
    for plugin in plugins if isinstance(plugins, list) else [plugins]:
        line, title = _line(plugin), str(plugin.get("name", ""))
        here: ImportedDevice | None = None
        for field in _fields(plugin):
            address = unit_address(field.slave, "slave_id")
            device = found.setdefault((line, address), ImportedDevice(title, address, line=line))
            here = here or device
            with device.entry(str(field.given.get("name", "register"))):
                _add(device, field)
        if here is not None:
            _lose_settings(here, plugin)
    if not found:
        lists = ", ".join((*_REGISTER_STYLE, *BLOCK_KEYS))
        raise ValueError(f"[[inputs.modbus]] has no field in {lists}")
    return list(found.values())


def _lose_settings(device: ImportedDevice, plugin: Mapping[str, Any]) -> None:
    device.lose_keys("inputs.modbus", plugin, PLUGIN_KEYS)
    device.lose_keys("workarounds", plugin.get("workarounds") or {}, WORKAROUND_KEYS)
    for style, table in BLOCK_KEYS.items():
        for block in plugin.get(style) or ():
            device.lose_keys(style, block, table)
            if "slave_id" not in block and "slave_id" in plugin:
                reason = "it has no slave_id, for which Telegraf asks unit 0; the plugin's was taken"
                device.lose(style, reason, is_entry=False)


def _line(plugin: Mapping[str, Any]) -> LineSettings:
    """Return the line settings of a controller such as file:///dev/ttyUSB0 or tcp://host:port."""
    controller, mode = str(plugin.get("controller", "")), str(plugin.get("transmission_mode", ""))
    if controller.startswith("tcp://"):
        try:
            parts = urlsplit(controller)
            host, port = parts.hostname, parts.port or 502
        except ValueError as mistake:
            if "$" in controller:  # the host is in an environment variable
                return network_settings(None, 502)
            raise ValueError(f"controller = {controller[:200]!r} is not an address: {mistake}") from mistake
        framing = mode.lower().removesuffix("overtcp")
        is_serial = framing in ("rtu", "ascii")
        return network_settings(
            host, port, is_serial_frames=is_serial, framing=framing if is_serial else "rtu"
        )
    return serial_settings(plugin, port=controller.removeprefix("file://"), framing=mode)


def _fields(plugin: Mapping[str, Any]) -> Iterator[_Field]:
    """Yield the fields in the style that the plugin states; if it states none, in all styles."""
    style, slave = str(plugin.get("configuration_type", "")), plugin.get("slave_id")
    text = str((plugin.get("workarounds") or {}).get("string_register_location") or "both")
    if style in ("", "register"):
        for key, table in _REGISTER_STYLE.items():
            for field in plugin.get(key) or ():
                yield _Field(field, "register", slave, table, str(field.get("byte_order", "")), text)
    for kind in ("request", "metric"):
        for block in plugin.get(kind) or () if style in ("", kind) else ():
            for field in block.get("fields") or ():
                table = block.get("register", "holding") if kind == "request" else field.get("register")
                order = str(block.get("byte_order") or "ABCD")  # default of the styles "request" and "metric"
                yield _Field(field, kind, block.get("slave_id", slave), table or "holding", order, text)


def _add(device: ImportedDevice, field: _Field) -> None:
    given = field.given
    name, is_bit = str(given.get("name", "register")), field.table in ("coil", "discrete")
    if field.table not in TABLES:
        device.lose(name, f"its table {str(field.table)[:40]!r} is not known")
        return
    listed = given["address"]
    addresses = listed if isinstance(listed, list) and listed else [whole(given, "address")]
    register = ImportedRegister(name, addresses[0], field.table)
    if given.get("omit"):
        device.lose(name, "it is marked omit, and was left out", is_entry=False)
        return
    register.gaps += [] if is_bit else unimported_keys(given, FIELD_KEYS[field.style])
    kind = given.get("data_type" if field.style == "register" else "type")
    if is_bit:
        device.add(register)
    elif str(kind).upper() == "STRING":
        _text(device, register, field, len(addresses))
    elif _number(device, register, field, addresses, kind):
        device.add(register)


def _text(device: ImportedDevice, register: ImportedRegister, field: _Field, words: int) -> None:
    register.details["length"] = words if field.style == "register" else whole(field.given, "length")
    if field.text_bytes == "lower":
        register.details["order"] = "B"
    elif field.text_bytes != "both":
        device.lose(register.name, f"a text whose string_register_location is {field.text_bytes[:40]}")
        return
    elif _ORDERS.get(field.order.upper()) in ("BADC", "DCBA"):
        register.details["order"] = "BA"
    device.add(register, is_text=True)


def _number(
    device: ImportedDevice, register: ImportedRegister, field: _Field, addresses: list[Any], kind: Any
) -> bool:
    order, spelt = field.order.upper(), str(kind or "UINT16").upper()
    if not kind:
        register.gaps.append("its type is not stated; UINT16 was assumed")
    part, plain = _part(_plain_type(field.style, spelt, len(addresses)), field.given)
    found = number_format(plain)
    if found is None:
        device.lose(register.name, f"its type {spelt[:40]} has no number format")
        return False
    if part:
        register.details["part"] = part
    if order and order not in _ORDERS:
        register.lacks = f"its order of bytes {order[:40]}"
    elif not order and words_of(found) > 1:
        register.gaps.append("the order of its words is not stated")
    if len(addresses) > 1 and addresses != list(range(addresses[0], addresses[0] + words_of(found))):
        listed = ", ".join(str(each)[:10] for each in addresses[:5])
        device.lose(register.name, f"its addresses {listed} are not those of a {spelt[:40]}, side by side")
        return False
    put_number(register.details, found, _ORDERS.get(order, ""))
    scaled(register.details, field.given.get("scale", 1))
    return True


def _plain_type(style: str, kind: str, words: int) -> str:
    """Return a type name that means the same in all configuration styles of the plugin.

    In the style "register", only types whose names end in -IEEE are floats. FLOAT32 is a whole number there,
    with one word for each listed address. In the other styles, FLOAT32 is a float.
    """
    if style != "register":
        return kind.removesuffix("-IEEE")
    if kind in ("FIXED", "UFIXED", "FLOAT32"):
        return f"{'INT' if kind == 'FIXED' else 'UINT'}{16 * words}"
    return f"{kind} of this style" if kind in ("FLOAT16", "FLOAT64") else kind.removesuffix("-IEEE")


def _part(kind: str, field: Mapping[str, Any]) -> tuple[str, str]:
    """Return which bits of the word a type uses ("" for all), and the type of the whole number."""
    if kind == "BIT":
        return str(whole(field, "bit", 0)), "UINT16"
    if kind in ("INT8L", "UINT8L", "INT8H", "UINT8H"):
        return ("0-7" if kind.endswith("L") else "8-15"), f"{kind[:-2]}16"
    return "", kind
