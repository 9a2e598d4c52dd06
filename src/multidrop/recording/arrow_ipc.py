"""The messages of an Arrow IPC stream.

No number in the file is trusted: a damaged file ends in an error, not in a crash. Fields have the
numbers of Arrow's format/Message.fbs and format/Schema.fbs.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

PREFIX = struct.Struct("<4si")  # the continuation marker, and the length of the metadata
CONTINUATION = b"\xff\xff\xff\xff"
SCHEMA, DICTIONARY_BATCH, RECORD_BATCH = 1, 2, 3  # IpcMessage.header_type


class FlatTable:
    """A flatbuffer's table; fields are found by their number, and an absent one is 0 or empty."""

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
        """Return a vector of structs of two int64."""
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
    """One whole message: its header, and the places in the file where its body begins and ends."""

    kind: int
    header: FlatTable | None
    body: int
    end: int


def messages(file: BinaryIO, size: int, begin: int = 0) -> Iterator[IpcMessage]:
    """Yield the messages from `begin` to `size`, up to the first that is truncated or invalid."""
    end = begin
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
    if length == 0:  # the end marker
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
