"""Import CSV and TSV tables of ioBroker, modpoll and Neuron, and other tables with known column names.

If programs use a column name with different meanings, the most frequent meaning is assumed, and noted
in the family file.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction

from multidrop.families.files.notation import Counting
from multidrop.importers.device import ImportedDevice, ImportedRegister, unit_address
from multidrop.importers.modpoll import read_modpoll
from multidrop.importers.parsing import (
    bits_text,
    format_of_width,
    number,
    number_format,
    put_number,
    words_of,
)

# names of the CSV column for each key of a register, in lower case and without _; if several columns have
# such names, the first name in the list wins
COLUMNS = {
    "name": (
        *("name", "register name", "signal name", "parameter name", "register", "description", "parameter"),
        *("tag", "signal", "variable", "point", "title"),
    ),
    "at": (
        *("address", "at", "register address", "addr", "modbus address", "start address", "reg address"),
        *("protocol address", "register number", "reg"),
    ),
    "type": (
        *("type", "data type", "datatype", "dtype", "format", "data format", "value type", "variable type"),
    ),
    "unit": ("unit", "units"),
    "factor": ("factor", "multiplier", "step", "resolution"),
    "scale": ("scale", "scaling", "scale factor", "scaling factor", "coefficient", "ratio"),
    "divisor": ("divisor", "divider"),
    "gain": ("gain",),
    "decimal": ("decimal", "decimals", "decimal places", "decimal point", "dp", "precision"),
    "offset": ("offset", "bias"),
    "table": ("table", "register type", "reg type", "area", "object type", "register table", "memory area"),
    "function": ("function", "function code", "fc", "modbus function", "read function", "func"),
    "slave": ("deviceid", "device id", "slave", "slave id", "unit id", "node id", "station"),
    "note": ("note", "comment", "notes", "comments", "remark", "remarks"),
    "formula": ("formula",),
    "is scale": ("isscale", "is scale"),
    "length": (
        *("len", "length", "count", "quantity", "registers", "number of registers", "register count"),
        *("words", "num registers", "size"),
    ),
    "access": (
        *("attribute", "access", "rw", "r/w", "read/write", "mode", "permission", "access type"),
        *("access mode", "access right", "access rights"),
    ),
    "order": ("order", "byte order", "word order", "endian", "endianness", "endianess", "swap", "byteorder"),
    "bit": ("bit", "bits", "bit position", "bit number", "bit offset"),
    "signed": ("signed", "sign"),
}
IRRELEVANT = frozenset(
    {
        *("group", "interval", "role", "room", "poll", "wp", "cw", "no", "no.", "#", "nr", "index", "id"),
        *("category", "min", "minimum", "max", "maximum", "range", "default", "default value", "value"),
        *("description", "label", "device class", "state class", "icon", "example", "version", "section"),
    }
)
GAPS = frozenset(
    {
        *("values", "enum", "enumeration", "options", "value map", "mapping", "states", "mask", "bitmask"),
        *("invalid", "invalid value", "nan", "error value", "exponent", "sf", "condition", "length in bytes"),
        *("bytes", "byte count", "digits", "encoding"),
    }
)
_SPARE = frozenset(alias for key in ("name", "note", "at") for alias in COLUMNS[key])
# Names of columns that may affect a register's value. All aliases of a key are listed, because a second
# column for the same key may contradict the first.
_VALUE_COLUMNS = GAPS | frozenset(alias for aliases in COLUMNS.values() for alias in aliases) - _SPARE
_KNOWN = IRRELEVANT | _VALUE_COLUMNS | _SPARE
_NUMBER = re.compile(r"[0-9]{1,9}")
_COMMENT = re.compile(r"\s*#(?!\s*[,;\t])")  # start of a comment; a column may have the name #
_ORDERED = re.compile(r"(u?int(?:16|32|64)|float|double)(be|le|sw|sb)")  # type names of ioBroker
_BYTES = {"uint8be": "0-7", "uint8le": "8-15", "int8be": "0-7", "int8le": "8-15"}
_TEXT_ORDERS = {"string": "", "stringle": "BA", "string16": "B"}
_SUFFIXES = {"be": "", "le": "DCBA", "sw": "CDAB", "sb": "BADC"}
_ORDERS = {
    **dict.fromkeys(("abcd", "ab", "big", "be"), ""),
    **{"cdab": "CDAB", "badc": "BADC", "dcba": "DCBA", "ba": "DCBA"},
}
_STEP_COLUMNS = ("factor", "scale", "divisor", "gain", "decimal")
_WHOLE = re.compile(r"(?:(u|unsigned)|signed)?int(?:eger)?(\d*)(?:t|bits?)?")
_BIT_TYPES = frozenset({"bit", "bool", "boolean", "binary", "coil", "flag"})
_NAMED_TABLES = (  # prefix of a cell and the table that it means; the first prefix that matches applies
    *(("holding", "holding"), ("hr", "holding"), ("4x", "holding")),
    *(("discrete", "discrete"), ("input status", "discrete"), ("input contact", "discrete")),
    *(("input coil", "discrete"), ("di", "discrete"), ("1x", "discrete"), ("contact", "discrete")),
    *(("input", "input"), ("ir", "input"), ("3x", "input")),
    *(("coil", "coil"), ("do", "coil"), ("0x", "coil"), ("output coil", "coil")),
)
_FUNCTIONS = {1: "coil", 2: "discrete", 3: "holding", 4: "input"}
_WRITES = {5: "coil", 6: "holding", 15: "coil", 16: "holding"}
_BARE_HEX = re.compile(r"(?=[0-9]*[a-fA-F])[0-9a-fA-F]{1,8}")
# addresses such as 40001 or 400001: a digit for the table, then a number from 1
_REFERENCE = re.compile(r"[0134][0-9]{4,5}")
_ACCESS = {  # for each text of a cell: whether the register can be read, and written
    **dict.fromkeys(("r", "ro", "read", "readonly", "rd"), (True, False)),
    **dict.fromkeys(("w", "wo", "write", "writeonly"), (False, True)),
    **dict.fromkeys(
        ("rw", "wr", "readwrite", "writeread", "rwro", "readandwrite", "readwritable"), (True, True)
    ),
}
_SIGNED = {"signed": True, "yes": True, "y": True, "true": True, "s": True}
_SIGNED |= {"unsigned": False, "no": False, "n": False, "false": False, "u": False}

MOST_TITLES = 20  # limit of lines above the line with the column names
MOST_UNKNOWN = 20  # limit of unknown columns in one message

Cells = Mapping[str, str]


def read_table(text: str, stem: str) -> list[ImportedDevice]:
    """Return the devices of a table. Raises ValueError if the table has no address column or no row."""
    if "\0" in text:
        raise ValueError("the file contains NUL bytes; save it as CSV UTF-8")
    lines = [line for line in text.splitlines() if line.strip() and not _COMMENT.match(line)]
    if not lines:
        raise ValueError("the file is empty: it has only comments")
    head = lines[0] if re.search("[,;\t]", lines[0]) else "\n".join(lines[:MOST_TITLES])
    delimiter = max((",", ";", "\t"), key=head.count)
    try:
        rows = list(csv.reader(io.StringIO("\n".join(lines)), delimiter=delimiter))
    except csv.Error as failure:
        raise ValueError(f"the file is not CSV: {failure}") from failure
    if rows[0] and rows[0][0].strip().lower() in ("device", "poll", "ref"):
        return read_modpoll(rows)
    names = ([_plain_name(cell)[0] for cell in row] for row in rows[:MOST_TITLES])
    header = next((at for at, row in enumerate(names) if "at" in _places(row)), 0)
    return _columns(rows[header:], stem)


# ---- columns ----


def _columns(rows: list[list[str]], stem: str) -> list[ImportedDevice]:
    layout = _Layout(rows)
    devices: dict[int | None, ImportedDevice] = {}
    table = ImportedDevice(stem)  # all rows of the file, to count and to limit them
    unknown: set[str] = set()
    for row in rows[1:]:
        cells, further = layout.cells(row), layout.further(row)
        if not cells.get("at"):
            if cells.get("name"):
                table.lose(cells["name"], "its row has no address")
            continue
        unknown |= further - _KNOWN
        with table.entry(cells.get("name", "")):
            _row(devices, cells, layout.gaps(cells, further), stem)
    if not devices and not table.lost:
        raise ValueError("the file has no row with an address, below the line that names the columns")
    first = next(iter(devices.values()), table)
    for name in sorted(unknown)[:MOST_UNKNOWN]:
        first.lose(f"the column {name[:40]}", "is not known here, and was not carried over", is_entry=False)
    return [*devices.values(), *([table] if table.lost else [])]


class _Layout:
    """The columns of a table, as its header line names them. Raises ValueError without an address column."""

    def __init__(self, rows: list[list[str]]) -> None:
        header = [_plain_name(cell) for cell in rows[0]]
        self._at = _places([name for name, _ in header])
        if "at" not in self._at:
            shown = ", ".join(cell.strip()[:20] for cell in rows[0][:8])
            raise ValueError(f"no column is called address; the first line names these columns: {shown}")
        place = self._at["at"]
        self._length = header[self._at["length"]][0] if "length" in self._at else ""
        self._is_hex = header[place][1] == "hex"
        self._may_be_hex = any(
            _BARE_HEX.fullmatch(row[place].strip()) for row in rows[1:] if place < len(row)
        )
        self._others = {
            at: name for at, (name, _) in enumerate(header) if name and at not in self._at.values()
        }

    def cells(self, row: list[str]) -> dict[str, str]:
        """Return the cells of a row in imported columns, by key."""
        found = {key: row[place].strip() for key, place in self._at.items() if place < len(row)}
        if self._is_hex and re.fullmatch(r"[0-9a-fA-F]{1,8}", found.get("at", "")):
            found["at"] = f"0x{found['at']}"
        return found

    def further(self, row: list[str]) -> set[str]:
        """Return the names of the columns that are not imported and have a value in this row."""
        return {name for place, name in self._others.items() if place < len(row) and row[place].strip()}

    def gaps(self, cells: Cells, further: set[str]) -> list[str]:
        """Return a sentence for each property of a register that its row leaves open.

        One example is a column that is not imported, but may affect the register's value.
        """
        columns = further & _VALUE_COLUMNS
        if _parse_tag(cells["at"]):
            columns -= {"precision"}  # the precision of a Neuron tag is only the number of digits shown
        found = [f"the column {name} was not carried over" for name in sorted(columns)]
        is_text = cells.get("type", "").lower().startswith("str")
        if cells.get("length") and is_text and self._length in ("length", "size"):
            found.append(f"its {self._length} was taken for registers, and may be characters")
        if self._may_be_hex and _NUMBER.fullmatch(cells["at"]):
            found.append(f"its address {cells['at']} may be hex, as others of its column are")
        return found


def _plain_name(cell: str) -> tuple[str, str]:
    """Return a column's name and the text in brackets after it, such as "hex" in `Address (hex)`."""
    name = re.sub(r"[_\s]+", " ", cell).strip().lower()
    match = re.fullmatch(r"([^(\[]*[^(\[ ])\s*[(\[]([^)\]]*)[)\]].*", name)
    return (match[1], match[2].strip()) if match else (name, "")


