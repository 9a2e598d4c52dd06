"""Rows with codes for their names, as an .arrows file has them."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from typing import Any, NamedTuple

from multidrop.core import STATUSES
from multidrop.core.narrow import MOST_NARROW, CodeTable, narrow_up
from multidrop.polling.batch import Batch, Rows
from multidrop.recording.arrow_schema import CODED
from multidrop.recording.rows import texts_of

DRIVE, REGISTER, STATUS = CODED  # ids of the dictionaries
MOST_NAMES = {DRIVE: 1 << 16, REGISTER: 1 << 16, STATUS: MOST_NARROW}  # for which codes have room

Names = tuple[str, ...]
Column = Any  # memoryview, array or bytes: whatever has a buffer
Codes = dict[int, tuple[Column, Names]]  # with the names that they stand for, by dictionary


class CodedRows(NamedTuple):
    """Rows as one batch of the file has them."""

    rows: int
    columns: tuple[tuple[bytes, Column], ...]  # of each its bitmap, empty where all are there, and its data
    names: dict[int, Names]  # by dictionary


class Coder:
    """Gives codes to the names of one file; the same name has the same code while there is room."""

    def __init__(self) -> None:
        self._statuses = CodeTable(STATUSES)
        self._known: dict[int, dict[str, int]] = {number: {} for number in CODED}

    def coded(self, batch: Rows) -> Iterator[CodedRows]:
        """Yield the rows; in one piece, but where one column has more names than codes."""
        source = _OfBatch(batch, self._statuses) if isinstance(batch, Batch) else _OfRows(batch, self._known)
        yield from _pieces(source, 0, len(batch))


def _pieces(source: _OfBatch | _OfRows, begin: int, end: int) -> Iterator[CodedRows]:
    codes = source.codes(begin, end)
    if codes is None:
        middle = begin + (end - begin) // 16 * 8  # a bitmap begins with a byte
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
    yield CodedRows(end - begin, columns, {number: names for number, (_, names) in codes.items()})


def _bitmap(bits: memoryview | None, begin: int, end: int) -> bytes:
    """Return the bits of these rows, or nothing where all are set."""
    if bits is None:
        return b""
    rows = end - begin
    found = int.from_bytes(bits[begin // 8 : (end + 7) // 8], "little") & ((1 << rows) - 1)
    return b"" if found.bit_count() == rows else found.to_bytes((rows + 7) // 8, "little")


class _OfBatch:
    """Rows that the core made have codes for drives and registers already."""

    def __init__(self, batch: Batch, statuses: CodeTable) -> None:
        columns = self._columns = batch.columns()
        self._statuses = statuses
        self.time, self.sent, self.uncertainty = columns.time, columns.monotonic_ns, columns.uncertainty_ns
        self.value = columns.value
        self.certain = self.valid = columns.valid

    def codes(self, begin: int, end: int) -> Codes | None:
        """Return the codes of these rows; None where there are too many names."""
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


class _OfRows:
    """Rows that were read from a recording have texts."""

    def __init__(self, rows: Rows, known: dict[int, dict[str, int]]) -> None:
        children = list(rows.arrow().view().children)
        self._known = known
        self._texts = {number: list(texts_of(children[number])) for number in CODED}
        self.time, self.sent, self.uncertainty, self.value = (
            memoryview(children[number].buffer(1)) for number in (0, 1, 2, 5)
        )
        self.certain, self.valid = (_bits(children[number]) for number in (2, 5))

    def codes(self, begin: int, end: int) -> Codes | None:
        """Return the codes of these rows; None where there are too many names."""
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
