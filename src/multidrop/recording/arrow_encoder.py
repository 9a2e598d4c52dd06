"""Encode rows as messages of an Arrow IPC stream, with names as dictionaries.

A dictionary precedes the first batch that needs it. A changed dictionary is written again as a whole, because
polars and nanoarrow cannot read deltas. A dictionary and its batch are appended to the file in one write.
Field numbers are those of Arrow's format/Message.fbs and format/Schema.fbs.
"""

from __future__ import annotations

import struct
import sys
from array import array
from collections import deque
from collections.abc import Iterator, Sequence
from itertools import accumulate
from typing import Any, NamedTuple

from multidrop.core import STATUSES
from multidrop.core.columns import MOST_NARROW, CodeTable, narrow_up
from multidrop.polling.batch import Batch, Rows
from multidrop.recording.rows import texts_of

PREFIX = struct.Struct("<4si")  # the continuation marker, then the length of the metadata
CONTINUATION = b"\xff\xff\xff\xff"
SCHEMA, DICTIONARY_BATCH, RECORD_BATCH = 1, 2, 3  # header_type of a message

# ---- columns of a file ----

INT, FLOAT, UTF8, TIMESTAMP = 2, 3, 5, 10  # Field.type_type
SINGLE, DOUBLE, NANOSECONDS = 1, 2, 3
BUFFERS = {INT: 2, FLOAT: 2, TIMESTAMP: 2, UTF8: 3}  # number of buffers of a column in a batch, by type


class FileColumn(NamedTuple):
    """A column of a file.

    `detail` is the first field of its Arrow type: the number of bits, the precision or the time unit.
    """

    name: bytes
    kind: int
    detail: int = 0
    code_bits: int = 0  # width of the unsigned dictionary codes in bits; 0: no dictionary
    nullable: bool = False

    @property
    def buffers(self) -> int:
        """Number of the column's buffers in a batch: two for codes or numbers, three for texts."""
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


# ---- rows ----

VERSION = ("<h", 4)  # version V5 of the Arrow format
LONGEST_TEXTS = (1 << 31) - 1  # limit in bytes for a dictionary's texts
DRIVE, REGISTER, STATUS = CODED  # ids of the dictionaries
MOST_NAMES = {DRIVE: 1 << 16, REGISTER: 1 << 16, STATUS: MOST_NARROW}  # limit of a dictionary's names, by id

Names = tuple[str, ...]
Column = Any  # memoryview, array or bytes: anything with a buffer
Codes = dict[int, tuple[Column, Names]]  # codes of the rows, and names of the codes, by dictionary id


def schema_message(metadata: dict[bytes, bytes]) -> bytes:
    """Return the first message of a file, with the schema and the metadata."""
    return b"".join(_message(SCHEMA, _schema(metadata), []))


class Encoder:
    """Encodes the rows of one file. A name keeps its code until its dictionary is full."""

    def __init__(self) -> None:
        self._statuses = CodeTable(STATUSES)
        self._codes: dict[int, dict[str, int]] = {number: {} for number in CODED}
        self._dictionaries: dict[int, Names] = {}  # the newest dictionaries in the file, by id

    def encode(self, batch: Rows) -> bytes:
        """Return a record batch of the rows, preceded by new or changed dictionaries.

        Call `forget_dictionaries` if the result could not be appended to the file.
        """
        source = (
            _BatchCodes(batch, self._statuses) if isinstance(batch, Batch) else _RowCodes(batch, self._codes)
        )
        parts: list[Any] = []
        for rows in _pieces(source, 0, len(batch)):
            for number, names in rows.names.items():
                if self._dictionaries.get(number) != names:
                    parts += _dictionary(number, names)
                    self._dictionaries[number] = names
            parts += _batch(rows)
        return b"".join(parts)

    def forget_dictionaries(self) -> None:
        """Make the next `encode` write every dictionary again."""
        self._dictionaries = {}


# ---- codes ----


class _CodedRows(NamedTuple):
    """The columns of one record batch, with codes in place of names."""

    length: int
    columns: tuple[tuple[bytes, Column], ...]  # for each column: validity bitmap (b"": no nulls), data
    names: dict[int, Names]  # by dictionary id


def _pieces(source: _BatchCodes | _RowCodes, begin: int, end: int) -> Iterator[_CodedRows]:
    """Yield the rows as one batch, or as several batches if a column has more names than there are codes."""
    codes = source.codes(begin, end)
    if codes is None:
        middle = begin + (end - begin) // 16 * 8  # a multiple of 8 rows, because bitmaps start at whole bytes
        yield from _pieces(source, begin, middle)
        yield from _pieces(source, middle, end)
        return
    rows = slice(begin, end)
    columns = (
        (b"", source.time[rows]),
        (b"", source.sent[rows]),
        (_bitmap(source.certain, begin, end), narrow_up(source.uncertainty[rows])),
        (b"", codes[DRIVE][0]),
        (b"", codes[REGISTER][0]),
        (_bitmap(source.valid, begin, end), source.value[rows]),
        (b"", codes[STATUS][0]),
    )
    yield _CodedRows(end - begin, columns, {number: names for number, (_, names) in codes.items()})