def _places(header: list[str]) -> dict[str, int]:
    """Return the index of the column for each key. A column that fits two keys is used for the first."""
    found: dict[str, int] = {}
    for key, aliases in COLUMNS.items():
        for alias in aliases:
            if alias in header and header.index(alias) not in found.values():
                found[key] = header.index(alias)
                break
    if "at" not in found and "register" in header:
        found["at"] = header.index("register")
        found = {key: place for key, place in found.items() if key == "at" or place != found["at"]}
    return found


# ---- rows ----


def _row(devices: dict[int | None, ImportedDevice], cells: Cells, gaps: list[str], stem: str) -> None:
    tag = _parse_tag(cells["at"])
    slave = unit_address(tag.slave if tag else cells.get("slave") or None, "slave")
    device = devices.setdefault(slave, ImportedDevice(stem, slave))
    name = cells.get("name") or f"register_{tag.address if tag else cells['at']}"
    with device.entry(name):
        register = _placed(name, cells, tag)
        register.gaps += gaps
        _fill(device, register, cells, tag)


def _placed(name: str, cells: Cells, tag: _Tag | None) -> ImportedRegister:
    """Return a register at the row's address; add an ambiguous table or numbering to its `gaps`."""
    register = ImportedRegister(name, 0)
    stated = _table(register, cells)
    given = tag.address if tag else cells["at"]
    counting = Counting(None)
    if _REFERENCE.fullmatch(given) and not tag:
        address, table = _referred(register, given, stated, cells)
    else:
        address, table = counting.address_in_cell(given, None, stated or "holding")
    register.address, register.table = address, table
    if counting.assumed:
        _assume_number(register, stated)
    return register


