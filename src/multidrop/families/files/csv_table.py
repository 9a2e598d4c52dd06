"""A CSV file of registers: its first line names the columns, every other line is a register.

All cells are read as text: a spreadsheet's own idea of a number is refused where it may be wrong.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from pathlib import Path, PureWindowsPath
from typing import Any

from multidrop.drive.register import Access
from multidrop.families.files.register_keys import ACCESSES, REGISTER_KEYS, shown
from multidrop.families.files.registers import MOST_REGISTERS, Declared
from multidrop.toml_check import TomlPlace

MOST_BYTES = 2_000_000
_DELIMITERS = (",", ";", "\t")
_OWN_COLUMNS = ("name", "access")  # of a CSV file, besides the keys of a register
COLUMNS = dict.fromkeys((*_OWN_COLUMNS, *REGISTER_KEYS))
NEEDED = ("name", "at")


def declare_rows(data: bytes, declared: Declared, place: TomlPlace) -> None:
    """Declare the registers of a CSV file's bytes; every mistake has its line and column."""
    text = _text(data, place)
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
            place.wrong(f"has more than {MOST_REGISTERS} registers; leave out those that nobody reads")
            return


def _text(data: bytes, place: TomlPlace) -> str | None:
    if len(data) > MOST_BYTES:
        place.wrong(f"has more than {MOST_BYTES} bytes")
        return None
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as failure:
        place.wrong(f"is not text in UTF-8, from byte {failure.start} on; save it as CSV UTF-8")
        return None
    if "\0" in text:
        place.wrong("has zero bytes; save it as CSV UTF-8")
        return None
    return text


def _rows(text: str, place: TomlPlace) -> Iterator[tuple[int, list[str]]]:
    """Yield each line that has a cell, with its number."""
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
    """Return the columns' names; None where they are wrong."""
    columns = [name.lower().replace(" ", "_") for name in header]
    while columns and not columns[-1]:  # of a spreadsheet with an empty column
        columns.pop()
    before = len(place.config_errors)
    meant = place.unknown(dict.fromkeys(columns), COLUMNS) if set(columns) - COLUMNS.keys() else set()
    for name in {name for name in columns if columns.count(name) > 1}:
        place.wrong(f"two columns are called {name!r}; each has a name of its own")
    for name in NEEDED:
        if name not in columns and name not in meant:
            place.wrong(
                f"no column is called {name!r}; the first line names the columns: {', '.join(COLUMNS)}"
            )
    return None if len(place.config_errors) > before else columns


def _declare(columns: list[str], row: list[str], declared: Declared, place: TomlPlace) -> None:
    if any(row[len(columns) :]):
        place.wrong(
            f"has {len(row)} cells, and the first line has {len(columns)}: "
            "a comma in a number or a text? write 0.1, and texts in quotes"
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
    at = place.within(name[:60])
    declared.add(name, ACCESSES[access], given, at, declared.counting.address_in_cell)


def beside(path: Path, name: Any) -> Path:
    """Return the path of a CSV file beside the family's. Raises ValueError for any other place."""
    if not isinstance(name, str) or not name.lower().endswith((".csv", ".tsv")):
        raise ValueError(
            f'registers has {shown(name)}, which is no CSV file; write registers = ["meter.csv"]'
        )
    place = PureWindowsPath(name)  # which knows the roots of all systems, and both separators
    if place.anchor or ".." in place.parts or not name.isprintable():
        raise ValueError(f"registers has {shown(name)}; a CSV file is beside the family's, or below it")
    return path.parent / name
