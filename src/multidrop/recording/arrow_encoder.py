"""Encode rows as messages of an Arrow IPC stream, with names as dictionaries.

A dictionary goes before the first batch that needs it and again, whole, once it has changed: polars and
nanoarrow read no deltas. It is one piece of the file with that batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from struct import pack
from typing import Any

from multidrop.polling.batch import Rows
from multidrop.recording.arrow_ipc import CONTINUATION, DICTIONARY_BATCH, PREFIX, RECORD_BATCH, SCHEMA
from multidrop.recording.arrow_schema import CODED, schema_table
from multidrop.recording.coded_rows import CodedRows, Coder, Names
from multidrop.recording.flat_builder import Structs, Table, build

VERSION = ("<h", 4)  # of the format: V5
LONGEST_TEXTS = (1 << 31) - 1  # bytes of a dictionary


class Encoder:
    """Makes the pieces of one file, and knows which dictionaries it has."""

    def __init__(self) -> None:
        self._coder = Coder()
        self._written: dict[int, Names] = {}

    @staticmethod
    def head(metadata: dict[bytes, bytes]) -> bytes:
        """Return the message that begins the file."""
        return b"".join(_message(SCHEMA, schema_table(metadata), []))

    def piece(self, batch: Rows) -> tuple[bytes, dict[int, Names]]:
        """Return the messages of these rows, and the dictionaries that the file has after them."""
        after = dict(self._written)
        parts: list[Any] = []
        for coded in self._coder.coded(batch):
            for number in CODED:
                names = coded.names[number]
                if after.get(number) != names:
                    parts += _dictionary(number, names)
                    after[number] = names
            parts += _batch(coded)
        return b"".join(parts), after

    def is_written(self, after: dict[int, Names]) -> None:
        """Note that a piece is in the file."""
        self._written = after


def _dictionary(number: int, names: Names) -> list[Any]:
    texts = [name.encode() for name in names]
    ends = list(accumulate(map(len, texts), initial=0))
    if ends[-1] > LONGEST_TEXTS:
        raise ValueError("more than 2 GiB of names in one batch")
    buffers = [b"", pack(f"={len(ends)}i", *ends), b"".join(texts)]
    data, body = _record_batch(len(names), [0], buffers)
    return _message(DICTIONARY_BATCH, {0: ("<q", number), 1: data}, body)


def _batch(coded: CodedRows) -> list[Any]:
    nulls = [_zeros(bits, coded.rows) for bits, _ in coded.columns]
    buffers = [buffer for column in coded.columns for buffer in column]
    return _message(RECORD_BATCH, *_record_batch(coded.rows, nulls, buffers))


def _zeros(bits: bytes, rows: int) -> int:
    return rows - int.from_bytes(bits).bit_count() if bits else 0


def _record_batch(rows: int, nulls: Sequence[int], buffers: Sequence[Any]) -> tuple[Table, list[Any]]:
    """Return the table of a batch, and its body: each buffer filled up to eight bytes."""
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
        1: Structs(pack(f"<{len(nodes)}q", *nodes)),
        2: Structs(pack(f"<{len(places)}q", *places)),
    }
    return table, body


def _message(kind: int, header: Table, body: list[Any]) -> list[Any]:
    length = sum(memoryview(buffer).nbytes for buffer in body)
    table = {0: VERSION, 1: ("<B", kind), 2: header, 3: ("<q", length)}
    metadata = build(table)
    metadata += bytes(-len(metadata) % 8)
    return [PREFIX.pack(CONTINUATION, len(metadata)), metadata, *body]