def _assume_number(register: ImportedRegister, stated: str | None) -> None:
    register.gaps.append("whether its address counts from 0 or 1; 0 was assumed")
    if stated is None:
        register.gaps.append("its table; holding was assumed")


def _referred(register: ImportedRegister, given: str, stated: str | None, cells: Cells) -> tuple[int, str]:
    """Return the address and the table that a reference such as 40001 means.

    If other cells contradict this table, the number is a plain address.
    """
    address, table = Counting(None).address_in_cell(given, None, "holding")
    is_bit = table in ("coil", "discrete")
    if (stated not in (None, table)) or (is_bit and stated is None and _is_number(cells)):
        if is_bit and stated is None:
            register.gaps.append(f"{given} names a {table}, and its row a number: {int(given)} was assumed")
        _assume_number(register, stated)
        return int(given), stated or "holding"
    if int(given) <= 0xFFFF:
        register.gaps.append(
            f"{given} may be the number that is sent, or register {int(given[1:])} of table {given[0]}; "
            "the latter was assumed"
        )
    return address, table


def _is_number(cells: Cells) -> bool:
    kind = cells.get("type", "").lower()
    if kind:
        return kind not in _BIT_TYPES
    return bool(cells.get("unit") or _steps(cells))


def _steps(cells: Cells) -> list[tuple[str, str]]:
    """Return (column name, cell) for each scale that the row states, except scales of 1."""
    stated = [(key, cells.get(key, "")) for key in _STEP_COLUMNS]
    return [(key, cell) for key, cell in stated if cell and (key == "decimal" or not _is_one(cell))]


