"""Columns of numbers in the core's own memory, made of replies."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from enum import IntEnum
from functools import cached_property, lru_cache
from itertools import accumulate
from struct import calcsize
from typing import Any, Literal, NamedTuple

from multidrop._core import ffi, lib


class NumberFormat(IntEnum):
    """The format of a number in a reply's data; words are big-endian, SWAPPED has the low word first."""

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


def raw_value(data: bytes, at: int, number_format: NumberFormat) -> float:
    """Read the number at word (BIT: bit) `at` of a reply's data; NaN where the data ends before it."""
    return float(lib.md_value(data, len(data), at, number_format))


class Field(NamedTuple):
    """A register's place in a block's reply, its scale, and the code of its name."""

    at: int
    number_format: NumberFormat
    register: int
    multiplier: float
    divisor: float


@lru_cache(maxsize=1024)
def _shared(fields: tuple[Field, ...]) -> Any:
    """Return one array for all drives of a kind: it stays in the processor's cache."""
    return ffi.new("struct md_field[]", fields)


class RowLayout:
    """The fields of one exchange's reply, of a drive given by the code of its name (struct md_block)."""

    def __init__(self, drive: int, fields: Sequence[Field]) -> None:
        self._fields = _shared(tuple(fields))
        self.c = ffi.new("struct md_block *", {"fields": self._fields, "count": len(fields), "drive": drive})
        self.count = len(fields)

    @property
    def refusals(self) -> int:
        """Exceptions in a row."""
        return int(self.c.refusals)

    @refusals.setter
    def refusals(self, count: int) -> None:
        self.c.refusals = count

    @property
    def refusal(self) -> int:
        """The last exception's code."""
        return int(self.c.refusal)

    @property
    def failures(self) -> int:
        """Exchanges in a row without a reply, or with a bad one."""
        return int(self.c.failures)

    @property
    def is_answered(self) -> bool:
        """True once a good reply came that was no exception."""
        return bool(self.c.is_answered)

    def forget(self) -> None:
        """Begin as if nothing had been asked."""
        self.c.refusals = self.c.failures = self.c.is_answered = 0


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
        """Return columns that the core made, and give them back when nobody looks at them any more."""
        columns = cls.__new__(cls)
        columns._own(made, give_back)
        return columns

    def _own(self, made: Any, give_back: Callable[[Any], object]) -> None:
        if made == ffi.NULL:
            raise MemoryError("no memory for rows")
        self.c = ffi.gc(made, give_back)

    def __len__(self) -> int:
        return int(self.c.rows)

    def _at(self, name: str) -> int:
        """Return the offset of a column from the struct."""
        return int(ffi.cast("uint8_t *", getattr(self.c, name)) - ffi.cast("uint8_t *", self.c))

    @cached_property
    def _memory(self) -> memoryview[Any]:
        """The struct and all columns: one piece, which lives as long as any view of it."""
        return memoryview(ffi.buffer(self.c, self._at("valid") + (self.c.room + 7) // 8))

    def array(self, name: str) -> memoryview[Any]:
        """Return a column's numbers, without a copy; `valid` is a bitmap, least significant bit first."""
        rows, at = len(self), self._at(name)
        if name == "valid":
            return self._memory[at : at + (rows + 7) // 8]
        kind = COLUMNS[name]
        return self._memory[at : at + rows * calcsize(kind)].cast(kind)


class Spelling(NamedTuple):
    """Names as one text."""

    names: int
    longest: int
    text: bytes
    ends: Any  # int32_t[]: the beginning of each, and the end of the last


class Names:
    """Names, whose numbers columns hold. They only become more: a number's name never changes."""

    def __init__(self, names: Iterable[str] = ()) -> None:
        self._names = list(names)
        self._numbers = {name: number for number, name in enumerate(self._names)}
        self._spelling = self._spell()

    def number(self, name: str) -> int:
        """Return the name's number; a new name gets the next one."""
        found = self._numbers.setdefault(name, len(self._names))
        if found == len(self._names):
            self._names.append(name)
        return found

    def __getitem__(self, number: int) -> str:
        return self._names[number]

    def __len__(self) -> int:
        return len(self._names)

    def _spell(self) -> Spelling:
        encoded = [name.encode() for name in self._names]
        ends = [0, *accumulate(map(len, encoded))]
        longest = max(map(len, encoded), default=0)
        return Spelling(len(encoded), longest, b"".join(encoded), ffi.new("int32_t[]", ends))

    @property
    def spelling(self) -> Spelling:
        if self._spelling.names != len(self._names):
            self._spelling = self._spell()
        return self._spelling


def spell(codes: memoryview[Any], names: Names) -> tuple[memoryview[Any], memoryview[Any]]:
    """Return offsets (int32) and text of an Arrow utf8 column with the name of each code.

    ValueError for a code without a name.
    """
    known = names.spelling
    rows = len(codes)
    room = rows * known.longest
    offsets, text = ffi.new("int32_t[]", rows + 1), ffi.new("uint8_t[]", max(room, 1))
    used = lib.md_spell(
        ffi.from_buffer("uint16_t[]", codes), rows, known.text, known.ends, known.names, offsets, text, room
    )
    if used < 0:
        raise ValueError("a code without a name, or more than 2 GiB of names in one batch")
    return memoryview(ffi.buffer(offsets)).cast("i"), memoryview(ffi.buffer(text, used))
