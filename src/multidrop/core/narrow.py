"""Columns as recordings hold them: times as floats of four bytes, codes of one byte."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from multidrop._core import ffi, lib

MOST_NARROW = 256  # names whose codes take a byte


class CodeTable:
    """Codes of one byte for names whose own codes take two, given in the order of their first use."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self._numbers = ffi.new("int16_t[]", [-1] * len(names))
        self.used: tuple[str, ...] = ()

    def forget(self) -> None:
        """Give codes anew."""
        self._numbers[0 : len(self._names)] = [-1] * len(self._names)
        self.used = ()

    def narrow(self, codes: memoryview[Any]) -> memoryview[Any] | None:
        """Return each code as a byte; None where there are more names than a byte has values.

        Raises ValueError for a code without a name.
        """
        given, rows = _copy("uint16_t[]", codes, 2), len(codes)
        out = ffi.new("uint8_t[]", max(rows, 1))
        while (at := lib.md_narrow_codes(given, rows, self._numbers, len(self._names), out)) < rows:
            if given[at] >= len(self._names):
                raise ValueError(f"there is a status {given[at]} without a name")
            if len(self.used) == MOST_NARROW:
                return None
            self._numbers[given[at]] = len(self.used)
            self.used = (*self.used, self._names[given[at]])
        return memoryview(ffi.buffer(out, rows))


def _copy(kind: str, column: bytes | memoryview[Any], size: int) -> Any:
    """Return a copy of a column as an array: its place in a file may not be aligned."""
    made = ffi.new(kind, max(memoryview(column).nbytes // size, 1))
    ffi.memmove(made, column, memoryview(column).nbytes)
    return made


def narrow_up(numbers: memoryview[Any]) -> memoryview[Any]:
    """Return int64 numbers as float32, each the next one that is no less."""
    rows = len(numbers)
    out = ffi.new("float[]", max(rows, 1))
    lib.md_narrow_up(ffi.from_buffer("int64_t[]", numbers), rows, out)
    return memoryview(ffi.buffer(out, 4 * rows))


def widen(
    numbers: bytes | memoryview[Any], valid: bytes | memoryview[Any] | None, rows: int
) -> memoryview[Any]:
    """Return float32 numbers as int64, 0 where there is none; ValueError for one that is beyond them."""
    if len(numbers) < 4 * rows or (valid is not None and len(valid) < (rows + 7) // 8):
        raise ValueError("its lengths do not fit together")
    out = ffi.new("int64_t[]", max(rows, 1))
    bits = ffi.NULL if valid is None else ffi.from_buffer("uint8_t[]", valid)
    if lib.md_widen(_copy("float[]", numbers[: 4 * rows], 4), bits, rows, out):
        raise ValueError("an uncertainty is no number")
    return memoryview(ffi.buffer(out, 8 * rows))


def wide_codes(codes: bytes | memoryview[Any], rows: int, size: int) -> memoryview[Any]:
    """Return codes of so many bytes as uint16."""
    if len(codes) < rows * size:
        raise ValueError("its lengths do not fit together")
    if size == 2:
        out = _copy("uint16_t[]", codes[: 2 * rows], 2)
    else:
        out = ffi.new("uint16_t[]", max(rows, 1))
        lib.md_widen_codes(ffi.from_buffer("uint8_t[]", codes), rows, out)
    return memoryview(ffi.buffer(out, 2 * rows)).cast("H")


def greatest_code(codes: memoryview[Any]) -> int:
    """Return the greatest of uint16 codes; 0 where there are none."""
    return int(lib.md_greatest_code(ffi.from_buffer("uint16_t[]", codes), len(codes)))


def find_codes(
    drives: memoryview[Any], registers: memoryview[Any], series: Iterable[tuple[int, int]]
) -> list[int]:
    """Return the places of the rows that have one of these pairs of codes, in their order."""
    rows = len(drives)
    given = ffi.from_buffer("uint16_t[]", drives), ffi.from_buffer("uint16_t[]", registers), rows
    out, found = ffi.new("uint32_t[]", max(rows, 1)), list[int]()
    for drive, register in series:
        found += ffi.unpack(out, lib.md_find_codes(*given, drive, register, out))
    return sorted(found)
