"""What replies hold, as columns of numbers in the core's own memory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import IntEnum
from functools import lru_cache
from itertools import accumulate
from struct import calcsize
from typing import Any, Literal, NamedTuple

from multidrop._core import ffi, lib
from multidrop.core.results import Result


class Wire(IntEnum):
    """How a number lies in a reply's data; words are big-endian, SWAPPED has the low word first."""

    U16 = lib.MD_U16
    I16 = lib.MD_I16
    U32 = lib.MD_U32
    I32 = lib.MD_I32
    U32_SWAPPED = lib.MD_U32_SWAPPED
    I32_SWAPPED = lib.MD_I32_SWAPPED
    U32_EITHER = lib.MD_U32_EITHER
    F32 = lib.MD_F32
    F32_SWAPPED = lib.MD_F32_SWAPPED
    BIT = lib.MD_BIT


def raw_value(data: bytes, at: int, wire: Wire) -> float:
    """The number at word (BIT: bit) `at` of a reply's data; NaN where the data ends before it."""
    return float(lib.md_value(data, len(data), at, wire))


class Field(NamedTuple):
    """Where a register lies in a block's reply, its scale, and the code of its name."""

    at: int
    wire: Wire
    register: int
    multiplier: float
    divisor: float


@lru_cache(maxsize=1024)
def _shared(fields: tuple[Field, ...]) -> Any:
    """One array for all drives of a kind: the core goes through it faster than through many."""
    return ffi.new("struct md_field[]", fields)


class Block:
    """What one exchange's reply holds: fields of a drive, given by the code of its name (struct md_block)."""

    def __init__(self, drive: int, fields: Sequence[Field]) -> None:
        self._fields = _shared(tuple(fields))
        self.c = ffi.new("struct md_block *", {"fields": self._fields, "count": len(fields), "drive": drive})
        self.count = len(fields)

    @property
    def refusals(self) -> int:
        """Exceptions in a row, among the replies that were made rows of."""
        return int(self.c.refusals)


COLUMNS: dict[str, Literal["q", "H", "d"]] = {
    "time": "q",
    "sent": "q",
    "uncertainty": "q",
    "drive": "H",
    "reg": "H",
    "status": "H",
    "value": "d",
}


class Columns:
    """Rows in the core's own memory: one array a column (struct md_columns)."""

    def __init__(self, room: int) -> None:
        self._own(lib.md_columns_new(room), lib.md_columns_free)

    @classmethod
    def lent(cls, made: Any, give_back: Callable[[Any], object]) -> Columns:
        """What the core made, until nobody looks at it any more."""
        columns = cls.__new__(cls)
        columns._own(made, give_back)
        return columns

    def _own(self, made: Any, give_back: Callable[[Any], object]) -> None:
        if made == ffi.NULL:
            raise MemoryError("no memory for rows")
        self.c = ffi.gc(made, give_back)
        first = ffi.cast("uint8_t *", made)
        self._at = {name: ffi.cast("uint8_t *", getattr(made, name)) - first for name in (*COLUMNS, "valid")}
        # One piece, which is there for as long as any view of it.
        self._memory = memoryview(ffi.buffer(self.c, self._at["valid"] + (made.room + 7) // 8))

    def __len__(self) -> int:
        return int(self.c.rows)

    def add(self, block: Block, found: Any, utc_minus_monotonic_ns: int) -> bool:
        """Append the rows of one struct md_completion; False when there is no room for all of them."""
        return bool(lib.md_columns_add(self.c, block.c, found, utc_minus_monotonic_ns))

    def add_miss(self, block: Block, result: Result, due_ns: int, utc_minus_monotonic_ns: int) -> bool:
        """Append rows for values that were due at `due_ns` but never asked for."""
        return bool(lib.md_columns_add(self.c, block.c, miss(result, due_ns), utc_minus_monotonic_ns))

    def clear(self) -> None:
        """Forget all rows."""
        self.c.rows = 0

    def array(self, name: str) -> memoryview[Any]:
        """A column's numbers, without a copy; `valid` is a bitmap, least significant bit first."""
        rows, at = len(self), self._at[name]
        if name == "valid":
            return self._memory[at : at + (rows + 7) // 8]
        kind = COLUMNS[name]
        return self._memory[at : at + rows * calcsize(kind)].cast(kind)


def miss(result: Result, due_ns: int) -> Any:
    """What became of an exchange that was due and never asked for (struct md_completion)."""
    return ffi.new("struct md_completion *", {"result": result, "begun_ns": due_ns})


@lru_cache(maxsize=64)
def _spelling(names: tuple[str, ...]) -> tuple[bytes, Any, int]:
    """All names as one text, where each begins and the last ends, and the longest one's length."""
    encoded = [name.encode() for name in names]
    ends = [0, *accumulate(map(len, encoded))]
    return b"".join(encoded), ffi.new("int32_t[]", ends), max(map(len, encoded), default=0)


def spell(codes: memoryview[Any], names: tuple[str, ...]) -> tuple[memoryview[Any], memoryview[Any]]:
    """Offsets (int32) and text of an Arrow utf8 column that has names[code] for each of `codes`."""
    known, ends, longest = _spelling(names)
    rows = len(codes)
    room = rows * longest
    offsets, text = ffi.new("int32_t[]", rows + 1), ffi.new("uint8_t[]", max(room, 1))
    used = lib.md_spell(
        ffi.from_buffer("uint16_t[]", codes), rows, known, ends, len(names), offsets, text, room
    )
    if used < 0:
        raise ValueError("a code without a name, or more than 2 GiB of names in one batch")
    return memoryview(ffi.buffer(offsets)).cast("i"), memoryview(ffi.buffer(text, used))
