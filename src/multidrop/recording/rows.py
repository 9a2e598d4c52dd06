"""Rows read from a recording, in Arrow's layout."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Iterator, Sequence
from itertools import accumulate, pairwise
from typing import Any

from multidrop.polling.batch import Row, Rows, assemble, shown_span


class RecordedRows(Rows):
    """Rows in a nanoarrow array with the schema of a recording."""

    def __init__(self, rows: Any) -> None:
        self._array = rows

    def __len__(self) -> int:
        return int(self._array.length)

    def __iter__(self) -> Iterator[Row]:
        # This generator keeps the array alive: nanoarrow frees an array's buffers even if memoryviews use
        # them.
        yield from map(Row._make, zip(*map(_values, self._array.view().children), strict=True))

    def __repr__(self) -> str:
        return f"<Rows: {shown_span([*self])}>"

    def arrow(self) -> Any:
        return self._array


def _values(column: Any) -> Iterable[Any]:
    """Return the values of a column, with None for each null."""
    if column.n_buffers == 3:
        return texts_of(column)
    numbers = memoryview(column.buffer(1))[: column.length]
    if not column.null_count:
        return numbers
    valid = column.buffer(0).elements()
    return (number if there else None for number, there in zip(numbers, valid, strict=False))


def texts_of(column: Any) -> Iterator[str]:
    """Yield the text in each row of a column."""
    ends, text = memoryview(column.buffer(1))[: column.length + 1], bytes(column.buffer(2))
    if text.isascii():  # usual case: decode all texts together
        letters = text.decode("ascii")
        return (letters[begin:end] for begin, end in pairwise(ends))
    return (text[begin:end].decode(errors="replace") for begin, end in pairwise(ends))


def from_rows(rows: Sequence[Row]) -> RecordedRows:
    """Convert rows to Arrow's layout."""
    time, monotonic_ns, uncertainty_ns, drive, register, value, status = zip(*rows, strict=True)
    return RecordedRows(
        assemble(
            len(rows),
            (None, array("q", time)),
            (None, array("q", monotonic_ns)),
            (_bitmap(uncertainty_ns), array("q", _filled(uncertainty_ns))),
            (None, *_encoded(drive)),
            (None, *_encoded(register)),
            (_bitmap(value), array("d", _filled(value))),
            (None, *_encoded(status)),
        )
    )


def _filled(values: Sequence[Any]) -> list[Any]:
    return [0 if value is None else value for value in values]


def _bitmap(values: Sequence[object]) -> bytes:
    """Return a validity bitmap, least significant bit first: 0 for None, 1 for any other value."""
    bits = "".join("0" if value is None else "1" for value in reversed(values))
    return int(bits, 2).to_bytes((len(values) + 7) // 8, "little")


def _encoded(texts: Sequence[str]) -> tuple[array[int], bytes]:
    encoded = [text.encode() for text in texts]
    return array("i", [0, *accumulate(map(len, encoded))]), b"".join(encoded)
