"""Telegraf's inputs.modbus in its three styles: register, request and metric (plugin's README)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any
from urllib.parse import urlsplit

from multidrop.importers.device import ImportedDevice, ImportedRegister, unit_address
from multidrop.importers.line_settings import LineSettings, network_settings, serial_settings
from multidrop.importers.numbers import TABLES, number_format, put_number, scaled, words_of

_STYLE = {
    "holding_registers": "holding",
    "input_registers": "input",
    "coils": "coil",
    "discrete_inputs": "discrete",
}
_ORDERS = {  # for any width: the plugin takes ABCD's four for 16 and 64 bits as well
    **dict.fromkeys(("ABCD", "AB", "ABCDEFGH", "MSW", "MSW-BE"), ""),
    **dict.fromkeys(("BADC", "BADCFEHG", "MSW-LE"), "BADC"),
    **dict.fromkeys(("CDAB", "GHEFCDAB", "LSW-BE"), "CDAB"),
    **dict.fromkeys(("DCBA", "BA", "HGFEDCBA", "LSW", "LSW-LE"), "DCBA"),
}


def read_telegraf(document: Mapping[str, Any]) -> list[ImportedDevice]:
    """Return a device for each slave id of each line."""
    found: dict[tuple[LineSettings, int | None], ImportedDevice] = {}
    for plugin in document.get("inputs", {}).get("modbus", []):
        line, title = _line(plugin), str(plugin.get("name", ""))
        for slave, table, order, field in _fields(plugin):
            address = unit_address(slave)
            device = found.setdefault((line, address), ImportedDevice(title, address, line=line))
            with device.entry(str(field.get("name", "register"))):
                _add(device, table, order, field)
    return list(found.values())


def _line(plugin: Mapping[str, Any]) -> LineSettings:
    """Return the line of a plugin: a controller of file:///dev/ttyUSB0 or tcp://host:port, and its mode."""
    controller, mode = str(plugin.get("controller", "")), str(plugin.get("transmission_mode", ""))
    if controller.startswith("tcp://"):
        try:
            parts = urlsplit(controller)
            host, port = parts.hostname, parts.port or 502
        except ValueError as mistake:
            raise ValueError(f"controller = {controller[:200]!r} is no address: {mistake}") from mistake
        return network_settings(host, port, is_rtu=mode.lower() == "rtuovertcp")
    keys = {"baudrate": "baud_rate", "bits": "data_bits", "parity": "parity", "stop": "stop_bits"}
    given = {key: plugin[theirs] for key, theirs in keys.items() if theirs in plugin}
    return serial_settings(given, port=controller.removeprefix("file://"), framing=mode)


def _fields(plugin: Mapping[str, Any]) -> Iterator[tuple[Any, str, str, Mapping[str, Any]]]:
    slave = plugin.get("slave_id", 0)
    for key, table in _STYLE.items():
        for field in plugin.get(key, []):
            yield slave, table, field.get("byte_order", ""), field
    for request in [*plugin.get("request", []), *plugin.get("metric", [])]:
        for field in request.get("fields", []):
            table = field.get("register", request.get("register", "holding"))
            order = request.get("byte_order") or "ABCD"  # the plugin's default in these styles
            yield request.get("slave_id", slave), table, order, field


def _add(device: ImportedDevice, table: str, order: str, field: Mapping[str, Any]) -> None:
    name = str(field.get("name", "register"))
    given = field.get("address", 0)
    addresses = given if isinstance(given, list) else [given]
    if table not in TABLES:
        device.lose(name, f"its table {str(table)[:40]!r} is not known")
        return
    register = ImportedRegister(name, addresses[0], table)
    if field.get("omit"):
        device.lose(name, "it is marked omit, and was left out", is_entry=False)
        return
    if "measurement" in field or "output" in field:
        register.gaps.append("measurement and output were not carried over")
    if table in ("coil", "discrete"):
        device.add(register)
    elif str(field.get("data_type", field.get("type"))).upper() == "STRING":
        register.details["length"] = int(field.get("length", len(addresses)))
        if _ORDERS.get(str(order).upper()) in ("BADC", "DCBA"):
            register.details["order"] = "BA"
        device.add(register, is_text=True)
    elif _number(device, register, str(order).upper(), field, addresses):
        device.add(register)


def _number(
    device: ImportedDevice,
    register: ImportedRegister,
    order: str,
    field: Mapping[str, Any],
    addresses: list[Any],
) -> bool:
    kind = str(field.get("data_type", field.get("type", "UINT16"))).upper().removesuffix("-IEEE")
    if kind in ("FIXED", "UFIXED"):  # of as many registers as there are addresses
        kind = f"{'INT' if kind == 'FIXED' else 'UINT'}{16 * len(addresses)}"
    part, kind = _part(kind, field)
    found = number_format(kind)
    if found is None:
        device.lose(register.name, f"its type {kind[:40]} has no number format")
        return False
    if part:
        register.details["part"] = part
    if order and order not in _ORDERS:
        register.lacks = f"its order of bytes {order[:40]}"
    elif not order and words_of(found) > 1:
        register.gaps.append("the order of its words is not stated")
    if len(addresses) > 1 and addresses != list(range(addresses[0], addresses[0] + words_of(found))):
        listed = ", ".join(str(each)[:10] for each in addresses[:5])
        device.lose(register.name, f"its addresses {listed} are not those of a {kind[:40]}, side by side")
        return False
    put_number(register.details, found, _ORDERS.get(order, ""))
    scaled(register.details, field.get("scale", 1))
    return True


def _part(kind: str, field: Mapping[str, Any]) -> tuple[str, str]:
    """Return the bits of a word that a type of less than 16 bits is, and the number's type."""
    if kind == "BIT":
        return str(int(field.get("bit", 0))), "UINT16"
    if kind in ("INT8L", "UINT8L", "INT8H", "UINT8H"):
        return ("0-7" if kind.endswith("L") else "8-15"), f"{kind[:-2]}16"
    return "", kind
