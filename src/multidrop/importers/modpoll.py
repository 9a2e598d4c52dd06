"""Tables of modpoll: lines `device`, `poll` and `ref` (its documentation, configuration)."""

from __future__ import annotations

import re

from multidrop.importers.device import ImportedDevice, ImportedRegister, unit_address
from multidrop.importers.numbers import number_format, put_number, scaled

_TABLES = {
    **{"coil": "coil", "discrete_input": "discrete"},
    **{"holding_register": "holding", "input_register": "input"},
}
_ORDERS = {"": "", "BE_BE": "", "BE_LE": "CDAB", "LE_BE": "BADC", "LE_LE": "DCBA"}  # bytes, words
_FLAGS = re.compile(r"bool(8|16)?")
_STRING = re.compile(r"string(\d{1,4})")


def read_modpoll(rows: list[list[str]]) -> list[ImportedDevice]:
    """Return the devices of the rows of such a table. Raises ValueError for other rows."""
    devices: list[ImportedDevice] = []
    table = order = ""
    for number, row in enumerate(rows, 1):
        word, *cells = [*(cell.strip() for cell in row), *[""] * 7][:7]
        if not any((word, *cells)):
            continue
        if word == "device":
            devices.append(ImportedDevice(cells[0], unit_address(cells[1])))
            table = ""
        elif word == "poll" and devices:
            table, order = cells[0], cells[3].upper()
        elif word == "ref" and devices:
            with devices[-1].entry(cells[0]):
                _reference(devices[-1], cells, table, order)
        else:
            raise ValueError(f"is no table of modpoll: row {number} is {','.join(row)[:40]!r}")
    return devices


def _reference(device: ImportedDevice, cells: list[str], table: str, order: str) -> None:
    name, place, kind, access, unit, scale = cells[:6]
    at, _, bit = place.partition(":")
    if table not in _TABLES:
        device.lose(name, f"its table {table or '(none)'} is not known")
        return
    register = ImportedRegister(name, int(at, 0), _TABLES[table], is_read="w" not in access or "r" in access)
    register.note_write(is_written="w" in access and register.table in ("holding", "coil"))
    if unit:
        register.details["unit"] = unit
    if register.table in ("coil", "discrete"):
        device.lose(name, f"which bits {kind} means is not known")
        return
    if text := _STRING.fullmatch(kind):
        register.details = {"length": (int(text[1]) + 1) // 2}
        if order.startswith("LE_"):
            register.details["order"] = "BA"
        device.add(register, is_text=True)
        return
    found = "U16" if _FLAGS.fullmatch(kind) or not kind else number_format(kind)
    if found is None:
        device.lose(name, f"its type {kind} has no number format")
        return
    if bit:
        register.details["part"] = bit
    if order not in _ORDERS:
        register.lacks = f"its order of bytes {order}"
    put_number(register.details, found, "" if _FLAGS.fullmatch(kind) else _ORDERS.get(order, ""))
    scaled(register.details, scale)
    device.add(register)
