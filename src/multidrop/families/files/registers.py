"""Parse the registers of a family file, from its TOML and CSV parts, and declare them."""

from __future__ import annotations

import csv
import io
import keyword
import math
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import IntEnum, IntFlag
from functools import partial
from pathlib import Path, PureWindowsPath
from typing import Any, cast

from multidrop.core import NumberFormat
from multidrop.drive.declaration_check import MOST_COUNTS
from multidrop.drive.family import TAKEN_NAMES
from multidrop.drive.register import (
    HOLDING_MULTIPLE,
    LANGUAGES,
    Access,
    Carrier,
    Kept,
    Register,
    declare,
)
from multidrop.families.files import notation
from multidrop.families.files.notation import TABLES, Counting
from multidrop.printable import did_you_mean, is_number, is_whole
from multidrop.toml_check import ASCENDING, DISTINCT, TomlPlace

LONGEST_NAME = 60
MOST_VALUES = 500
MOST_BITS = 64
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
OF_ENUMERATIONS = frozenset({*dir(IntEnum), *dir(IntFlag), *dir(int), "mro", "name", "value"})


def unusable(name: str) -> str:
    """Return why a name cannot be a Python attribute, with a better name; "" if it can."""
    if len(name) > LONGEST_NAME:
        return f"it has more than {LONGEST_NAME} characters; give it a shorter one"
    if keyword.iskeyword(name):
        return f"it is a word of Python; write {name}_ or another one"
    if _NAME.fullmatch(name):
        return ""
    words = re.sub(r"\W+|_+", "_", name, flags=re.ASCII).strip("_").lower()
    right = words if _NAME.fullmatch(words) else f"r_{words}".rstrip("_")
    return f"it may have letters a to z, digits and _, and must begin with a letter; write {right}"


def enumeration(owner: str, given: Mapping[str, Any]) -> type[IntEnum]:
    """Return an enumeration of a register's named values. Raises ValueError that lists all mistakes."""
    _check("values", given, MOST_VALUES, range(-(1 << 63), 1 << 64), "a whole number")
    make: Any = IntEnum
    return cast(type[IntEnum], make(owner, given))


def flags(owner: str, given: Mapping[str, Any]) -> type[IntFlag]:
    """Return an IntFlag of a register's named bits, by bit number. Raises ValueError with all mistakes."""
    _check("bits", given, MOST_BITS, range(MOST_BITS), f"a bit's number, 0 to {MOST_BITS - 1}")
    make: Any = IntFlag
    return cast(type[IntFlag], make(owner, {name: 1 << bit for name, bit in given.items()}))


def _check(key: str, given: Mapping[str, Any], most: int, allowed: range, right: str) -> None:
    if wrong := list(_mistakes(key, given, most, allowed, right)):
        raise ValueError("; ".join(wrong))


def _mistakes(key: str, given: Mapping[str, Any], most: int, allowed: range, right: str) -> Iterator[str]:
    if not given:
        yield f"{key} is empty; remove it, or write {key} = {{ off = 0, on = 1 }}"
    if len(given) > most:
        yield f"{key} has {len(given)} names, more than the allowed {most}"
        return
    spelt: dict[str, str] = {}
    numbered: dict[int, str] = {}
    for name, number in given.items():
        if why := unusable(name):
            yield f"{key}: {name!r} is not a name: {why}"
        elif name in OF_ENUMERATIONS:
            yield f"{key}: {name!r} is a name that all enumerations have; write {name}_"
        elif name.lower() in spelt:
            yield f"{key}: {name} and {spelt[name.lower()]} differ in capitals alone; rename one"
        spelt[name.lower()] = name
        if not is_whole(number) or number not in allowed:
            yield f"{key}: {name} = {number!r} is not {right}"
        elif number in numbered:
            yield f"{key}: {name} and {numbered[number]} are both {number}; give each its own"
        else:
            numbered[number] = name


LONGEST_TEXT = 1000
LONGEST_TITLE = 100
MOST_LISTED = 100  # limit of raw counts in one list of a family file
NOT_STATED = "unknown"
ORDERS = ("ABCD", "CDAB", "BADC", "DCBA", "AB", "BA")
WRITES = ("single", "multiple")
ACCESSES = {access.value: access for access in Access}
_KEPT = {"ram": Kept.RAM, "eeprom": Kept.EEPROM, NOT_STATED: Kept.UNKNOWN}


