"""Columns as recordings hold them: bounds rounded up, codes of a byte."""

from __future__ import annotations

import struct
from array import array
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from multidrop.core.columns import CodeTable, find_codes, greatest_code, narrow_up, wide_codes, widen

EDGES = [0, 1, -1, 2**24, 2**24 + 1, 2**53 + 1, 2**63 - 1, -(2**63), -(2**63) + 1, 2**63 - 2**38]


def as_float32(bits: int) -> Fraction:
    return Fraction(*struct.unpack("<f", struct.pack("<I", bits))[0].as_integer_ratio())


@given(st.lists(st.one_of(st.integers(-(2**63), 2**63 - 1), st.sampled_from(EDGES)), max_size=9))
def test_a_bound_is_the_least_float_that_is_no_less(numbers: list[int]) -> None:
    """Neighbours of a float are those of its bits (IEEE 754)."""
    narrow = bytes(narrow_up(memoryview(array("q", numbers))))
    for number, bits in zip(numbers, struct.unpack(f"<{len(numbers)}I", narrow), strict=True):
        found = as_float32(bits)
        assert found >= number
        if number == 0:
            assert bits == 0
        else:
            assert as_float32(bits - 1 if number > 0 else bits + 1) < number
    wide = widen(memoryview(narrow), None, len(numbers)).cast("q")
    for number, found in zip(numbers, wide, strict=True):
        assert number <= found <= number + abs(number) // 2**23


def test_only_valid_numbers_are_read() -> None:
    floats = struct.pack("<4f", 7.0, float("nan"), float("inf"), 1e30)
    assert list(widen(memoryview(floats), memoryview(b"\x01"), 4).cast("q")) == [7, 0, 0, 0]
    for bit in (2, 4, 8):
        with pytest.raises(ValueError, match="an uncertainty is no number"):
            widen(memoryview(floats), memoryview(bytes([bit])), 4)
    for cut in (floats[:15], b""):
        with pytest.raises(ValueError, match="lengths do not fit"):
            widen(memoryview(cut), None, 4)
    with pytest.raises(ValueError, match="lengths do not fit"):
        widen(memoryview(floats), memoryview(b""), 4)


def test_codes_are_given_in_the_order_of_their_use() -> None:
    table = CodeTable([f"name {number}" for number in range(400)])
    assert bytes(table.narrow(memoryview(array("H", [9, 0, 9, 399]))) or b"") == bytes([0, 1, 0, 2])
    assert table.used == ("name 9", "name 0", "name 399")
    assert table.narrow(memoryview(array("H", range(256)))) is None  # 257 with the one before
    table.forget()
    assert bytes(table.narrow(memoryview(array("H", range(256)))) or b"") == bytes(range(256))
    with pytest.raises(ValueError, match="a status 400 without a name"):
        table.narrow(memoryview(array("H", [400])))


def test_codes_are_widened() -> None:
    assert list(wide_codes(memoryview(bytes([0, 255, 7])), 3, 1)) == [0, 255, 7]
    assert list(wide_codes(memoryview(b"x" + struct.pack("=2H", 1, 65535))[1:], 2, 2)) == [1, 65535]
    with pytest.raises(ValueError, match="lengths do not fit"):
        wide_codes(memoryview(b"123"), 2, 2)


codes = st.integers(0, 65535)


@given(st.lists(codes))
def test_the_greatest_code_is_found(given_codes: list[int]) -> None:
    assert greatest_code(memoryview(array("H", given_codes))) == max(given_codes, default=0)


@given(st.lists(st.tuples(codes, codes) | st.just((7, 65535))), st.frozensets(st.tuples(codes, codes)))
def test_rows_are_found_by_their_codes(
    rows: list[tuple[int, int]], others: frozenset[tuple[int, int]]
) -> None:
    wanted = frozenset({(7, 65535), *rows[::3], *others})
    drives, registers = (memoryview(array("H", [row[side] for row in rows])) for side in (0, 1))
    assert find_codes(drives, registers, wanted) == [at for at, row in enumerate(rows) if row in wanted]
    assert find_codes(drives, registers, ()) == []
