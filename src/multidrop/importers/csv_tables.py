"""CSV and TSV tables: ioBroker's, modpoll's and Neuron's layouts, and any with columns of known names."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping

from multidrop.family_file.addresses import Counting
from multidrop.importers import neuron
from multidrop.importers.device import ImportedDevice, ImportedRegister, unit_address
from multidrop.importers.modpoll import read_modpoll
from multidrop.importers.numbers import number_format, put_number, scaled, words_of

_ALIASES = {  # of columns, in lower case
    "name": ("name", "register", "description", "parameter", "tag", "signal"),
    "at": ("address", "_address", "at", "register address", "addr", "modbus address"),
    "type": ("type", "data type", "datatype", "dtype", "format"),
    "unit": ("unit", "units"),
    "step": ("scale", "factor", "step", "multiplier", "gain", "decimal"),
    "offset": ("offset",),
    "table": ("table", "register type", "function", "area"),
    "slave": ("deviceid", "slave", "unit id"),
    "note": ("note", "comment"),
    "formula": ("formula",),
    "is_scale": ("isscale",),
    "length": ("len", "length", "count"),
    "access": ("attribute", "access"),
}
_TYPE = re.compile(r"(u?int(?:16|32|64)|float|double)(be|le|sw|sb)")  # ioBroker's
_BYTES = {"uint8be": "0-7", "uint8le": "8-15", "int8be": "0-7", "int8le": "8-15"}
_TEXT_ORDERS = {"string": "", "stringle": "BA", "string16": "B"}
_SUFFIXES = {"be": "", "le": "DCBA", "sw": "CDAB", "sb": "BADC"}
_TABLE_WORDS = {
    **{"holding": "holding", "input": "input", "coil": "coil", "discrete": "discrete"},
    **{"3": "holding", "4": "input", "03": "holding", "04": "input", "1": "coil", "2": "discrete"},
}


def read_table(text: str, stem: str) -> list[ImportedDevice]:
    """Return the devices of a table. Raises ValueError where no column is an address."""
    if "\0" in text:
        raise ValueError("has zero bytes; save it as CSV UTF-8")
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if not lines:
        raise ValueError("is empty: it has no line but comments")
    delimiter = max((",", ";", "\t"), key=lines[0].count)
    try:
        rows = list(csv.reader(io.StringIO("\n".join(lines)), delimiter=delimiter))
    except csv.Error as failure:
        raise ValueError(f"is not CSV: {failure}") from failure
    if rows[0] and rows[0][0].strip().lower() in ("device", "poll", "ref"):
        return read_modpoll(rows)
    return _columns(rows, stem)


def _columns(rows: list[list[str]], stem: str) -> list[ImportedDevice]:
    header = [cell.strip().lower() for cell in rows[0]]
    at = {
        key: next((header.index(alias) for alias in aliases if alias in header), None)
        for key, aliases in _ALIASES.items()
    }
    if at["at"] is None:
        raise ValueError("no column is called address; the first line names the columns")
    devices: dict[int | None, ImportedDevice] = {}
    whole = ImportedDevice(stem)  # counts the entries
    for row in rows[1:]:
        cells = {
            key: row[place].strip() for key, place in at.items() if place is not None and place < len(row)
        }
        if cells.get("at"):
            with whole.entry(cells.get("name", "")):
                _row(devices, cells, stem)
    return [*devices.values(), *([whole] if whole.lost else [])]


def _row(devices: dict[int | None, ImportedDevice], cells: Mapping[str, str], stem: str) -> None:
    tag = neuron.parse_tag(cells["at"])
    slave = unit_address(tag.slave if tag else cells.get("slave"))
    device = devices.setdefault(slave, ImportedDevice(stem, slave))
    given = tag.address if tag else cells["at"]
    name = cells.get("name") or f"register_{given}"
    with device.entry(name):
        stated = _TABLE_WORDS.get(cells.get("table", "").lower().split(" ")[0].split("_")[0])
        counting = Counting(None)
        address, table = counting.address_in_cell(given, None, stated or "holding")
        register = ImportedRegister(name, address, table)
        if counting.assumed:
            register.gaps.append("whether its address counts from 0 or 1; 0 was assumed")
            if stated is None:
                register.gaps.append("its table; holding was assumed")
        _fill(device, register, cells, tag)


def _fill(
    device: ImportedDevice, register: ImportedRegister, cells: Mapping[str, str], tag: neuron.Tag | None
) -> None:
    """Add the register, a text or a number, as its cells say."""
    kind = (cells.get("type") or "uint16").lower()
    if note := cells.get("note"):
        register.details["note"] = note
    if cells.get("formula"):
        register.lacks = "its formula is a program"
    elif cells.get("is_scale", "").lower() == "true":
        register.gaps.append("it scales other registers, which are not named: `scale_register`")
    if "write" in cells.get("access", "").lower():
        register.note_write()
    if tag and kind == "string":
        neuron.add_text(device, register, tag)
    elif kind.startswith("string"):
        _text(device, register, cells.get("length", ""), kind)
    elif register.table in ("coil", "discrete"):
        device.add(register)
    else:
        _number(device, register, kind, cells, tag)


def _text(device: ImportedDevice, register: ImportedRegister, length: str, kind: str) -> None:
    if not length.isdecimal():
        device.lose(register.name, "a text of unknown length")
        return
    register.details.pop("note", None)
    register.details["length"] = int(length[:6])
    if kind not in _TEXT_ORDERS:
        device.lose(register.name, f"a text of the type {kind[:40]}")
        return
    if order := _TEXT_ORDERS[kind]:
        register.details["order"] = order
    device.add(register, is_text=True)


def _number(
    device: ImportedDevice,
    register: ImportedRegister,
    kind: str,
    cells: Mapping[str, str],
    tag: neuron.Tag | None,
) -> None:
    order: str | None = None
    if (tag and tag.part) or kind in ("bit", "bool"):
        kind, register.details["part"] = "uint16", (tag.part if tag else "") or "0"
    if kind in _BYTES:
        register.details["part"] = _BYTES[kind]
        kind = "int16" if kind.startswith("int") else "uint16"
    if match := _TYPE.fullmatch(kind):
        kind, order = match[1], _SUFFIXES[match[2]]
    found = number_format(kind)
    if found is None:
        device.lose(register.name, f"its type {kind[:40]} has no number format")
        return
    if tag:
        order = neuron.order_of(register, tag, found)
    elif order is None and words_of(found) > 1:
        register.gaps.append("the order of its words is not stated")
    put_number(register.details, found, order or "")
    if unit := cells.get("unit"):
        register.details["unit"] = unit
    step, offset = cells.get("step", ""), cells.get("offset", "")
    try:
        scaled(register.details, step, offset)
    except ValueError:
        register.lacks = f"its scale {step[:40]!r} or offset {offset[:40]!r} is no number"
    if "," in step + offset and not register.lacks:
        register.gaps.append(f"the comma of {step or offset} was taken for a decimal point")
    device.add(register)
