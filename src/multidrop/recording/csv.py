"""Recordings as text (.csv), one row a sample, with the metadata beside it (.csv.json)."""

from __future__ import annotations

import csv
import os
import re
from collections.abc import Iterator
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import BinaryIO

from multidrop.polling.batch import Row, Rows
from multidrop.recording.append_file import WholeFile
from multidrop.recording.format import (
    Metadata,
    RecordingError,
    RecordingReader,
    RecordingWriter,
    dump_metadata,
    load_metadata,
    not_a_recording,
)
from multidrop.recording.rows import from_rows

HEADER = ",".join(Row._fields) + "\n"
# A spreadsheet carries out a text that begins like this, but not with an apostrophe in front.
FORMULA = re.compile(r"'*[=+\-@\t\r\n]")
SPARED = re.compile(r"'+[=+\-@\t\r\n]")
EXAMPLE = "2026-11-21T09:30:00.123456789Z,17,250000,pump-1,output_current,1.5,ok"
BATCH_ROWS = 1 << 14
SECOND = 1_000_000_000
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def beside(path: Path) -> Path:
    """Where the metadata of a .csv lies."""
    return path.with_name(path.name + ".json")


class CsvWriter(RecordingWriter):
    """Writes each batch's lines in one call of the system."""

    def __init__(self, path: Path, metadata: Metadata) -> None:
        super().__init__(path)
        described = dump_metadata(metadata)
        try:
            self._file = WholeFile(path)
        except OSError as failure:
            raise RecordingError.of(failure, path) from failure
        try:
            _put(beside(path), described + "\n")
            self._append(HEADER)  # last: what begins with it is a recording, and has its metadata
        except OSError as failure:
            self.discard()
            raise RecordingError.of(failure, path) from failure

    def write(self, batch: Rows) -> None:
        try:
            self._append("".join(map(_line, batch)))
        except OSError as failure:
            raise RecordingError.of(failure, self.path, self.rows) from failure
        self.rows += len(batch)

    def _append(self, text: str) -> None:
        self._file.append(memoryview(text.encode()))

    def close(self) -> None:
        try:
            self._file.close()
        except OSError as failure:
            raise RecordingError.of(failure, self.path, self.rows) from failure

    @property
    def files(self) -> tuple[Path, ...]:
        return self.path, beside(self.path)


def _put(path: Path, text: str) -> None:
    """Make the file at once: at no time is there half of it."""
    part = path.with_name(path.name + ".part")
    try:
        part.write_text(text, encoding="utf-8")
        part.replace(path)
    except OSError:
        with suppress(OSError):
            part.unlink()
        raise


class CsvReader(RecordingReader):
    """Reads every whole line; without the .csv.json beside it the metadata is empty."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with path.open("rb") as file:
            if file.read(len(HEADER)) != HEADER.encode():
                raise not_a_recording(path, f"its first line is not {HEADER.strip()}")
            size = file.seek(0, os.SEEK_END)
            self._whole = _whole_lines(file, size)
        self.torn = size - self._whole
        try:
            described = beside(path).read_bytes()
        except FileNotFoundError:
            described = b"{}"
        self.metadata = load_metadata(described, beside(path))

    def __iter__(self) -> Iterator[Rows]:
        with self.path.open("rb") as file:
            lines = csv.reader(_lines(file, self._whole), strict=True)
            rows = map(_parse, islice(lines, 1, None))
            try:
                while some := list(islice(rows, BATCH_ROWS)):
                    yield from_rows(some)
            except (csv.Error, ValueError, OverflowError) as mistake:
                place = f"{self.path}, line {lines.line_num}"
                raise ValueError(f"{place}: not a row of a recording: one is like {EXAMPLE}") from mistake


def _whole_lines(file: BinaryIO, size: int) -> int:
    """The length of the file up to the end of its last whole line."""
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
    if len(cells) != len(Row._fields):
        raise ValueError(len(cells))
    time, monotonic_ns, uncertainty_ns, drive, register, value, status = cells
    return Row(
        _read(time),
        int(monotonic_ns),
        int(uncertainty_ns) if uncertainty_ns else None,
        _text(drive),
        _text(register),
        float(value) if value else None,
        _text(status),
    )


def _line(row: Row) -> str:
    time, monotonic_ns, uncertainty_ns, drive, register, value, status = row
    uncertainty = "" if uncertainty_ns is None else uncertainty_ns
    number = "" if value is None else repr(value)
    names = f"{_quote(drive)},{_quote(register)}"
    return f"{_spell(time)},{monotonic_ns},{uncertainty},{names},{number},{_quote(status)}\n"


@lru_cache(maxsize=4096)
def _quote(text: str) -> str:
    """As RFC 4180 has it: what holds a comma, a quote or the end of a line stands between quotes.

    A text that could be a formula gets an apostrophe in front, and so does one that has it already.
    """
    if FORMULA.match(text):
        text = f"'{text}"
    return '"' + text.replace('"', '""') + '"' if set(text) & set(',"\r\n') else text


@lru_cache(maxsize=4096)
def _text(cell: str) -> str:
    """The text that `_quote` was given."""
    return cell[1:] if SPARED.match(cell) else cell


def _spell(time_ns: int) -> str:
    second, rest = divmod(time_ns, SECOND)
    return f"{_spell_second(second)}.{rest:09d}Z"


def _read(time: str) -> int:
    second, dot, rest = time.partition(".")
    if not dot or len(rest) != 10 or rest[-1] != "Z":
        raise ValueError(time)
    return _read_second(second) * SECOND + int(rest[:-1])


@lru_cache(maxsize=1024)
def _spell_second(second: int) -> str:
    return (EPOCH + timedelta(seconds=second)).replace(tzinfo=None).isoformat()


@lru_cache(maxsize=1024)
def _read_second(text: str) -> int:
    return (datetime.fromisoformat(text).replace(tzinfo=UTC) - EPOCH) // timedelta(seconds=1)


writer, reader = CsvWriter, CsvReader
