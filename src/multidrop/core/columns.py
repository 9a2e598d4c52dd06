"""Columns of rows in the C core's memory, and their conversion to the columns of recordings."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from enum import IntEnum
from functools import cached_property, lru_cache
from itertools import accumulate
from operator import attrgetter
from struct import calcsize
from typing import Any, Literal, NamedTuple, cast

from multidrop._core import ffi, lib
from multidrop.core.memory import new_beside


def number_at(path: str) -> int:
    """Return a property that reads a number in a C struct at this path, such as "c.error"."""
    return cast(int, property(attrgetter(path)))


def flag_at(path: str) -> bool:
    """Return a property that reads a number in a C struct at this path, as a bool."""
    read = attrgetter(path)
    return cast(bool, property(lambda owner: bool(read(owner))))


class NumberFormat(IntEnum):
    """The format of a number in a reply's data, most significant byte first unless an order flag is added."""

    U16 = lib.MD_U16
    I16 = lib.MD_I16
    U32 = lib.MD_U32
    I32 = lib.MD_I32
    U32_EITHER = lib.MD_U32_EITHER
    F32 = lib.MD_F32
    BIT = lib.MD_BIT
    I8 = lib.MD_I8  # the low byte of a 16-bit word
    U64 = lib.MD_U64
    I64 = lib.MD_I64
    F64 = lib.MD_F64
    BCD16 = lib.MD_BCD16
    BCD32 = lib.MD_BCD32
    F16 = lib.MD_F16


LOW_WORD_FIRST: int = lib.MD_LOW_WORD_FIRST  # order flag: least significant 16-bit word first
LOW_BYTE_FIRST: int = lib.MD_LOW_BYTE_FIRST  # order flag: least significant byte first in each word
MOST_INVALID: int = lib.MD_MOST_INVALID

_MAY_LACK = frozenset(
    {*(NumberFormat.F16, NumberFormat.F32, NumberFormat.F64), *(NumberFormat.BCD16, NumberFormat.BCD32)}
)


def raw_value(data: bytes, at: int, number_format: int) -> float:
    """Return one number from a reply's data; NaN if the data is too short.

    `at` is the index of the number's first 16-bit word, or of the bit if the format is BIT. `number_format`
    includes the order flags.
    """
    return float(lib.md_value(data, len(data), at, number_format))


class Extra(NamedTuple):
    """Rare properties of a field (struct md_extra); its value is (raw * multiplier + addend) / divisor."""

    addend: float = 0.0
    low: int = 0  # index of the field's lowest bit within the raw number
    bits: int = 0  # number of the field's bits; 0: all bits of the raw number
    scale_at: int | None = None  # index in the reply of the 16-bit word with the decimal exponent
    scale_format: int = NumberFormat.I16  # format of that word; the exponent is always read as signed
    invalid: tuple[tuple[int, int], ...] = ()  # pairs of mask and bit pattern that mean "no value"
    scale_invalid: tuple[tuple[int, int], ...] = ()

    @property
    def may_lack(self) -> bool:
        """True if the field may have no value in a good reply."""
        return bool(self.invalid) or self.scale_at is not None


class Field(NamedTuple):
    """How to decode one register: its place in a reply, its scale, and the code of its name."""

    at: int
    number_format: int  # a NumberFormat, plus order flags
    register: int
    multiplier: float
    divisor: float
    extra: Extra | None = None

    @property
    def may_lack(self) -> bool:
        may = self.number_format & (LOW_WORD_FIRST - 1) in _MAY_LACK
        return may or (self.extra is not None and self.extra.may_lack)


@lru_cache(maxsize=1024)
def _shared(fields: tuple[Field, ...]) -> tuple[Any, Any]:
    """Return C arrays of the fields and their `Extra`s, cached because all drives of a model share them."""
    extras = list(dict.fromkeys(field.extra for field in fields if field.extra is not None))
    places = {extra: place for place, extra in enumerate(extras, 1)}
    return (
        ffi.new("struct md_field[]", [(*f[:3], places[f.extra] if f.extra else 0, *f[3:5]) for f in fields]),
        ffi.new("struct md_extra[]", list(map(_packed, extras))),
    )


def _packed(extra: Extra) -> dict[str, Any]:
    return {
        "addend": extra.addend,
        "low": extra.low,
        "bits": extra.bits,
        "has_scale": extra.scale_at is not None,
        "scale_at": extra.scale_at or 0,
        "scale_format": extra.scale_format,
        "invalid_count": len(extra.invalid),
        "scale_invalid_count": len(extra.scale_invalid),
        "invalid": [*extra.invalid, *extra.scale_invalid],
    }