@dataclass(frozen=True)
class RegisterKey:
    """A key that a register in a family file may have. `convert` raises ValueError for an invalid value.

    `example` is a valid value.
    """

    convert: Callable[[Any], Any]
    example: str
    cell: Callable[[str], Any] = notation.text

    @property
    def schema(self) -> dict[str, Any]:
        """The JSON Schema of the key's values."""
        if isinstance(self.convert, partial):
            found: Mapping[str, Any] = {"enum": [*dict.fromkeys(_spellings(*self.convert.args), 0)]}
        else:
            found = _SCHEMAS[self.convert]
        return {**found, "description": self.example}


def _any(value: Any) -> Any:
    return value


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError("the value is not a text")
    if not value.isprintable():
        raise ValueError("the value has unprintable characters; remove them")
    if len(value) > LONGEST_TEXT:
        raise ValueError(f"the value has more than {LONGEST_TEXT} characters")
    return value


def _number(value: Any) -> float:
    if not is_number(value):
        raise ValueError("the value is not a number")
    if not math.isfinite(value):
        raise ValueError("the value is not a finite number")
    return value


def _step(value: Any) -> Any:
    if value == NOT_STATED:
        return None
    if _number(value) == 0:
        raise ValueError("every reading would be 0")
    return value


def _truth(value: Any) -> bool:
    if not isinstance(value, bool):
        raise ValueError("the value is neither true nor false")
    return value


def _span(value: Any) -> tuple[float, float]:
    if not isinstance(value, list) or len(value) != 2:
        raise ValueError("the value is not two numbers")
    low, high = map(_number, value)
    if low > high:
        raise ValueError("the value is in the wrong order: give the smallest first")
    return low, high


def _counts(value: Any) -> tuple[int, ...]:
    if not isinstance(value, list) or any(type(each) is not int for each in value):
        raise ValueError("the value is not a list of raw counts")
    if len(value) > MOST_LISTED:
        raise ValueError(f"the value has more than {MOST_LISTED} raw counts")
    return tuple(value)


def _invalid(value: Any) -> tuple[float, ...]:
    listed = value if isinstance(value, list) else [value]
    if not listed or len(listed) > MOST_LISTED:
        raise ValueError(f"the value is not a list of 1 to {MOST_LISTED} raw counts")
    return tuple(math.nan if each in ("NaN", "nan") else _number(each) for each in listed)


def _part(value: Any) -> tuple[int, int]:
    first, dash, last = str(value).partition("-")
    ends = [end.strip() for end in (first, last if dash else first)]
    if isinstance(value, (bool, float)) or not all(end.isascii() and end.isdecimal() for end in ends):
        raise ValueError("the value is not a bit's number or a range of bits")
    low, high = (int(end[:4]) for end in ends)
    if low > high:
        raise ValueError("the value is in the wrong order: give the lowest bit first")
    return low, high


def _one_of(known: Mapping[str, Any], spelling: Callable[[str], str] = str) -> Callable[[Any], Any]:
    return partial(_named_one, known, spelling)


def _named_one(known: Mapping[str, Any], spelling: Callable[[str], str], value: Any) -> Any:
    name = spelling(value) if isinstance(value, str) else ""
    if name in known:
        return known[name]
    raise ValueError(f"the value is not known; {did_you_mean(name, known)}")


def _spellings(known: Mapping[str, Any], spelling: Callable[[str], str]) -> list[str]:
    """Return the valid names; if `spelling` ignores case, also in lower case and in capitals."""
    return [*known] if spelling is str else [*known, *map(str.lower, known), *map(str.upper, known)]


def _named(value: Any) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise ValueError("the value must be a table of names and numbers, such as { off = 0, on = 1 }")
    return value


def _titles(value: Any) -> Mapping[str, str]:
    if not isinstance(value, dict) or not value:
        raise ValueError("the value is not a table of titles by language")
    for language, title in value.items():
        if language not in LANGUAGES:
            raise ValueError(f"the language {language[:20]} is unknown, not one of {', '.join(LANGUAGES)}")
        if not 1 <= len(_text(title)) <= LONGEST_TITLE:
            raise ValueError(f"the value has a title of {len(title)} characters, not 1 to {LONGEST_TITLE}")
    return value


