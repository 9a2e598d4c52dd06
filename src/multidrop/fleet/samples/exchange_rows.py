"""Rows of exchanges, and PostgreSQL's binary COPY of them.

The format is that of the manual, section "COPY, Binary Format"; an array is its number of dimensions, a flag
for nulls, its elements' type, a size and a lower bound, and the elements, each behind its length.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from itertools import pairwise
from struct import Struct, pack
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.compute as pc

HEAD = b"PGCOPY\n\xff\r\n\0" + bytes(8)
END = b"\xff\xff"
EPOCH_US = 946_684_800_000_000  # 2000-01-01, from which PostgreSQL counts
FLOAT8, TEXT = 701, 25  # their oids
NULL = b"\xff\xff\xff\xff"
PIECE = 1 << 18  # bytes, about
_FIRST = Struct(">hiqiq")  # columns, and a time of 8 bytes, twice
_NUMBER = Struct(">ii")
_ARRAY = Struct(">iiiiii")


class RegisterSet(NamedTuple):
    """The registers that were asked at once, and what the value of each is; None where nobody knows it."""

    names: tuple[str, ...]
    units: tuple[str | None, ...]


class ExchangeRow(NamedTuple):
    """Rows of one drive that were asked at one time."""

    time_ns: int
    uncertainty_ns: int | None
    drive: str
    asked: RegisterSet
    values: list[float | None]
    misses: list[str] | None  # None where all is ok; else "ok" or the reason


class ExchangeRows(NamedTuple):
    """The exchanges of a message, and the names in them."""

    exchanges: list[ExchangeRow]
    drives: frozenset[str]
    sets: frozenset[RegisterSet]


def exchanges_of(table: Any) -> ExchangeRows:
    """Return the exchanges of a table of `message.ROWS`, in order of time and drive."""
    table = table.combine_chunks()
    if not len(table):
        return ExchangeRows([], frozenset(), frozenset())
    drives = table.column("drive").chunk(0)
    keys = pa.table({"time": table.column("time").cast(pa.int64()), "drive": drives.indices})
    table = table.take(
        pc.sort_indices(keys, [("time", "ascending"), ("drive", "ascending")])
    ).combine_chunks()
    columns = {name: table.column(name).chunk(0) for name in table.schema.names}
    codes = {name: _numbers(columns[name].indices, "i") for name in ("drive", "register", "status", "unit")}
    texts = {name: columns[name].dictionary.to_pylist() for name in codes}
    times = _numbers(columns["time"], "q")
    uncertainties, values = _numbers(columns["uncertainty_ns"], "q"), _numbers(columns["value"], "d")
    begins = _changes(columns["time"].cast(pa.int64()), columns["drive"].indices)
    registers, units = codes["register"], codes["unit"]
    statuses, status_texts = codes["status"], texts["status"]
    ok = status_texts.index("ok") if "ok" in status_texts else -1
    sets: dict[tuple[tuple[int, ...], tuple[int | None, ...]], RegisterSet] = {}
    found = []
    for begin, end in pairwise([*begins, len(times)]):
        key = tuple(registers[begin:end]), tuple(units[begin:end])
        asked = sets.get(key)
        if asked is None:
            asked = sets[key] = RegisterSet(
                tuple(texts["register"][code] for code in key[0]),
                tuple(None if code is None else texts["unit"][code] for code in key[1]),
            )
        told = statuses[begin:end]
        misses = None if told.count(ok) == len(told) else [status_texts[code] for code in told]
        one = uncertainties[begin:end]
        uncertainty = next((known for known in one if known is not None), None) if misses else one[0]
        drive = texts["drive"][codes["drive"][begin]]
        found.append(ExchangeRow(times[begin], uncertainty, drive, asked, values[begin:end], misses))
    return ExchangeRows(found, frozenset(one.drive for one in found), frozenset(sets.values()))


def _numbers(column: Any, kind: str) -> list[Any]:
    """Return a column's numbers, None where there is none; ten times as fast as to_pylist."""
    data: Any = memoryview(column.buffers()[1]).cast("B")
    found: list[Any] = data.cast(kind)[column.offset :][: len(column)].tolist()
    if column.null_count:
        for at in pc.indices_nonzero(pc.is_null(column)).to_pylist():
            found[at] = None
    return found


def _changes(first: Any, second: Any) -> list[int]:
    """Return where either column is other than in the row before; 0 is the first."""
    changed = [pc.not_equal(column[1:], column[:-1]) for column in (first, second)]
    either = pc.or_(*changed)
    return [0, *(at + 1 for at in pc.indices_nonzero(either).to_pylist())]


def copied(
    found: Iterable[ExchangeRows], drives: Mapping[str, int], sets: Mapping[RegisterSet, int]
) -> Iterator[bytes]:
    """Yield pieces of a COPY of the columns that `PostgresSink` names."""
    piece = [HEAD]
    size = 0
    for one in found:
        for exchange in one.exchanges:
            piece.append(_row(exchange, drives[exchange.drive], sets[exchange.asked]))
            size += len(piece[-1])
            if size >= PIECE:
                yield b"".join(piece)
                piece, size = [], 0
    yield b"".join([*piece, END])


def _row(exchange: ExchangeRow, drive: int, names: int) -> bytes:
    time, uncertainty = exchange.time_ns, exchange.uncertainty_ns
    return b"".join(
        (
            _FIRST.pack(7, 8, time // 1000 - EPOCH_US, 8, time),
            NULL if uncertainty is None else _NUMBER.pack(4, uncertainty // 1000),
            _NUMBER.pack(4, drive),
            _NUMBER.pack(4, names),
            _floats(exchange.values),
            NULL if exchange.misses is None else _texts(exchange.misses),
        )
    )


def _floats(values: list[float | None]) -> bytes:
    if None not in values:
        many = len(values)
        numbers: list[Any] = [8] * (2 * many)
        numbers[1::2] = values
        return _whole(many).pack(20 + 12 * many, 1, 0, FLOAT8, many, 1, *numbers)
    elements = [NULL if value is None else pack(">id", 8, value) for value in values]
    return _array(FLOAT8, elements, has_nulls=True)


@cache
def _whole(many: int) -> Struct:
    return Struct(">iiiiii" + "id" * many)


def _texts(texts: list[str]) -> bytes:
    encoded = [text.encode() for text in texts]
    return _array(TEXT, [pack(">i", len(text)) + text for text in encoded], has_nulls=False)


def _array(kind: int, elements: list[bytes], *, has_nulls: bool) -> bytes:
    body = b"".join(elements)
    return _ARRAY.pack(20 + len(body), 1, int(has_nulls), kind, len(elements), 1) + body