class RowLayout:
    """The fields in the reply to one request. `drive` is the number (code) of the drive's name."""

    def __init__(self, drive: int, fields: Sequence[Field]) -> None:
        self._fields, self._extra = _shared(tuple(fields))
        self.c, self._memory = new_beside(
            "struct md_block",
            {
                "fields": self._fields,
                "extra": self._extra,
                "count": len(fields),
                "may_lack": any(field.may_lack for field in fields),
                "drive": drive,
            },
        )
        self.count = len(fields)

    @property
    def refusals(self) -> int:
        """How many times in a row the drive has answered this read with an exception."""
        return int(self.c.refusals)

    @refusals.setter
    def refusals(self, count: int) -> None:
        self.c.refusals = count

    refusal = number_at("c.refusal")  # exception code of the drive's newest refusal
    failures = number_at("c.failures")  # number of consecutive exchanges without a good reply
    is_answered = flag_at("c.is_answered")  # whether a good reply has come so far, not only exceptions

    def forget(self) -> None:
        """Reset `refusals`, `failures` and `is_answered`, as before the first exchange."""
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
    """Rows in the C core's own memory, as one array per column (struct md_columns)."""

    def __init__(self, room: int) -> None:
        self._own(lib.md_columns_new(room), lib.md_columns_free)

    @classmethod
    def lent(cls, made: Any, give_back: Callable[[Any], object]) -> Columns:
        """Return columns in the memory `made`. When all its views are freed, call `give_back(made)`."""
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
        """Return the offset in bytes from the start of the struct to this column."""
        return int(ffi.cast("uint8_t *", getattr(self.c, name)) - ffi.cast("uint8_t *", self.c))

    @cached_property
    def _memory(self) -> memoryview[Any]:
        """A buffer over the struct and all columns, whose memory lives as long as any view of the buffer."""
        return memoryview(ffi.buffer(self.c, self._at("valid") + (self.c.room + 7) // 8))

    def array(self, name: str) -> memoryview[Any]:
        """Return a view of a column. The column `valid` is a bitmap, least significant bit first."""
        rows, at = len(self), self._at(name)
        if name == "valid":
            return self._memory[at : at + (rows + 7) // 8]
        kind = COLUMNS[name]
        return self._memory[at : at + rows * calcsize(kind)].cast(kind)


class Spelling(NamedTuple):
    """Names joined into one text, from which the C core builds Arrow utf8 columns."""

    names: int
    longest: int
    text: bytes
    ends: Any  # int32_t[]: the start of each name in the text, and the end of the last name


class Names:
    """Names, and their numbers (codes) in columns. A name is never removed."""

    def __init__(self, names: Iterable[str] = ()) -> None:
        self._names = list(names)
        self._numbers = {name: number for number, name in enumerate(self._names)}
        self._listed = tuple(self._names)
        self._spelling = self._spell()

    def number(self, name: str) -> int:
        """Return the name's number; a new name gets the next number."""
        found = self._numbers.setdefault(name, len(self._names))
        if found == len(self._names):
            self._names.append(name)
        return found

    def __getitem__(self, number: int) -> str:
        return self._names[number]

    def __len__(self) -> int:
        return len(self._names)

    @property
    def listed(self) -> tuple[str, ...]:
        """All names in the order of their numbers; the same tuple object until a name is added."""
        if len(self._listed) != len(self._names):
            self._listed = tuple(self._names)
        return self._listed

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

    Raises ValueError if a code has no name.
    """
    known = names.spelling
    rows = len(codes)
    room = rows * known.longest
    offsets, text = ffi.new("int32_t[]", rows + 1), ffi.new("uint8_t[]", max(room, 1))
    used = lib.md_spell(
        ffi.from_buffer("uint16_t[]", codes), rows, known.text, known.ends, known.names, offsets, text, room
    )
    if used < 0:
        raise ValueError("a row has a code without a name, or the names of one batch have more than 2 GiB")
    return memoryview(ffi.buffer(offsets)).cast("i"), memoryview(ffi.buffer(text, used))


MOST_NARROW = 256  # number of names that one-byte codes can distinguish


class CodeTable:
    """Translates two-byte codes of names into one-byte codes, assigned in the order of first use."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self._numbers = ffi.new("int16_t[]", [-1] * len(names))
        self.used: tuple[str, ...] = ()

    def forget(self) -> None:
        self._numbers[0 : len(self._names)] = [-1] * len(self._names)
        self.used = ()

    def know(self, names: Sequence[str]) -> None:
        """Add the new names in `names`, which starts with the names that are already known."""
        if len(names) > len(self._names):
            known = [self._numbers[at] for at in range(len(self._names))]
            self._numbers = ffi.new("int16_t[]", [*known, *[-1] * (len(names) - len(known))])
            self._names = names

    def narrow(self, codes: memoryview[Any]) -> memoryview[Any] | None:
        """Return the one-byte code of each two-byte code; None if one byte cannot distinguish all used codes.

        Raises ValueError if a code has no name.
        """
        given, rows = _copy("uint16_t[]", codes, 2), len(codes)
        out = ffi.new("uint8_t[]", max(rows, 1))
        while (at := lib.md_narrow_codes(given, rows, self._numbers, len(self._names), out)) < rows:
            if given[at] >= len(self._names):
                raise ValueError(f"status {given[at]} has no name")
            if len(self.used) == MOST_NARROW:
                return None
            self._numbers[given[at]] = len(self.used)
            self.used = (*self.used, self._names[given[at]])
        return memoryview(ffi.buffer(out, rows))


def _copy(kind: str, column: bytes | memoryview[Any], size: int) -> Any:
    """Return a column read from a file as an aligned C array; in the file it may not be aligned."""
    made = ffi.new(kind, max(memoryview(column).nbytes // size, 1))
    ffi.memmove(made, column, memoryview(column).nbytes)
    return made


def narrow_up(numbers: memoryview[Any]) -> memoryview[Any]:
    """Return int64 numbers as float32, rounded up."""
    rows = len(numbers)
    out = ffi.new("float[]", max(rows, 1))
    lib.md_narrow_up(ffi.from_buffer("int64_t[]", numbers), rows, out)
    return memoryview(ffi.buffer(out, 4 * rows))


def widen(
    numbers: bytes | memoryview[Any], valid: bytes | memoryview[Any] | None, rows: int
) -> memoryview[Any]:
    """Return float32 numbers as int64. Numbers whose bit in the bitmap `valid` is 0 become 0.

    Raises ValueError if a number is not finite or too large.
    """
    if len(numbers) < 4 * rows or (valid is not None and len(valid) < (rows + 7) // 8):
        raise ValueError("the stated length of a column does not match its data")
    out = ffi.new("int64_t[]", max(rows, 1))
    bits = ffi.NULL if valid is None else ffi.from_buffer("uint8_t[]", valid)
    if lib.md_widen(_copy("float[]", numbers[: 4 * rows], 4), bits, rows, out):
        raise ValueError("an uncertainty is not a finite number that fits int64")
    return memoryview(ffi.buffer(out, 8 * rows))


def wide_codes(codes: bytes | memoryview[Any], rows: int, size: int) -> memoryview[Any]:
    """Return codes of `size` bytes (1 or 2) as uint16."""
    if len(codes) < rows * size:
        raise ValueError("the stated length of a column does not match its data")
    if size == 2:
        out = _copy("uint16_t[]", codes[: 2 * rows], 2)
    else:
        out = ffi.new("uint16_t[]", max(rows, 1))
        lib.md_widen_codes(ffi.from_buffer("uint8_t[]", codes), rows, out)
    return memoryview(ffi.buffer(out, 2 * rows)).cast("H")


def greatest_code(codes: memoryview[Any]) -> int:
    """Return the greatest of the uint16 codes; 0 if there are none."""
    return int(lib.md_greatest_code(ffi.from_buffer("uint16_t[]", codes), len(codes)))


def find_codes(
    drives: memoryview[Any], registers: memoryview[Any], series: Iterable[tuple[int, int]]
) -> list[int]:
    """Return the sorted indexes of the rows whose pair of codes (drive, register) is in `series`."""
    rows = len(drives)
    given = ffi.from_buffer("uint16_t[]", drives), ffi.from_buffer("uint16_t[]", registers), rows
    out, found = ffi.new("uint32_t[]", max(rows, 1)), list[int]()
    for drive, register in series:
        found += ffi.unpack(out, lib.md_find_codes(*given, drive, register, out))
    return sorted(found)