_HEX = "0*([0-9A-Fa-f]{1,4}|10000)"
ADDRESS: Mapping[str, Any] = {
    "anyOf": [
        {"type": "integer", "minimum": 0, "maximum": notation.LAST_ADDRESS + 1},
        {"type": "string", "pattern": rf"^\s*(0[xX]{_HEX}|{_HEX}[hH]|[0134]([0-9]{{4}}|[0-9]{{5}}))\s*$"},
    ]
}
NAME: Mapping[str, Any] = {"maxLength": LONGEST_NAME, "pattern": f"^{_NAME.pattern}$"}
_COUNT = {"type": "integer"}
_COUNTS = {"type": "array", "items": _COUNT, "maxItems": MOST_LISTED}
FINITE = {"type": "number", "minimum": -sys.float_info.max, "maximum": sys.float_info.max}
_NUMBER_OR_NAN = {"anyOf": [FINITE, {"enum": ["NaN", "nan"]}]}
_NUMBERS = {"type": "array", "items": _NUMBER_OR_NAN, "minItems": 1, "maxItems": MOST_COUNTS}
_TEXT = {"type": "string", "maxLength": LONGEST_TEXT, "pattern": r"^[^\x00-\x1f\x7f]*$"}
# JSON Schema of a key's values, by the function that converts them
_SCHEMAS: Mapping[Callable[[Any], Any], Mapping[str, Any]] = {
    _any: ADDRESS,
    _text: _TEXT,
    _number: FINITE,
    _truth: {"type": "boolean"},
    _step: {"anyOf": [{**FINITE, "not": {"const": 0}}, {"const": NOT_STATED}]},
    _span: {"type": "array", "items": FINITE, "minItems": 2, "maxItems": 2, **ASCENDING},
    _counts: _COUNTS,
    _invalid: {"anyOf": [_NUMBER_OR_NAN, _NUMBERS]},
    _part: {
        "anyOf": [
            {"type": "integer", "minimum": 0},
            {"type": "string", "pattern": r"^\s*[0-9]+\s*(-\s*[0-9]+\s*)?$"},
        ]
    },
    _named: {
        "type": "object",
        "propertyNames": {**NAME, "not": {"enum": [*sorted(OF_ENUMERATIONS), *keyword.kwlist]}},
        "additionalProperties": _COUNT,
        "minProperties": 1,
        "maxProperties": MOST_VALUES,
        **DISTINCT,
    },
    _titles: {
        **{"type": "object", "minProperties": 1, "additionalProperties": False},
        "properties": {key: {**_TEXT, "minLength": 1, "maxLength": LONGEST_TITLE} for key in LANGUAGES},
    },
}
REGISTER_KEYS: Mapping[str, RegisterKey] = {
    "at": RegisterKey(_any, 'at = 0x2000, 8192, "2000H" or "40001"'),
    "unit": RegisterKey(_text, 'unit = "Hz"'),
    "values": RegisterKey(_named, "values = { off = 0, on = 1 }", notation.named),
    "bits": RegisterKey(_named, "bits = { ready = 0, tripped = 3 }", notation.named),
    "step": RegisterKey(
        _step, 'step = 0.1, or "unknown" where the manual does not state it', notation.number_or_word
    ),
    "offset": RegisterKey(_number, "offset = -40", notation.number),
    "span": RegisterKey(_span, "span = [0, 50]", notation.numbers),
    "number_format": RegisterKey(_one_of(NumberFormat.__members__, str.upper), 'number_format = "F32"'),
    "order": RegisterKey(_one_of(dict(zip(ORDERS, ORDERS, strict=True)), str.upper), 'order = "CDAB"'),
    "part": RegisterKey(_part, 'part = "3" or "0-7"'),
    "invalid": RegisterKey(_invalid, 'invalid = 0x7FFF, [0x7FFF, 0x8000] or "NaN"', notation.numbers),
    "scale_register": RegisterKey(_text, 'scale_register = "power_of_ten"'),
    "table": RegisterKey(_one_of({name: name for name in TABLES}, str.lower), 'table = "input"'),
    "write": RegisterKey(_one_of(dict(zip(WRITES, WRITES, strict=True))), 'write = "multiple"'),
    "kept": RegisterKey(_one_of(_KEPT, str.lower), 'kept = "ram", "eeprom" or "unknown"'),
    "ram_address": RegisterKey(_any, "ram_address = 0x1005"),
    "default": RegisterKey(_number, "default = 50", notation.number),
    "at_least": RegisterKey(_text, 'at_least = "minimum_frequency"'),
    "at_most": RegisterKey(_text, 'at_most = "maximum_frequency"'),
    "while_running": RegisterKey(_truth, "while_running = false", notation.truth),
    "moves": RegisterKey(_truth, "moves = false", notation.truth),
    "harmless": RegisterKey(_counts, "harmless = [0x0476]", notation.counts),
    "broadcast": RegisterKey(_counts, "broadcast = [0]", notation.counts),
    "never": RegisterKey(_text, 'never = "the reason"'),
    "never_together": RegisterKey(_counts, "never_together = [0x0088]", notation.counts),
    "place": RegisterKey(_text, 'place = "table 12"'),
    "outside": RegisterKey(_text, 'outside = "another document"'),
    "note": RegisterKey(_text, 'note = "Of the motor."'),
    "title": RegisterKey(_titles, 'title.ru = "ток двигателя"', notation.titles),
}
NOT_DETAILS = frozenset({"at", "unit", "values", "bits", "table", "write", "ram_address", "title"})
DEFAULT_KEYS = ("table", "unit", "step", "number_format", "order", "invalid", "write", "kept")