def _is_one(cell: str) -> bool:
    with suppress(ValueError):
        return number(cell, 1) == 1
    return False


def _table(register: ImportedRegister, cells: Cells) -> str | None:
    """Return the table that a row states, or None; add an unclear cell to the register's `gaps`."""
    if function := cells.get("function"):
        codes = {int(code, 0) for code in re.findall(r"0x[0-9a-f]{1,4}|(?!0\d)\d{1,5}", function.lower())}
        tables = {(_FUNCTIONS | _WRITES).get(code) for code in codes}
        if len(tables) == 1 and None not in tables:
            register.is_read = bool(codes - _WRITES.keys())
            register.note_write(is_written=bool(codes & _WRITES.keys()))
            return tables.pop()
        if named := _named_table(function):
            return named
        register.gaps.append(f"its function {function[:40]!r} names no table")
    given = cells.get("table", "")
    if not given:
        return None
    if named := _named_table(given):
        return named
    if re.fullmatch(r"0?[1-4]|[0]", given):
        code = int(given)
        if code in _FUNCTIONS:
            meant = f"{given} was taken for function {code:02}, {_FUNCTIONS[code]}"
            register.gaps.append(f"its table: {meant}; it may be the digit of a table, 0, 1, 3 or 4")
            return _FUNCTIONS[code]
    register.gaps.append(f"its table {given[:40]!r} is not known")
    return None


