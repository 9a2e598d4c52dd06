"""Parse the messages of an Arrow IPC stream, and decode its batches into rows with texts in place of codes.

All numbers in the file are checked: a damaged file raises an error and causes no crash. Field numbers are
those of Arrow's format/Message.fbs and format/Schema.fbs.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice, pairwise
from typing import Any, BinaryIO, NamedTuple

from multidrop.core import Names, spell
from multidrop.core.columns import greatest_code, wide_codes, widen
from multidrop.polling.batch import assemble
from multidrop.recording.arrow_encoder import (
    CONTINUATION,
    DICTIONARY_BATCH,
    FLOAT,
    PREFIX,
    RECORD_BATCH,
    SINGLE,
    UTF8,
    FileColumn,
)
from multidrop.recording.rows import RecordedRows

# ---- messages ----


class FlatTable:
    """A flatbuffer's table. Fields are read by number; an absent field is 0 or empty."""

    def __init__(self, data: bytes, at: int) -> None:
        self._data = data
        self._at = at
        self._vtable = at - self._read("<i", at)

    def number(self, field: int, format: str) -> int:
        at = self._find(field)
        return self._read(format, at) if at else 0

    def table(self, field: int) -> FlatTable | None:
        at = self._find(field)
        return FlatTable(self._data, at + self._read("<I", at)) if at else None

    def tables(self, field: int) -> list[FlatTable]:
        start, count = self._vector(field, 4)
        return [FlatTable(self._data, at + self._read("<I", at)) for at in range(start, start + 4 * count, 4)]

    def pairs(self, field: int) -> list[tuple[int, int]]:
        """Return the field's vector of structs of two int64 each."""
        start, count = self._vector(field, 16)
        return list(struct.iter_unpack("<qq", self._data[start : start + 16 * count]))

    def text(self, field: int) -> bytes:
        start, count = self._vector(field, 1)
        return self._data[start : start + count]

    def _find(self, field: int) -> int:
        slot = 4 + 2 * field
        if slot >= self._read("<H", self._vtable):
            return 0
        offset = self._read("<H", self._vtable + slot)
        return self._at + offset if offset else 0

    def _vector(self, field: int, size: int) -> tuple[int, int]:
        at = self._find(field)
        if not at:
            return 0, 0
        start = at + self._read("<I", at)
        count = self._read("<I", start)
        if start + 4 + count * size > len(self._data):
            raise struct.error("a vector ends outside of the message")
        return start + 4, count

    def _read(self, format: str, at: int) -> int:
        number: int = struct.unpack_from(format, self._data, at)[0]
        return number


@dataclass(frozen=True)
class IpcMessage:
    """One complete message: its header, and the positions in the file where its body starts and ends."""

    kind: int
    header: FlatTable | None
    body: int
    end: int


def messages(file: BinaryIO, size: int, start: int = 0) -> Iterator[IpcMessage]:
    """Yield the messages between the positions `start` and `size`; stop at a truncated or invalid message."""
    end = start
    while message := _message(file, end, size):
        yield message
        end = message.end


def _message(file: BinaryIO, at: int, size: int) -> IpcMessage | None:
    file.seek(at)
    prefix = file.read(PREFIX.size)
    if len(prefix) < PREFIX.size:
        return None
    marker, length = PREFIX.unpack(prefix)
    body = at + PREFIX.size + length
    if marker != CONTINUATION or length < 0 or body > size:
        return None
    if length == 0:  # the end marker of the stream
        return IpcMessage(0, None, body, body)
    try:
        metadata = file.read(length)
        message = FlatTable(metadata, struct.unpack_from("<I", metadata)[0])
        end = body + message.number(3, "<q")
        if not body <= end <= size:
            return None
        return IpcMessage(message.number(1, "<B"), message.table(2), body, end)
    except struct.error:
        return None


# ---- batches ----

# limit in bytes of one column's texts in one batch: a small damaged file could expand to gigabytes
MOST_SPELLED = 1 << 28
MOST_CODES = 1 << 16  # limit of the different names in a batch
Buffers = tuple[Any, ...]


class RecordedColumns(NamedTuple):
    """Columns of a recorded batch: numbers for each row, and names as codes (indexes into a dictionary)."""

    time: memoryview
    monotonic_ns: memoryview
    uncertainty_ns: memoryview  # undefined if the row has no uncertainty
    drive: memoryview
    register: memoryview
    value: memoryview  # undefined if the row has no value
    status: memoryview
    certain: bytes | None  # one bit per row, 1 if the row has an uncertainty; None: all rows have one
    valid: bytes | None  # one bit per row, 1 if the row has a value; None: all rows have one
    drives: tuple[str, ...]
    registers: tuple[str, ...]
    statuses: tuple[str, ...]