def _bitmap(bits: memoryview | None, begin: int, end: int) -> bytes:
    """Return the validity bits of the rows `begin` to `end`, or b"" if all bits are set."""
    if bits is None:
        return b""
    rows = end - begin
    found = int.from_bytes(bits[begin // 8 : (end + 7) // 8], "little") & ((1 << rows) - 1)
    return b"" if found.bit_count() == rows else found.to_bytes((rows + 7) // 8, "little")


class _BatchCodes:
    """A polled batch with numbers instead of names. The C core numbers drives and registers."""

    def __init__(self, batch: Batch, statuses: CodeTable) -> None:
        columns = self._columns = batch.columns()
        self._statuses = statuses
        statuses.know(columns.statuses)
        self.time, self.sent, self.uncertainty = columns.time, columns.monotonic_ns, columns.uncertainty_ns
        self.value = columns.value
        self.certain = self.valid = columns.valid

    def codes(self, begin: int, end: int) -> Codes | None:
        """Return the codes of the rows' drives, registers and statuses, each with the names for the codes.

        Return None if the rows have more names than a column has codes.
        """
        columns, rows = self._columns, slice(begin, end)
        statuses = self._statuses.narrow(columns.status[rows])
        if statuses is None:
            self._statuses.forget()
            statuses = self._statuses.narrow(columns.status[rows])
        if statuses is None:
            return None
        return {
            DRIVE: (columns.drive[rows], columns.drives),
            REGISTER: (columns.register[rows], columns.registers),
            STATUS: (statuses, self._statuses.used),
        }


class _RowCodes:
    """Rows with numbers instead of names, made from rows with names, such as rows of another recording."""

    def __init__(self, rows: Rows, known: dict[int, dict[str, int]]) -> None:
        children = list(rows.arrow().view().children)
        self._known = known
        self._texts = {number: list(texts_of(children[number])) for number in CODED}
        self.time, self.sent, self.uncertainty, self.value = (
            memoryview(children[number].buffer(1)) for number in (0, 1, 2, 5)
        )
        self.certain, self.valid = (_bits(children[number]) for number in (2, 5))

    def codes(self, begin: int, end: int) -> Codes | None:
        """Return the codes of the rows' drives, registers and statuses, each with the names for the codes.

        Return None if the rows have more names than a column has codes.
        """
        found: Codes = {}
        for number, texts in self._texts.items():
            known, part = self._known[number], texts[begin:end]
            if len({*known, *part}) > MOST_NAMES[number]:
                known.clear()
                if len(set(part)) > MOST_NAMES[number]:
                    return None
            kind = "B" if number == STATUS else "H"
            codes = array(kind, [known.setdefault(text, len(known)) for text in part])
            found[number] = codes, tuple(known)
        return found


def _bits(column: Any) -> memoryview | None:
    return memoryview(column.buffer(0)).cast("B") if column.null_count else None


# ---- messages ----


def _dictionary(number: int, names: Names) -> list[Any]:
    texts = [name.encode() for name in names]
    ends = list(accumulate(map(len, texts), initial=0))
    if ends[-1] > LONGEST_TEXTS:
        raise ValueError(f"a batch has {ends[-1]} bytes of names; at most {LONGEST_TEXTS} fit")
    buffers = [b"", struct.pack(f"={len(ends)}i", *ends), b"".join(texts)]
    data, body = _record_batch(len(names), [0], buffers)
    return _message(DICTIONARY_BATCH, {0: ("<q", number), 1: data}, body)


def _batch(rows: _CodedRows) -> list[Any]:
    nulls = [_zeros(bits, rows.length) for bits, _ in rows.columns]
    buffers = [buffer for column in rows.columns for buffer in column]
    return _message(RECORD_BATCH, *_record_batch(rows.length, nulls, buffers))


def _zeros(bits: bytes, rows: int) -> int:
    return rows - int.from_bytes(bits).bit_count() if bits else 0


def _record_batch(rows: int, nulls: Sequence[int], buffers: Sequence[Any]) -> tuple[Table, list[Any]]:
    """Return the two parts of an Arrow record batch: its header, and its buffers with padding.

    Each buffer is padded to a multiple of eight bytes.
    """
    nodes = [number for count in nulls for number in (rows, count)]
    places: list[int] = []
    body: list[Any] = []
    at = 0
    for buffer in buffers:
        size = memoryview(buffer).nbytes
        places += (at, size)
        body += (buffer, bytes(-size % 8))
        at += size + -size % 8
    table = {
        0: ("<q", rows),
        1: Structs(struct.pack(f"<{len(nodes)}q", *nodes)),
        2: Structs(struct.pack(f"<{len(places)}q", *places)),
    }
    return table, body


def _message(kind: int, header: Table, body: list[Any]) -> list[Any]:
    length = sum(memoryview(buffer).nbytes for buffer in body)
    table = {0: VERSION, 1: ("<B", kind), 2: header, 3: ("<q", length)}
    metadata = _build(table)
    metadata += bytes(-len(metadata) % 8)
    return [PREFIX.pack(CONTINUATION, len(metadata)), metadata, *body]


def _schema(metadata: dict[bytes, bytes]) -> Table:
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


# ---- flatbuffers ----


Table = dict[int, Any]
_OFFSET = ("<I", 0)  # placeholder for an offset that `_build` fills in later


class Structs(bytes):
    """A vector of structs of 16 bytes each."""


def _build(root: Table) -> bytes:
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
    """Append the vtable and the table; return the table's position."""
    # larger fields come first, so that all fields are aligned
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