def converted(key: str, value: Any) -> Any:
    """Convert the value of a register's key. Raises ValueError with the mistake and a valid example."""
    try:
        return REGISTER_KEYS[key].convert(value)
    except ValueError as mistake:
        raise ValueError(f"{key} = {shown(value)}: {mistake}; write {REGISTER_KEYS[key].example}") from None


def shown(value: Any) -> str:
    """Return a value as short text for an error."""
    text = str(value).lower() if isinstance(value, bool) else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


MOST_REGISTERS = 2000
# keys of the section [default] that do not apply to coils and discrete inputs
_WITHOUT_BITS = ("number_format", "order", "invalid", "step", "unit")

ReadAddress = Callable[[Any, str | None, str], tuple[int, str]]


@dataclass
class Declared:
    """The registers that the file has declared so far, and the place of each name in the file."""

    counting: Counting
    defaults: Mapping[str, Any]
    write: str
    registers: dict[str, Register[Any]] = field(default_factory=dict)
    places: dict[str, TomlPlace] = field(default_factory=dict)

    def section(self, access: Access, table: Any, place: TomlPlace) -> None:
        """Declare the registers in a [reading], [setting] or [command] section."""
        if not isinstance(table, dict):
            place.wrong(
                f"[{access.value}] is not a table; write [{access.value}] and NAME = {{ at = 0x0010 }}",
                access.value,
            )
            return
        for name, given in table.items():
            at = place.within(f"[{access.value}] {name[:60]}", access.value, name)
            if not isinstance(given, dict):
                at.wrong(f'{shown(given)} is not a register; write {{ at = 0x0010, unit = "Hz" }}')
                self._reserve(name, at)
                continue
            self.add(name, access, given, at, self.counting.address)

    def add(
        self, name: str, access: Access, given: Mapping[str, Any], place: TomlPlace, read: ReadAddress
    ) -> None:
        """Declare one register; the function `read` parses its addresses."""
        known = self._reserve(name, place)
        good = self._converted(given, place)
        address = self._addresses(given, good, place, read)
        what = self._meaning(name, good, place)
        if not known or address is None:
            return
        details, table = self._details(access, good, address[1])
        if "ram_address" in good:
            details["ram_address"] = good["ram_address"]
        if "title" in good:
            details["titles"] = good["title"]
        register = place.attempt(declare, access, address[0], what, {"table": table, **details})
        if register is not None:
            register.__set_name__(type(self), name)
            self.registers[name] = register

    def _reserve(self, name: str, place: TomlPlace) -> bool:
        """Remember where the file declares a name; return False if the name is invalid or already used."""
        if why := unusable(name):
            place.wrong(f"{shown(name)} cannot be a register's name: {why}")
            return False
        if name in TAKEN_NAMES:  # such a register would replace the verb or attribute of this name
            place.wrong("reserved name: every drive has an attribute with this name; rename the register")
            return False
        if first := self.places.get(name):
            is_here = first.path == place.path
            where = ", ".join(first.labels) if is_here else f"{first.path}, {first.labels[0]}"
            place.wrong(f"{name} is declared twice, first in {where}; every register has its own name")
            return False
        self.places[name] = place
        return True

    def _converted(self, given: Mapping[str, Any], place: TomlPlace) -> dict[str, Any]:
        meant = place.unknown(given, REGISTER_KEYS) if given.keys() - REGISTER_KEYS.keys() else set()
        if "at" not in given and "at" not in meant:
            place.wrong(f"the register's address is missing; add {REGISTER_KEYS['at'].example}")
        good = {}
        for key, value in given.items():
            if key in REGISTER_KEYS:
                try:
                    good[key] = converted(key, value)
                except ValueError as mistake:
                    place.wrong(mistake)
        return good

    def _addresses(
        self, given: Mapping[str, Any], good: dict[str, Any], place: TomlPlace, read: ReadAddress
    ) -> tuple[int, str] | None:
        """Return the register's address and table; None if invalid. Make `good["ram_address"]` a number."""
        if "at" not in given or ("table" in given and "table" not in good):
            good.pop("ram_address", None)
            return None
        found = self._address("at", given, good.get("table"), place, read)
        if "ram_address" in good:
            table = found[1] if found else good.get("table")
            alias = self._address("ram_address", given, table, place, read)
            good.pop("ram_address")
            if alias is not None:
                good["ram_address"] = alias[0]
        return found

    def _address(
        self, key: str, given: Mapping[str, Any], table: str | None, place: TomlPlace, read: ReadAddress
    ) -> tuple[int, str] | None:
        try:
            return read(given[key], table, self.defaults.get("table", "holding"))
        except ValueError as mistake:
            place.wrong(f"{key}: {mistake}")
        return None

    def _meaning(self, name: str, good: Mapping[str, Any], place: TomlPlace) -> Any:
        """Return the register's unit, or the enumeration of its values."""
        named = [key for key in ("values", "bits") if key in good]
        if len(named) == 2 or (named and good.get("unit")):
            other = "bits" if len(named) == 2 else "unit"
            place.wrong(
                f"{named[0]} and {other} are both given; a register has only one of unit, values and bits"
            )
        if not named:
            return good.get("unit", self.defaults.get("unit", ""))
        make = enumeration if named[0] == "values" else flags
        return place.attempt(make, name.title().replace("_", ""), good[named[0]]) or ""

    def _details(self, access: Access, good: Mapping[str, Any], table: str) -> tuple[dict[str, Any], Any]:
        space = TABLES[table]
        defaults = {key: value for key, value in self.defaults.items() if key not in NOT_DETAILS}
        if "number_format" in good:
            # the default `invalid` is for the default number format, which this register does not use
            defaults.pop("invalid", None)
        if space.carrier is Carrier.BIT:
            defaults = {key: value for key, value in defaults.items() if key not in _WITHOUT_BITS}
        if access is Access.READING:
            defaults.pop("kept", None)
        details = {**defaults, **{key: value for key, value in good.items() if key not in NOT_DETAILS}}
        if table == "holding" and good.get("write", self.defaults.get("write", self.write)) == "multiple":
            space = HOLDING_MULTIPLE
        return details, space


