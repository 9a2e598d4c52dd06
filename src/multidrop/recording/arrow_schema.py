"""The columns of an .arrows file, by the numbers of Arrow's format/Schema.fbs."""

from __future__ import annotations

import sys
from typing import NamedTuple

from multidrop.recording.flat_builder import Table

INT, FLOAT, UTF8, TIMESTAMP = 2, 3, 5, 10  # Field.type_type
SINGLE, DOUBLE, NANOSECONDS = 1, 2, 3
BUFFERS = {INT: 2, FLOAT: 2, TIMESTAMP: 2, UTF8: 3}  # that a column has in a batch


class FileColumn(NamedTuple):
    """A column's name, type, the first field of that (bits, precision, unit), and the bits of its codes."""

    name: bytes
    kind: int
    detail: int = 0
    code_bits: int = 0  # of unsigned codes of a dictionary; 0: it has none
    nullable: bool = False

    @property
    def buffers(self) -> int:
        """Buffers in a batch; codes have two, as all numbers."""
        return 2 if self.code_bits else BUFFERS[self.kind]


COLUMNS = (
    FileColumn(b"time", TIMESTAMP, NANOSECONDS),
    FileColumn(b"monotonic_ns", INT, 64),
    FileColumn(b"uncertainty_ns", FLOAT, SINGLE, nullable=True),  # rounded up: the bound stays true
    FileColumn(b"drive", UTF8, code_bits=16),
    FileColumn(b"register", UTF8, code_bits=16),
    FileColumn(b"value", FLOAT, DOUBLE, nullable=True),
    FileColumn(b"status", UTF8, code_bits=8),
)
COLUMNS_BEFORE = (  # until 0.1; and as other programs write our batches
    *COLUMNS[:2],
    FileColumn(b"uncertainty_ns", INT, 64, nullable=True),
    *(FileColumn(name, UTF8) for name in (b"drive", b"register")),
    COLUMNS[5],
    FileColumn(b"status", UTF8),
)
CODED = {number: column for number, column in enumerate(COLUMNS) if column.code_bits}  # by dictionary's id


def schema_table(metadata: dict[bytes, bytes]) -> Table:
    """Return the Schema of these columns."""
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
