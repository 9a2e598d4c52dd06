"""Build flatbuffers, of which Arrow's messages are made.

A table is a dict by field number; its values are numbers with their format, such as ("<q", 7), tables,
vectors of tables (lists), texts (bytes), and vectors of structs of two int64 (Structs).
"""

from __future__ import annotations

import struct
from collections import deque
from typing import Any

Table = dict[int, Any]
_OFFSET = ("<I", 0)  # of what is written later


class Structs(bytes):
    """A vector of structs, which take 16 bytes each."""


def build(root: Table) -> bytes:
    """Return the flatbuffer of this table."""
    out = bytearray(4)
    waiting: deque[tuple[int, Any]] = deque([(0, root)])  # with the place of the offset to it
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
    """Fill up so that what comes `ahead` bytes later is aligned."""
    out += bytes(-(len(out) + ahead) % size)


def _put_table(out: bytearray, table: Table, waiting: deque[tuple[int, Any]]) -> int:
    """Put the vtable and then the table: its larger fields first, so that all are aligned."""
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