def defaults_of(table: Any, place: TomlPlace) -> dict[str, Any]:
    """Return the valid keys of a [default] section."""
    if not isinstance(table, dict):
        place.wrong('is not a table; write [default] and table = "input"')
        return {}
    keys = {key: REGISTER_KEYS[key] for key in DEFAULT_KEYS}
    if table.keys() - keys.keys():
        place.unknown(table, keys)
    good = {}
    for key in [key for key in table if key in keys]:
        try:
            good[key] = converted(key, table[key])
        except ValueError as mistake:
            place.wrong(mistake)
    return good


MOST_BYTES = 2_000_000
_DELIMITERS = (",", ";", "\t")
_OWN_COLUMNS = ("name", "access")  # columns of a CSV file that are not keys of a register
COLUMNS = dict.fromkeys((*_OWN_COLUMNS, *REGISTER_KEYS))
NEEDED = ("name", "at")


def declare_rows(data: bytes, declared: Declared, place: TomlPlace) -> None:
    """Declare the registers of a CSV file. Mistakes are reported with line and column."""
    text = _decoded(data, place)
    if text is None:
        return
    rows = _rows(text, place)
    header = next(rows, None)
    if header is None:
        place.wrong("is empty; its first line names the columns, such as name,at,unit")
        return
    columns = _columns(header[1], place.within(f"line {header[0]}"))
    if columns is None:
        return
    for number, cells in rows:
        _declare(columns, cells, declared, place.within(f"line {number}"))
        if len(declared.places) > MOST_REGISTERS:
            place.wrong(f"has more than {MOST_REGISTERS} registers; remove unused ones")
            return


