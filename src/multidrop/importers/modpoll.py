"""Import modpoll's tables with lines `device`, `poll` and `ref`; see "configuration" in its documentation."""

from __future__ import annotations

import re

from multidrop.importers.device import ImportedDevice, ImportedRegister, unit_address
from multidrop.importers.parsing import number_format, put_number, scaled, whole, words_of

_TABLES = {
    **{"coil": "coil", "discrete_input": "discrete"},
    **{"holding_register": "holding", "input_register": "input"},
}
# byte orders by modpoll's names, such as BE_LE: first the order in a word, then that of the words
_ORDERS = {"BE_BE": "", "BE_LE": "CDAB", "LE_BE": "BADC", "LE_LE": "DCBA"}
_CELLS = 7  # limit of cells in a row: keyword, name, address, type, access, unit, scale
_FLAGS = re.compile(r"bool(8|16)?")
_STRING = re.compile(r"string([0-9]{1,4})")


def read_modpoll(rows: list[list[str]]) -> list[ImportedDevice]:
    """Return the devices of a modpoll table.

    Raises ValueError for a row that starts with another word than "device", "poll" or "ref".
    """
    devices: list[ImportedDevice] = []
    table = order = ""
    for number, row in enumerate(rows, 1):
        word, *cells = [*(cell.strip() for cell in row), *[""] * _CELLS][:_CELLS]
        if not any((word, *cells)):
            continue
        if word == "device":
            devices.append(ImportedDevice(cells[0], unit_address(cells[1] or None, f"row {number}: device")))
            table = ""
        elif word == "poll" and devices:
            table, order = cells[0], cells[3].upper()
        elif word == "ref" and devices:
            with devices[-1].entry(cells[0]):
                if any(cell.strip() for cell in row[_CELLS:]):
                    raise ValueError(f"row {number} has more than {_CELLS} cells")
                _reference(devices[-1], cells, table, order)
        else:
            raise ValueError(f"the file is not a modpoll table: row {number} is {','.join(row)[:40]!r}")
    return devices


def _reference(device: ImportedDevice, cells: list[str], table: str, order: str) -> None:
    name, place, kind, access, unit, scale = cells[:6]
    at, _, bit = place.partition(":")
    if table not in _TABLES:
        device.lose(name, f"its table {table or '(none)'} is not known")
        return
    address, access = whole({"address": at}, "address"), access.lower()
    register = ImportedRegister(name, address, _TABLES[table], is_read="w" not in access or "r" in access)
    register.note_write(is_written="w" in access and register.table in ("holding", "coil"))
    if access.strip("rw"):
        register.gaps.append(f"its access {access[:40]!r} is none of r, w and rw")
    if unit:
        register.details["unit"] = unit
    if register.table in ("coil", "discrete"):
        device.lose(name, f"which bits {kind} means is not known")
        return
    if text := _STRING.fullmatch(kind):
        # A byte order that modpoll states for a whole group of registers does not apply to texts.
        register.details = {"length": (int(text[1]) + 1) // 2}
        device.add(register, is_text=True)
        return
    kind = kind.lower()
    is_flags = bool(_FLAGS.fullmatch(kind))
    found = "U16" if is_flags or not kind else number_format(kind)
    if not kind:
        register.gaps.append("its type is not stated; uint16 was assumed")
    if is_flags and not bit:
        register.gaps.append(f"its type {kind} is a list of bits there; the whole word is read")
    if found is None:
        device.lose(name, f"its type {kind} has no number format")
        return
    if bit:
        register.details["part"] = bit
    if not order and words_of(found) > 1:
        register.gaps.append("the order of its words is not stated; BE_LE was assumed, as modpoll does")
        order = "BE_LE"
    if order and order not in _ORDERS:
        register.lacks = f"its order of bytes {order}"
    put_number(register.details, found, "" if is_flags else _ORDERS.get(order, ""))
    scaled(register.details, scale)
    device.add(register)