def _named_table(given: str) -> str | None:
    words = re.sub(r"[\s_-]+", " ", given.strip().lower())
    return next((table for beginning, table in _NAMED_TABLES if words.startswith(beginning)), None)


def _fill(device: ImportedDevice, register: ImportedRegister, cells: Cells, tag: _Tag | None) -> None:
    """Add the register to the device, as a text or as a number."""
    kind = cells.get("type", "").lower()
    if note := cells.get("note"):
        register.details["note"] = note
    if cells.get("formula"):
        register.lacks = "its formula is a program"
    elif cells.get("is scale", "").lower() == "true":
        register.gaps.append("it scales other registers, which are not named: `scale_register`")
    _access(register, cells.get("access", ""))
    if tag and kind == "string":
        _add_tag_text(device, register, tag)
    elif kind.startswith(("string", "str", "ascii", "char", "text")):
        _text(device, register, cells.get("length", ""), kind)
    elif register.table in ("coil", "discrete"):
        if _is_number(cells):
            register.gaps.append(f"its type, unit and scale were left out: a {register.table} is a bit")
        device.add(register)
    else:
        _number(device, register, cells, tag)


def _access(register: ImportedRegister, given: str) -> None:
    """Set whether the register can be read and written; add an unknown word to its `gaps`."""
    words = re.sub(r"subscribe|static|only|[^a-z]", "", given.lower())
    if not given:
        return
    if words not in _ACCESS:
        register.gaps.append(f"its access {given[:40]!r} is not known; it is read here")
        return
    is_read, is_written = _ACCESS[words]
    register.is_read = is_read
    if is_written and not register.is_written:
        register.note_write()


def _text(device: ImportedDevice, register: ImportedRegister, length: str, kind: str) -> None:
    if not _NUMBER.fullmatch(length):
        device.lose(register.name, "a text of unknown length")
        return
    register.details.pop("note", None)
    register.details["length"] = int(length)
    if kind not in _TEXT_ORDERS:
        device.lose(register.name, f"a text of the type {kind[:40]}")
        return
    if order := _TEXT_ORDERS[kind]:
        register.details["order"] = order
    device.add(register, is_text=True)


# ---- numbers ----


def _number(device: ImportedDevice, register: ImportedRegister, cells: Cells, tag: _Tag | None) -> None:
    kind = re.sub(r"[\s_-]+", "", cells.get("type", "").lower())
    order: str | None = None
    if part := _part(register, kind, cells, tag):
        register.details["part"], kind = part, "uint16"
    if kind in _BYTES:
        register.details["part"] = _BYTES[kind]
        kind = "int16" if kind.startswith("int") else "uint16"
    if match := _ORDERED.fullmatch(kind):
        kind, order = match[1], _SUFFIXES[match[2]]
    found = _format(register, kind, cells)
    if found is None:
        given = cells.get("type") or f"of {cells['length'][:9]} registers"
        device.lose(register.name, f"its type {given[:40]} has no number format")
        return
    if tag:
        order = _tag_order(register, tag, found)
    elif order is None and words_of(found) > 1:
        order = _order(register, cells.get("order", ""))
    elif order is None and cells.get("order") and _ORDERS.get(cells["order"].lower()) != "":
        register.gaps.append(f"the order of its bytes {cells['order'][:40]!r} was not carried over")
    put_number(register.details, found, order or "")
    if unit := cells.get("unit"):
        register.details["unit"] = unit
        if re.match(r"[x*/]?\s*\d", unit):
            register.gaps.append(f"its unit {unit[:40]!r} begins with a number, which may be its step")
    _scale(register, cells, is_neuron=tag is not None)
    device.add(register)