def _decoded(data: bytes, place: TomlPlace) -> str | None:
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as failure:
        place.wrong(f"is not text in UTF-8, from byte {failure.start} on; save it as CSV UTF-8")
        return None
    if "\0" in text:
        place.wrong("contains NUL bytes; save it as CSV UTF-8")
        return None
    return text


def _rows(text: str, place: TomlPlace) -> Iterator[tuple[int, list[str]]]:
    """Yield the line number and the cells of each line that is not empty."""
    first = text.lstrip("\r\n").splitlines()[:1]
    delimiter = max(_DELIMITERS, key=first[0].count) if first else ","
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, strict=True)
    try:
        for cells in reader:
            stripped = [cell.strip() for cell in cells]
            if any(stripped):
                yield reader.line_num, stripped
    except csv.Error as failure:
        place.within(f"line {reader.line_num}").wrong(f"is not CSV: {failure}")


def _columns(header: list[str], place: TomlPlace) -> list[str] | None:
    """Return the column names in the header; None if one is invalid."""
    columns = [name.lower().replace(" ", "_") for name in header]
    while columns and not columns[-1]:  # spreadsheets add empty columns at the end
        columns.pop()
    before = len(place.config_errors)
    meant = place.unknown(dict.fromkeys(columns), COLUMNS) if set(columns) - COLUMNS.keys() else set()
    for name in {name for name in columns if columns.count(name) > 1}:
        place.wrong(f"two columns are called {name!r}; give each its own name")
    for name in NEEDED:
        if name not in columns and name not in meant:
            place.wrong(
                f"no column is called {name!r}; the first line names the columns: {', '.join(COLUMNS)}"
            )
    return None if len(place.config_errors) > before else columns


def _declare(columns: list[str], row: list[str], declared: Declared, place: TomlPlace) -> None:
    if any(row[len(columns) :]):
        place.wrong(
            f"has {len(row)} cells, but the first line names {len(columns)} columns. Write numbers with a "
            "point, as 0.1, and put texts with a comma in quotes"
        )
        return
    filled = {name: cell for name, cell in zip(columns, row, strict=False) if cell}
    name, access = filled.pop("name", ""), filled.pop("access", Access.READING.value).lower()
    if not name:
        place.within("column name").wrong("the register's name is missing; every line has one")
        return
    if access not in ACCESSES:
        place.within("column access").wrong(f"{shown(access)} is not known; write {', '.join(ACCESSES)}")
        access = Access.READING.value
    given: dict[str, Any] = {}
    for key, cell in filled.items():
        try:
            given[key] = REGISTER_KEYS[key].cell(cell)
        except ValueError as mistake:
            place.within(f"column {key}").wrong(mistake)
    declared.add(name, ACCESSES[access], given, place.within(name[:60]), declared.counting.address_in_cell)


BESIDE: Mapping[str, Any] = {  # JSON Schema
    "type": "string",
    "pattern": r"^(?![/\\]|[A-Za-z]:|(.*[/\\])?\.\.([/\\]|$)).*\.([Cc][Ss][Vv]|[Tt][Ss][Vv])$",
}


def beside(path: Path, name: Any) -> Path:
    """Return a CSV file's path. Raises ValueError unless it is in the family file's folder, or below it."""
    if not isinstance(name, str) or not name.lower().endswith((".csv", ".tsv")):
        raise ValueError(f'registers = {shown(name)} is not a CSV file; write registers = ["meter.csv"]')
    place = PureWindowsPath(name)  # on every system, this recognises drive letters, roots and both separators
    if place.anchor or ".." in place.parts or not name.isprintable():
        raise ValueError(
            f"registers = {shown(name)} is outside the family file's folder: "
            "put the CSV file there, or below it"
        )
    return path.parent / name
