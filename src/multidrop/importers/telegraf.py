"""Telegraf's inputs.modbus in its three styles: register, request and metric (plugin's README)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from multidrop.importers.device import (
    TABLES,
    ImportedDevice,
    ImportedRegister,
    number_format,
    scaled,
    words_of,
)

_STYLE = {
    "holding_registers": "holding",
    "input_registers": "input",
    "coils": "coil",
    "discrete_inputs": "discrete",
}
_ORDERS = {"ABCD": "", "AB": "", "ABCDEFGH": "", "BA": "BA", "CDAB": "CDAB", "BADC": "BADC", "DCBA": "DCBA"}
_WORD_WISE = {"GHEFCDAB": "CDAB", "BADCFEHG": "BADC", "HGFEDCBA": "DCBA"}


def read_telegraf(document: Mapping[str, Any]) -> list[ImportedDevice]:
    """Return a device for each slave id."""
    found: dict[int, ImportedDevice] = {}
    for plugin in document.get("inputs", {}).get("modbus", []):
        for slave, table, order, field in _fields(plugin):
            device = found.setdefault(slave, ImportedDevice(str(plugin.get("name", "")), slave))
            _add(device, table, order, field)
    return list(found.values())


def _fields(plugin: Mapping[str, Any]) -> Iterator[tuple[int, str, str, Mapping[str, Any]]]:
    slave = plugin.get("slave_id", 0)
    for key, table in _STYLE.items():
        for field in plugin.get(key, []):
            yield slave, table, field.get("byte_order", ""), field
    for request in [*plugin.get("request", []), *plugin.get("metric", [])]:
        for field in request.get("fields", []):
            table = field.get("register", request.get("register", "holding"))
            yield request.get("slave_id", slave), table, request.get("byte_order", ""), field


def _add(device: ImportedDevice, table: str, order: str, field: Mapping[str, Any]) -> None:
    name = str(field.get("name", "register"))
    given = field.get("address", 0)
    addresses = given if isinstance(given, list) else [given]
    if table not in TABLES:
        device.lost.append(f"{name}: its table {table!r} is not known")
        return
    register = ImportedRegister(name, addresses[0], table)
    if field.get("omit"):
        device.lost.append(f"{name}: it is marked omit, and was left out")
        return
    if table in ("holding", "input"):
        if not _number(device, register, order, field, len(addresses)):
            return
        if "measurement" in field or "output" in field:
            register.gaps.append("measurement and output were not carried over")
    device.add(register)


def _number(
    device: ImportedDevice, register: ImportedRegister, order: str, field: Mapping[str, Any], count: int
) -> bool:
    kind = str(field.get("data_type", field.get("type", "UINT16"))).upper().removesuffix("-IEEE")
    if kind in ("FIXED", "UFIXED"):  # of as many registers as there are addresses
        kind = f"{'INT' if kind == 'FIXED' else 'UINT'}{16 * count}"
    if kind in ("INT8L", "UINT8L", "INT8H", "UINT8H"):
        register.details["part"] = "0-7" if kind.endswith("L") else "8-15"
        kind = "INT16" if kind.startswith("INT") else "UINT16"
    elif kind == "BIT":
        register.details["part"] = str(field.get("bit", 0))
        kind = "UINT16"
    found = number_format(kind)
    if found is None:
        device.lost.append(f"{register.name}: its type {kind} has no number format")
        return False
    if found != "U16":
        register.details["number_format"] = found
    order = order.upper()
    mended = _ORDERS.get(order, _WORD_WISE.get(order))
    if mended:
        register.details["order"] = mended
    elif mended is None and order:
        register.gaps.append(f"its byte order {order} was not carried over")
    elif not order and words_of(found) > 1:
        register.gaps.append("the order of its words is not stated")
    scaled(register.details, field.get("scale", 1))
    return True