def _part(register: ImportedRegister, kind: str, cells: Cells, tag: _Tag | None) -> str:
    """Return the bits of the word that the register uses; "" for all.

    A missing bit number is added to the register's `gaps`.
    """
    if tag and tag.part:
        return tag.part
    stated = re.fullmatch(r"([0-9]{1,2})(?:\s*(?:-|\.\.|:|to)\s*([0-9]{1,2}))?", cells.get("bit", ""))
    if stated:
        low, high = sorted((int(stated[1]), int(stated[2] or stated[1])))
        return bits_text(low, high)
    if cells.get("bit"):
        register.gaps.append(f"its bit {cells['bit'][:40]!r} was not carried over")
    if kind not in _BIT_TYPES:
        return ""
    register.gaps.append("which bit of its word it is; bit 0 was assumed")
    return "0"


def _format(register: ImportedRegister, kind: str, cells: Cells) -> str | None:
    """Return the number format of a row. Add a missing type or width to the register's `gaps`."""
    length = cells.get("length", "")
    words = int(length) if _NUMBER.fullmatch(length) else 0
    signed = _SIGNED.get(cells.get("signed", "").lower())
    if cells.get("signed") and signed is None:
        register.gaps.append(f"its sign {cells['signed'][:40]!r} was not carried over")
    if not kind:
        assumed = "int" if signed else "uint"
        what = "type and sign are" if signed is None else "type is"
        register.gaps.append(f"its {what} not stated; {assumed}{16 * (words or 1)} was assumed")
        return format_of_width(assumed, words or 1)
    kind = re.sub(r"^(\d+)bits?(.*)$", r"\2\1", kind)  # "16 bit unsigned" becomes "unsigned16"
    if match := _WHOLE.fullmatch(kind):
        kind = f"{'uint' if match[1] else 'int'}{match[2]}"
    if found := format_of_width(kind, words or 1):
        if not words:
            register.gaps.append(f"the width of its type {kind} is not stated; 16 bits were assumed")
    else:
        found = number_format(kind)
    if found and signed and found.startswith("U"):
        found = f"I{found[1:]}"
    if found == "I8":
        register.gaps.append("which byte of its word it is; the low one was assumed")
    if found and words and words != words_of(found):
        takes = words_of(found)
        register.gaps.append(f"its length {words} is not that of its type, which takes {takes} registers")
    return found


def _order(register: ImportedRegister, given: str) -> str:
    """Return the byte order that a cell states. Add a missing one to the register's `gaps`."""
    word = re.sub(r"[^a-z]|endian|first", "", given.lower())
    if not given:
        register.gaps.append("the order of its words is not stated")
    elif word not in _ORDERS:
        register.lacks = f"its order of words {given[:40]!r}"
    return _ORDERS.get(word, "")


def _scale(register: ImportedRegister, cells: Cells, *, is_neuron: bool) -> None:
    """Set the step and the offset.

    Programs differ in the meaning of some columns: `scale` may be a factor or a divisor. A comment in the
    family file says which meaning was assumed.
    """
    found = _steps(cells)
    key, given = found[0] if found else ("scale", "")
    offset = cells.get("offset", "")
    try:
        step = _step(register, key, given, is_neuron=is_neuron)
        shift = number(offset, 0)
    except ValueError:
        register.lacks = f"its {key} {given[:40]!r} or offset {offset[:40]!r} is not a number"
        return
    if step not in (0, 1):
        register.details["step"] = step
    if shift:
        register.details["offset"] = shift
        if not is_neuron and step not in (0, 1) and not cells.get("factor"):
            register.gaps.append(f"its offset {offset} was taken as added after the step")
    beside = f"was not carried over beside its {key}"
    register.gaps += [f"its {other} {text[:40]} {beside}" for other, text in found[1:]]
    if "," in given + offset:
        register.gaps.append(f"the comma of {given or offset} was taken for a decimal point")


