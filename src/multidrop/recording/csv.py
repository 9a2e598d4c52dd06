"""Recordings as text (.csv), one line per row, with the metadata in a second file (.csv.json)."""

from __future__ import annotations

import csv
import os
import re
from collections.abc import Iterator, Mapping
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import BinaryIO

from multidrop.polling.batch import ROW_COLUMNS, Row, Rows
from multidrop.printable import format_time, parse_time, spreadsheet_text
from multidrop.recording.format import AppendingWriter, Metadata, RecordingReader, dump_metadata, writing
from multidrop.recording.rows import from_rows
from multidrop.whole_file import whole_file

HEADER = ",".join(ROW_COLUMNS) + "\n"
WITH_UNITS = ",".join([*ROW_COLUMNS, "unit"]) + "\n"  # header of a .csv file that has no metadata file
ESCAPED = re.compile(r"'+[=+\-@\t\r\n]")
EXAMPLE = "2026-11-21T09:30:00.123456789Z,17,250000,pump-1,output_current,1.5,ok"
BATCH_ROWS = 1 << 14


def metadata_path(path: Path) -> Path:
    return path.with_name(path.name + ".json")


class CsvWriter(AppendingWriter):
    """Writes each batch's lines in one system call."""

    def __init__(self, path: Path, metadata: Metadata) -> None:
        described = dump_metadata(metadata)
        super().__init__(path)
        try:
            with writing(path), whole_file(metadata_path(path)) as part:
                part.write_text(described + "\n", "utf-8")
            # written after the metadata, so that a .csv with a header always has its .csv.json
            self._append(HEADER.encode())
        except OSError:
            self.discard()
            raise

    def write(self, batch: Rows) -> None:
        self._append(lines_of(batch))
        self.rows += len(batch)

    @property
    def files(self) -> tuple[Path, ...]:
        return self.path, metadata_path(self.path)


class CsvReader(RecordingReader):
    """Reads all complete lines. If the .csv.json is missing, the metadata is empty."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        with path.open("rb") as file:
            if file.readline(len(WITH_UNITS)).decode(errors="replace") not in (HEADER, WITH_UNITS):
                raise self._not_a_recording(f"its first line is not {HEADER.strip()}")
            size = file.seek(0, os.SEEK_END)
            self._whole = _whole_lines(file, size)
        self.truncated = size - self._whole
        try:
            described = metadata_path(path).read_bytes()
        except FileNotFoundError:
            described = b"{}"
        self.metadata = self._parse_metadata(described, metadata_path(path))

    def __iter__(self) -> Iterator[Rows]:
        with self.path.open("rb") as file:
            lines = csv.reader(_lines(file, self._whole), strict=True)
            rows = map(_parse, islice(lines, 1, None))
            try:
                while some := list(islice(rows, BATCH_ROWS)):
                    yield from_rows(some)
            except (csv.Error, ValueError, OverflowError) as error:
                place = f"{self.path}, line {lines.line_num}"
                raise ValueError(f"{place}: not a row of a recording; a row looks like {EXAMPLE}") from error


def _whole_lines(file: BinaryIO, size: int) -> int:
    """Return the length of the file up to the end of its last whole line."""
    end = size
    while True:
        start = max(0, end - (1 << 16))
        file.seek(start)
        at = file.read(end - start).rfind(b"\n")
        if at >= 0 or start == 0:
            return start + at + 1
        end = start


def _lines(file: BinaryIO, size: int) -> Iterator[str]:
    while file.tell() < size:
        yield file.readline().decode()


def _parse(cells: list[str]) -> Row:
    if len(cells) - len(ROW_COLUMNS) not in (0, 1):  # the column `unit` is optional
        raise ValueError(len(cells))
    time, monotonic_ns, uncertainty_ns, drive, register, value, status = cells[: len(ROW_COLUMNS)]
    numbers = f"{monotonic_ns}{uncertainty_ns}{value}"
    if not numbers.isascii() or "_" in numbers:  # checked, because Python would read 1_0 as 10
        raise ValueError(numbers)
    return Row(
        parse_time(time),
        int(monotonic_ns),
        int(uncertainty_ns) if uncertainty_ns else None,
        _unquote(drive),
        _unquote(register),
        float(value) if value else None,
        _unquote(status),
    )


def lines_of(rows: Rows) -> bytes:
    """Return the rows as lines of a .csv file."""
    return "".join(map(_line, rows)).encode()


def lines_with_units(rows: Rows, units: Mapping[tuple[str, str], str]) -> bytes:
    """Return the rows as lines of a .csv file with a column `unit`; `units` maps (drive, register) to it."""
    return "".join(
        f"{_line(row)[:-1]},{_quote(units.get((row.drive, row.register), ''))}\n" for row in rows
    ).encode()


def _line(row: Row) -> str:
    time, monotonic_ns, uncertainty_ns, drive, register, value, status = row
    uncertainty = "" if uncertainty_ns is None else uncertainty_ns
    number = "" if value is None else repr(value)
    names = f"{_quote(drive)},{_quote(register)}"
    return f"{format_time(time)},{monotonic_ns},{uncertainty},{names},{number},{_quote(status)}\n"


@lru_cache(maxsize=4096)
def _quote(text: str) -> str:
    """Quote a text as RFC 4180 requires, with an apostrophe before a possible formula."""
    text = spreadsheet_text(text)
    return '"' + text.replace('"', '""') + '"' if set(text) & set(',"\r\n') else text


@lru_cache(maxsize=4096)
def _unquote(cell: str) -> str:
    """Return the original text of a cell that `_quote` made."""
    return cell[1:] if ESCAPED.match(cell) else cell


writer, reader = CsvWriter, CsvReader
