"""Decode the batches of an Arrow IPC stream into rows with texts in place of dictionary codes.

All numbers in the batches are checked: a damaged batch raises an error.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice, pairwise
from typing import Any, NamedTuple

from multidrop.core import Names, spell
from multidrop.core.columns import greatest_code, wide_codes, widen
from multidrop.polling.batch import assemble
from multidrop.recording.arrow_ipc import (
    DICTIONARY_BATCH,
    FLOAT,
    RECORD_BATCH,
    SINGLE,
    UTF8,
    FileColumn,
    FlatTable,
    IpcMessage,
)
from multidrop.recording.rows import RecordedRows

# limit in bytes of one column's texts in one batch: a small damaged file could expand to gigabytes
MOST_SPELLED = 1 << 28
Buffers = tuple[Any, ...]


class RecordedColumns(NamedTuple):
    """Columns of a recorded batch: numbers for each row, and names as codes (indexes into a dictionary)."""

    time: memoryview
    monotonic_ns: memoryview
    uncertainty_ns: memoryview  # 0 if the row has no value
    drive: memoryview
    register: memoryview
    value: memoryview  # undefined if the row has no value
    status: memoryview
    valid: bytes | None  # one bit per row: 1 if the row has a value; None: every row has a value
    drives: tuple[str, ...]
    registers: tuple[str, ...]
    statuses: tuple[str, ...]


class BatchDecoder:
    """Decodes one file's batches in their order. A batch uses the dictionaries that precede it in the file.

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
        """Return a batch's columns, with checked codes in place of names.

        `names_of` are the dictionaries before this batch in the file. Raises the errors of `decode`, and
        ValueError for files of earlier versions, whose names have no codes.
        """
        rows, buffers = _parts(header, body, sum(column.buffers for column, _ in self._columns))
        left = iter(buffers)
        found: list[Any] = []
        names: list[tuple[str, ...]] = []
        valid: bytes | None = None
        for column, identity in self._columns:
            bits, data, *_ = islice(left, column.buffers)
            if len(bits) and not column.nullable:
                _check_filled(column, bits, rows)
            if column.name == b"value":
                valid = bits or None
            if identity is not None:
                codes, known = wide_codes(data, rows, column.code_bits // 8), names_of.get(identity)
                if known is None or (rows and greatest_code(codes) >= len(known)):
                    raise ValueError("a batch of rows precedes the dictionary that its codes need")
                found.append(codes)
                names.append(known.listed)
            elif column.detail == SINGLE:
                found.append(widen(data, bits or None, rows).cast("B").cast("q"))
            elif column.kind == UTF8 or len(data) < 8 * rows:
                raise ValueError("the stated lengths do not match the data")
            else:
                found.append(memoryview(data[: 8 * rows]).cast("d" if column.kind == FLOAT else "q"))
        if valid is not None and len(valid) * 8 < rows:
            raise ValueError("the stated lengths do not match the data")
        return RecordedColumns._make([*found, valid, *names])

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
        """Store the dictionary in this message. If the message is a delta, extend the stored dictionary
        instead.
        """
        number, table = header.number(0, "<q"), header.table(1)
        if table is None or number not in self._ids:
            raise ValueError("it has a dictionary that no column uses")
        count, (_, ends, text) = _parts(table, body, 3)
        _check_text(ends, text)
        if count and len(ends) < 4 * (count + 1):
            raise ValueError("the stated lengths do not match the data")
        places = memoryview(ends)[: 4 * (count + 1)].cast("i") if count else [0]
        names = []
        for begin, end in pairwise(places):
            if not 0 <= begin <= end <= len(text):
                raise ValueError("the stated lengths do not match the data")
            names.append(str(text[begin:end], "utf-8"))
        before = self._names.get(number) if header.number(2, "<?") else None
        learnt = Names([*(before.listed if before else ()), *names])
        self._names = {**self._names, number: learnt}


def _parts(batch: FlatTable, body: memoryview, count: int) -> tuple[int, list[bytes]]:
    """Return the number of rows of a batch, and its buffers. There must be `count` buffers.

    The buffers are copies. A memoryview of `body` that survives in an error's traceback would crash the
    interpreter.
    """
    if batch.table(3):
        raise ValueError("its batches are compressed: only pyarrow and polars can read them")
    rows, places = batch.number(0, "<q"), batch.pairs(2)
    if not 0 <= rows <= len(body):  # a larger `rows` could overflow the sums below
        raise ValueError(f"a batch states {rows} rows, but has only {len(body)} bytes")
    if len(places) != count:
        raise ValueError(f"a batch has {len(places)} buffers, not {count}")
    return rows, [bytes(body[at : at + length]) for at, length in places]


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
            raise ValueError("its text is not UTF-8")