def _step(register: ImportedRegister, key: str, given: str, *, is_neuron: bool) -> float:
    """Return the value of one raw count. Raises ValueError unless the cell is a number."""
    amount = number(given, 1)
    exact = Fraction(str(amount))
    if amount == 0 and key != "decimal":
        return 1
    if key == "divisor" or (key == "gain" and abs(amount) > 1):
        if key == "gain":
            register.gaps.append(f"its gain {given} was taken as a divisor: a step of {float(1 / exact):g}")
        return float(1 / exact)
    if key == "decimal" and not is_neuron:
        if isinstance(amount, int) and 0 <= amount <= 10:
            step = float(f"1e-{amount}")
            digits = "was taken as digits after the point"
            register.gaps.append(f"its decimal {given} {digits}: a step of {step:g}")
            return step
        register.gaps.append(f"its decimal {given} was taken as a factor")
    elif key == "gain" or (key == "scale" and abs(amount) > 1):
        register.gaps.append(f"its {key} {given} was taken as a factor; in some tables it is a divisor")
    return amount


# ---- tags of EMQX Neuron's Modbus plugins: SLAVE!ADDRESS[.BIT][#ENDIAN][.LEN[H][L][D][E]] ----

_TAG = re.compile(r"([0-9]{1,6})!([0-9]{1,9})(?:[.](\d{1,6})([HLDE]?))?(?:#([A-Z]{1,2}))?")
_TAG_ORDERS = {  # The orders in Neuron's Modbus TCP page, section #ENDIAN. LL means the byte order 1,2,3,4.
    **{"L": "", "LL": "", "LB": "BADC", "BL": "CDAB", "BB": "DCBA", "B": "DCBA"}
}
# Byte orders of texts, by the last letter of the address in Neuron. Texts with the letter E (one character
# per register, in the high byte) are not imported.
_TAG_TEXT_ORDERS = {"": "", "H": "", "L": "BA", "D": "B"}


@dataclass(frozen=True)
class _Tag:
    """The address of a tag (a value) in the gateway program Neuron, such as 1!400001.3.

    `part` is the number of a bit, or the length of a text.
    """

    slave: int
    address: str
    part: str
    of_text: str
    order: str


def _parse_tag(cell: str) -> _Tag | None:
    """Parse a tag's address in the notation of the program Neuron; return None for another cell."""
    match = _TAG.fullmatch(cell)
    if match is None:
        return None
    return _Tag(int(match[1]), match[2], match[3] or "", match[4] or "", match[5] or "")


def _tag_order(register: ImportedRegister, tag: _Tag, number: str) -> str:
    """Return a number's byte order. If the tag does not state it, add this to the register's `gaps`."""
    if tag.order in _TAG_ORDERS:
        return _TAG_ORDERS[tag.order]
    if tag.order:
        register.lacks = f"its order of bytes #{tag.order}"
    elif words_of(number) > 1:
        register.gaps.append("its order of bytes is its node's; ABCD was assumed, as Neuron does")
    return ""


def _add_tag_text(device: ImportedDevice, register: ImportedRegister, tag: _Tag) -> None:
    if not tag.part:
        device.lose(register.name, "a text of unknown length")
        return
    if tag.of_text not in _TAG_TEXT_ORDERS:
        device.lose(register.name, "a text of one character a register, in its high byte")
        return
    register.details.pop("note", None)
    length = int(tag.part)
    register.details["length"] = length if tag.of_text == "D" else (length + 1) // 2
    if order := _TAG_TEXT_ORDERS[tag.of_text]:
        register.details["order"] = order
    device.add(register, is_text=True)