class BatchDecoder:
    """Decodes the batches of one file, in the file's order.

    `columns` lists the file's columns, each with the id of its dictionary or None.
    """

    def __init__(self, columns: Sequence[tuple[FileColumn, int | None]]) -> None:
        self._columns = columns
        self._ids = {identity for _, identity in columns if identity is not None}
        self._names: dict[int, Names] = {}

    def decode(self, message: IpcMessage, header: FlatTable, body: memoryview) -> RecordedRows | None:
        """Return the rows of a batch. If the message is a dictionary, store it and return None.

        Raises ValueError, RuntimeError or struct.error if the message is damaged.
        """
        if message.kind == DICTIONARY_BATCH:
            self._learn(header, body)
            return None
        if message.kind != RECORD_BATCH:
            raise ValueError("a message is not a batch of rows")
        rows, buffers = _parts(header, body, sum(column.buffers for column, _ in self._columns))
        left = iter(buffers)
        columns = [
            self._decoded(column, identity, rows, *islice(left, column.buffers))
            for column, identity in self._columns
        ]
        return RecordedRows(assemble(rows, *columns))

    @property
    def known(self) -> dict[int, Names]:
        """The dictionaries decoded so far, by id. The returned mapping never changes later."""
        return self._names

    def columns(self, header: FlatTable, body: memoryview, names_of: dict[int, Names]) -> RecordedColumns:
        """Return a batch's columns, with codes in place of names.

        `names_of` are the dictionaries that precede this batch in the file. Raises the errors of `decode`.
        """
        rows, buffers = _parts(header, body, sum(column.buffers for column, _ in self._columns))
        left = iter(buffers)
        found: list[Any] = []
        names: list[tuple[str, ...]] = []
        filled: list[bytes | None] = []  # bitmaps of the columns that may have nulls
        for column, identity in self._columns:
            bits, data, *text = islice(left, column.buffers)
            if column.nullable:
                filled.append(bits or None)
            elif len(bits):
                _check_filled(column, bits, rows)
            if identity is not None:
                codes, known = wide_codes(data, rows, column.code_bits // 8), names_of.get(identity)
                if known is None or (rows and greatest_code(codes) >= len(known)):
                    raise ValueError("a batch of rows precedes the dictionary that its codes need")
                found.append(codes)
                names.append(known.listed)
            elif column.kind == UTF8:  # a file of version 0.1, in which names have no codes
                numbers: dict[str, int] = {}
                texts = [numbers.setdefault(name, len(numbers)) for name in _texts(data, text[0], rows)]
                if len(numbers) > MOST_CODES:
                    raise ValueError(f"a batch has {len(numbers)} names; the limit is {MOST_CODES}")
                found.append(memoryview(array("H", texts)))
                names.append(tuple(numbers))
            elif column.detail == SINGLE:
                found.append(widen(data, bits or None, rows).cast("B").cast("q"))
            elif len(data) < 8 * rows:
                raise ValueError("the stated lengths do not match the data")
            else:
                found.append(memoryview(data[: 8 * rows]).cast("d" if column.kind == FLOAT else "q"))
        if any(bits is not None and len(bits) * 8 < rows for bits in filled):
            raise ValueError("the stated lengths do not match the data")
        return RecordedColumns._make([*found, *filled, *names])

    def _decoded(
        self, column: FileColumn, identity: int | None, rows: int, bits: bytes, *data: Any
    ) -> Buffers:
        valid = bits if len(bits) else None
        if valid and not column.nullable:
            _check_filled(column, valid, rows)
            valid = None
        if identity is not None:
            names = self._names.get(identity)
            if names is None:
                raise ValueError("a batch of rows precedes the dictionary that its codes need")
            if rows * names.spelling.longest > MOST_SPELLED:
                raise ValueError(f"the names of a batch of {rows} rows are too long")
            return valid, *spell(wide_codes(data[0], rows, column.code_bits // 8), names)
        if column.kind == UTF8:
            _check_text(*data)
        if column.detail == SINGLE:
            return valid, widen(data[0], valid, rows)
        return valid, *data

    def _learn(self, header: FlatTable, body: memoryview) -> None:
        """Remember the names in this dictionary message. If it is a delta, add them to the known names."""
        number, table = header.number(0, "<q"), header.table(1)
        if table is None or number not in self._ids:
            raise ValueError("it has a dictionary that no column uses")
        count, (_, ends, text) = _parts(table, body, 3)
        names = _texts(ends, text, count)
        before = self._names.get(number) if header.number(2, "<?") else None
        learnt = Names([*(before.listed if before else ()), *names])
        self._names = {**self._names, number: learnt}


def _parts(batch: FlatTable, body: memoryview, count: int) -> tuple[int, list[bytes]]:
    """Return the number of rows of a batch, and copies of its buffers. There must be `count` buffers."""
    if batch.table(3):
        raise ValueError("the recording is compressed: only pyarrow and polars can read it")
    rows, places = batch.number(0, "<q"), batch.pairs(2)
    if not 0 <= rows <= len(body):  # a larger `rows` could overflow the sums below
        raise ValueError(f"a batch states {rows} rows, but has only {len(body)} bytes")
    if len(places) != count:
        raise ValueError(f"a batch has {len(places)} buffers, not {count}")
    # copies, because a view of `body` that survives in an error's traceback would crash the interpreter
    return rows, [bytes(body[at : at + length]) for at, length in places]


def _texts(ends: bytes, text: bytes, count: int) -> list[str]:
    """Return the texts of a column with `count` rows. Raises ValueError if they are damaged."""
    _check_text(ends, text)
    if count and len(ends) < 4 * (count + 1):
        raise ValueError("the stated lengths do not match the data")
    places = memoryview(ends)[: 4 * (count + 1)].cast("i") if count else [0]
    texts = []
    for begin, end in pairwise(places):
        if not 0 <= begin <= end <= len(text):
            raise ValueError("the stated lengths do not match the data")
        texts.append(str(text[begin:end], "utf-8"))
    return texts


def _check_filled(column: FileColumn, bits: bytes, rows: int) -> None:
    """Raise ValueError if a row lacks a value in this column, which must not have nulls."""
    filled = (1 << rows) - 1
    if int.from_bytes(bits, "little") & filled != filled:
        raise ValueError(f"a row has no value in the column {column.name.decode()}")


def _check_text(offsets: bytes, text: bytes) -> None:
    """Raise ValueError unless each row's text is valid UTF-8, because Arrow libraries do not check this."""
    if str(text, "utf-8").isascii():
        return
    for at in memoryview(offsets)[: len(offsets) // 4 * 4].cast("i"):
        if 0 <= at < len(text) and text[at] & 0xC0 == 0x80:  # the text starts in the middle of a character
            raise ValueError("a text is not UTF-8")
