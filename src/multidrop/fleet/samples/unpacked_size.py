"""Unpacked size: what the buffers of an Arrow IPC stream take in memory, by what it declares of them. Pure.

A compressed buffer begins with its size when it is unpacked, and pyarrow asks for so much memory before it
looks at the rest. So the sizes are read first, out of the flatbuffers that Message.fbs of Arrow's format
describes: a table begins with the distance back to a list of its fields' offsets; 0 stands for a field that
is not there.
"""

from __future__ import annotations

from struct import Struct, error
from typing import Any

import pyarrow as pa

LATEST = 4  # MetadataVersion.V5: older ones have other ways to say that buffers are compressed
MOST_MESSAGES = 100  # of a stream: the schema, dictionaries and rows
_DICTIONARY, _RECORD_BATCH = 2, 3  # MessageHeader
_I8, _U16, _I32, _U32, _I64 = (Struct(f"<{kind}") for kind in "bHiIq")
_BUFFER = Struct("<qq")  # its place in the body, and its length there
_NOT_COMPRESSED = -1  # declared of one that would not get smaller


def unpacked_size(data: bytes | memoryview) -> int:
    """Return the size of all buffers together. Raises ValueError or pa.ArrowException for what has none."""
    size = 0
    for number, message in enumerate(pa.ipc.MessageReader.open_stream(data)):
        if number == MOST_MESSAGES:
            raise ValueError(f"it has more than {MOST_MESSAGES} parts")
        try:
            size += _size(memoryview(message.metadata), memoryview(message.body or b""))
        except error:
            raise ValueError("it ends within what it says of itself") from None
    return size


def _size(metadata: memoryview, body: memoryview) -> int:
    message = _Table(metadata, _U32.unpack_from(metadata)[0])
    if message.number(0, _U16) != LATEST:
        raise ValueError("it is in another version of the format")
    kind = message.number(1, _I8)
    rows = message.table(2)
    if kind == _DICTIONARY and rows:
        rows = rows.table(1)
    if kind not in (_DICTIONARY, _RECORD_BATCH) or not rows:
        return 0
    is_compressed = rows.table(3) is not None
    size = 0
    for place, length in rows.pairs(2):
        if place < 0 or length < 0 or place + length > len(body):
            raise ValueError("a buffer lies beyond its end")
        declared = _I64.unpack_from(body, place)[0] if is_compressed and length else _NOT_COMPRESSED
        if declared < _NOT_COMPRESSED:
            raise ValueError("a buffer has a size below 0")
        size += length if declared == _NOT_COMPRESSED else declared
    return size


class _Table:
    """A table of a flatbuffer."""

    def __init__(self, data: memoryview, place: int) -> None:
        self._data = data
        self._place = place
        self._fields = place - _I32.unpack_from(data, place)[0]
        self._length: int = _U16.unpack_from(data, self._fields)[0]

    def _field(self, number: int) -> int:
        """Return the place of a field, 0 for one that is not there."""
        entry = 4 + 2 * number
        offset = _U16.unpack_from(self._data, self._fields + entry)[0] if entry < self._length else 0
        return self._place + offset if offset else 0

    def number(self, number: int, kind: Struct) -> int:
        place = self._field(number)
        return int(kind.unpack_from(self._data, place)[0]) if place else 0

    def table(self, number: int) -> _Table | None:
        place = self._field(number)
        return _Table(self._data, place + _U32.unpack_from(self._data, place)[0]) if place else None

    def pairs(self, number: int) -> Any:
        """Return a list of pairs of numbers."""
        place = self._field(number)
        if not place:
            return ()
        place += _U32.unpack_from(self._data, place)[0]
        count = _U32.unpack_from(self._data, place)[0]
        begin = place + _U32.size
        return _BUFFER.iter_unpack(self._data[begin : begin + count * _BUFFER.size])
