"""CSV and TSV tables: ioBroker's, modpoll's and Neuron's layouts, and any with columns of known names."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping

from multidrop.family_file.addresses import Counting
from multidrop.importers.device import ImportedDevice, ImportedRegister, number_format, scaled, words_of

_ALIASES = {  # of columns, in lower case
    "name": ("name", "register", "description", "parameter", "tag", "signal"),
    "at": ("address", "_address", "at", "register address", "addr", "modbus address"),
    "type": ("type", "data type", "datatype", "dtype", "format"),
    "unit": ("unit", "units"),
    "step": ("scale", "factor", "step", "multiplier", "gain", "decimal"),
    "offset": ("offset",),
    "table": ("table", "register type", "function", "area"),
    "note": ("note", "comment"),
    "formula": ("formula",),
    "is_scale": ("isscale",),
    "length": ("len", "length", "count"),
}
_MODPOLL_TABLES = {
    **{"coil": "coil", "discrete_input": "discrete"},
    **{"holding_register": "holding", "input_register": "input"},
}
_MODPOLL_ORDERS = {"BE_BE": "", "BE_LE": "CDAB", "LE_BE": "BADC", "LE_LE": "DCBA"}
_SUFFIXES = {"be": "", "le": "DCBA", "sw": "CDAB", "sb": "BADC"}  # of ioBroker's types
_NEURON_ORDERS = {"BB": "", "LL": "DCBA"}
_NEURON = re.compile(r"(\d+)!(\d+)(?:[.](\d+))?(?:#([BL]{1,2}))?(.*)")
_TABLE_WORDS = {
    "holding": "holding",
    "input": "input",
    "coil": "coil",
    "discrete": "discrete",
    "3": "holding",
}
_TABLE_WORDS |= {"4": "input", "03": "holding", "04": "input", "1": "coil", "2": "discrete"}


def read_table(text: str, stem: str) -> list[ImportedDevice]:
    """Return the devices of a table. Raises ValueError where no column is an address."""
    if "\0" in text:
        raise ValueError("has zero bytes; save it as CSV UTF-8")
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if not lines:
        raise ValueError("is empty")
    delimiter = max((",", ";", "\t"), key=lines[0].count)
    try:
        rows = list(csv.reader(io.StringIO("\n".join(lines)), delimiter=delimiter))
    except csv.Error as failure:
        raise ValueError(f"is not CSV: {failure}") from failure
    if rows[0][0].strip().lower() in ("device", "poll", "ref"):
        return _modpoll(rows)
    return _columns(rows, stem)


def _modpoll(rows: list[list[str]]) -> list[ImportedDevice]:
    devices: list[ImportedDevice] = []
    table = order = ""
    for row in rows:
        word, *cells = [cell.strip() for cell in row] + [""] * 6
        if word == "device":
            devices.append(ImportedDevice(cells[0], int(cells[1], 0) if cells[1] else None))
        elif word == "poll":
            table, order = _MODPOLL_TABLES.get(cells[0], ""), cells[3]
        elif word == "ref" and devices:
            _modpoll_reference(devices[-1], cells, table, order)
    return devices


def _modpoll_reference(device: ImportedDevice, cells: list[str], table: str, order: str) -> None:
    name, address, kind, access, unit, scale = cells[:6]
    if not table:
        device.lost.append(f"{name}: its table is not known")
        return
    register = ImportedRegister(name, int(address, 0), table)
    if table in ("coil", "discrete"):
        device.lost.append(f"{name}: which bits {kind} means is not known")
        return
    if kind.startswith("string"):
        register.details["length"] = (int(kind.removeprefix("string") or 2) + 1) // 2
        device.add(register, is_text=True)
        return
    _finish(device, register, kind or "uint16", _MODPOLL_ORDERS.get(order.upper()), unit, scale)
    if "w" in access:
        register.gaps.append("it is written there; what a write does is not known here")


def _columns(rows: list[list[str]], stem: str) -> list[ImportedDevice]:
    header = [cell.strip().lower() for cell in rows[0]]
    at = {
        key: next((header.index(alias) for alias in aliases if alias in header), None)
        for key, aliases in _ALIASES.items()
    }
    if at["at"] is None:
        raise ValueError("no column is called address; the first line names the columns")
    devices: dict[int | None, ImportedDevice] = {}
    for row in rows[1:]:
        cells = {
            key: row[place].strip() for key, place in at.items() if place is not None and place < len(row)
        }
        if cells.get("at"):
            _row(devices, cells, stem)
    return list(devices.values())


def _row(devices: dict[int | None, ImportedDevice], cells: Mapping[str, str], stem: str) -> None:
    given, slave, order, part = cells["at"], None, None, ""
    if match := _NEURON.fullmatch(given):
        slave, given, part = int(match[1]), match[2], match[3] or ""
        order = _NEURON_ORDERS.get((match[4] or "")[-2:])
    device = devices.setdefault(slave, ImportedDevice(stem, slave))
    name = cells.get("name") or f"register_{given}"
    stated = _TABLE_WORDS.get(cells.get("table", "").lower().split(" ")[0].split("_")[0])
    counting = Counting(None)
    try:
        address, table = counting.address_in_cell(given, None, stated or "holding")
    except ValueError as mistake:
        device.lost.append(f"{name}: {mistake}")
        return
    register = ImportedRegister(name, address, table)
    if counting.assumed:
        register.gaps.append("whether its address counts from 0 or 1; 0 was assumed")
        if stated is None:
            register.gaps.append("its table; holding was assumed")
    step = cells.get("step", "")
    if formula := cells.get("formula"):
        register.gaps.append(f"its formula {formula} was not carried over: its counts are shown as they are")
        step = "unknown"
    if cells.get("is_scale", "").lower() == "true":
        device.lost.append(f"{name}: that it scales others was not carried over")
    kind = cells.get("type", "") or "uint16"
    if kind.lower().startswith("string"):
        if not cells.get("length", "").isdecimal():
            device.lost.append(f"{name}: a text of unknown length")
            return
        register.details["length"] = int(cells["length"])
        device.add(register, is_text=True)
        return
    if table in ("coil", "discrete"):
        device.add(register)
        return
    if part and kind.lower() not in ("bit", "bool"):
        device.lost.append(f"{name}: a bit of a number of type {kind} has no meaning here")
        return
    if part or kind.lower() in ("bit", "bool"):
        kind, register.details["part"] = "uint16", part or "0"
    if match := re.fullmatch(r"(u?int\d+|float|double)(be|le|sw|sb)", kind.lower()):
        kind, order = match[1], _SUFFIXES[match[2]]
    if note := cells.get("note"):
        register.details["note"] = note
    _finish(device, register, kind, order, cells.get("unit", ""), step, cells.get("offset", ""))


def _finish(
    device: ImportedDevice,
    register: ImportedRegister,
    kind: str,
    order: str | None,
    unit: str,
    step: str,
    offset: str = "",
) -> None:
    """Add the register with its number; `order` is None where it is not stated."""
    found = number_format(kind)
    if found is None:
        device.lost.append(f"{register.name}: its type {kind} has no number format")
        return
    if found != "U16":
        register.details["number_format"] = found
    if words_of(found) > 1 and order is None:
        register.gaps.append("the order of its words is not stated")
    elif order and words_of(found) > 1:
        register.details["order"] = order
    elif order in ("DCBA", "BADC"):
        register.details["order"] = "BA"
    if unit:
        register.details["unit"] = unit
    try:
        scaled(register.details, step, offset)
    except ValueError:
        register.gaps.append(f"its scale {step!r} or offset {offset!r} is no number")
        register.details["step"] = "unknown"
    device.add(register)
