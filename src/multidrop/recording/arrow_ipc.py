"""Parse and build the messages of an Arrow IPC stream.

All numbers in the file are checked: a damaged file raises an error and causes no crash. Field numbers are
those of Arrow's format/Message.fbs and format/Schema.fbs.
"""

from __future__ import annotations

import struct
import sys
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO, NamedTuple

PREFIX = struct.Struct("<4si")  # the continuation marker, then the length of the metadata
CONTINUATION = b"\xff\xff\xff\xff"
SCHEMA, DICTIONARY_BATCH, RECORD_BATCH = 1, 2, 3  # IpcMessage.header_type


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


Table = dict[int, Any]
_OFFSET = ("<I", 0)  # placeholder for an offset that `build` fills in later


class Structs(bytes):
    """A vector of structs of 16 bytes each."""


def build(root: Table) -> bytes:
    """Return the flatbuffer of this table."""
    out = bytearray(4)
    waiting: deque[tuple[int, Any]] = deque([(0, root)])  # (position of an offset, its target)
    while waiting:
        place, thing = waiting.popleft()
        if isinstance(thing, dict):
            at = _put_table(out, thing, waiting)
        elif isinstance(thing, list):
            at = _put_tables(out, thing, waiting)
        else:
            at = _put_vector(out, thing)
        struct.pack_into("<I", out, place, at - place)
    return bytes(out)


def _align(out: bytearray, size: int, ahead: int = 0) -> None:
    """Pad `out`, so that the position `ahead` bytes after its end is a multiple of `size`."""
    out += bytes(-(len(out) + ahead) % size)


def _put_table(out: bytearray, table: Table, waiting: deque[tuple[int, Any]]) -> int:
    """Append the vtable and the table; return the table's position. Larger fields are placed first, so that
    all fields are aligned.
    """
    fields = {number: value if isinstance(value, tuple) else _OFFSET for number, value in table.items()}
    in_order = sorted(fields, key=lambda number: -struct.calcsize(fields[number][0]))
    slots = [0] * (max(table, default=-1) + 1)
    size = 4
    for number in in_order:
        width = struct.calcsize(fields[number][0])
        size += -size % width
        slots[number] = size
        size += width
    vtable = struct.pack(f"<{2 + len(slots)}H", 4 + 2 * len(slots), size, *slots)
    _align(out, 8, len(vtable))
    out += vtable
    at = len(out)
    out += struct.pack("<i", len(vtable)) + bytes(size - 4)
    for number, value in table.items():
        struct.pack_into(fields[number][0], out, at + slots[number], fields[number][1])
        if not isinstance(value, tuple):
            waiting.append((at + slots[number], value))
    return at


def _put_tables(out: bytearray, tables: list[Table], waiting: deque[tuple[int, Any]]) -> int:
    _align(out, 4)
    at = len(out)
    out += struct.pack("<I", len(tables)) + bytes(4 * len(tables))
    waiting.extend((at + 4 + 4 * number, table) for number, table in enumerate(tables))
    return at


def _put_vector(out: bytearray, data: bytes) -> int:
    is_structs = isinstance(data, Structs)
    _align(out, 8 if is_structs else 4, 4 if is_structs else 0)
    at = len(out)
    out += struct.pack("<I", len(data) // 16 if is_structs else len(data)) + data + b"\0"
    return at


INT, FLOAT, UTF8, TIMESTAMP = 2, 3, 5, 10  # Field.type_type
SINGLE, DOUBLE, NANOSECONDS = 1, 2, 3
BUFFERS = {INT: 2, FLOAT: 2, TIMESTAMP: 2, UTF8: 3}  # number of buffers of a column in a batch, by type


class FileColumn(NamedTuple):
    """A column of a file. `detail` is the type's first field in the Arrow schema: bits, precision or time
    unit.
    """

    name: bytes
    kind: int
    detail: int = 0
    code_bits: int = 0  # width of the unsigned dictionary codes in bits; 0: no dictionary
    nullable: bool = False

    @property
    def buffers(self) -> int:
        """The number of the column's buffers in a batch: two for codes or numbers, three for texts."""
        return 2 if self.code_bits else BUFFERS[self.kind]


COLUMNS = (
    FileColumn(b"time", TIMESTAMP, NANOSECONDS),
    FileColumn(b"monotonic_ns", INT, 64),
    FileColumn(b"uncertainty_ns", FLOAT, SINGLE, nullable=True),  # rounded up, so it stays an upper bound
    FileColumn(b"drive", UTF8, code_bits=16),
    FileColumn(b"register", UTF8, code_bits=16),
    FileColumn(b"value", FLOAT, DOUBLE, nullable=True),
    FileColumn(b"status", UTF8, code_bits=8),
)
# columns in files of versions up to 0.1, and in files that other programs write
COLUMNS_BEFORE = (
    *COLUMNS[:2],
    FileColumn(b"uncertainty_ns", INT, 64, nullable=True),
    *(FileColumn(name, UTF8) for name in (b"drive", b"register")),
    COLUMNS[5],
    FileColumn(b"status", UTF8),
)
CODED = {number: column for number, column in enumerate(COLUMNS) if column.code_bits}  # by dictionary id


def schema_table(metadata: dict[bytes, bytes]) -> Table:
    """Return the Schema table of COLUMNS."""
    return {
        0: ("<h", int(sys.byteorder == "big")),
        1: [_field(number, column) for number, column in enumerate(COLUMNS)],
        2: [{0: key, 1: value} for key, value in metadata.items()],
    }


def _field(number: int, column: FileColumn) -> Table:
    field: Table = {
        0: column.name,
        1: ("<?", column.nullable),
        2: ("<B", column.kind),
        3: _type(column.kind, column.detail),
        5: [],
    }
    if column.code_bits:
        field[4] = {0: ("<q", number), 1: {0: ("<i", column.code_bits), 1: ("<?", False)}}
    return field


def _type(kind: int, detail: int) -> Table:
    if kind == INT:
        return {0: ("<i", detail), 1: ("<?", True)}
    if kind == FLOAT:
        return {0: ("<h", detail)}
    return {0: ("<h", detail), 1: b"UTC"} if kind == TIMESTAMP else {}
