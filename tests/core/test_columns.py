"""Columns that the C core fills from replies: number formats, scales, missing values and capacity."""

from __future__ import annotations

import math
import struct
import sys
from array import array
from fractions import Fraction
from itertools import pairwise
from struct import iter_unpack
from typing import Any

import pytest
from batches import add_miss, add_rows
from frames import words
from hypothesis import given
from hypothesis import strategies as st
from line_driver import MS, LineDriver
from tables import table

from multidrop.core import (
    EXCEPTION_STATUS,
    LOW_BYTE_FIRST,
    LOW_WORD_FIRST,
    STATUSES,
    Columns,
    Exchange,
    Field,
    Framing,
    Message,
    Names,
    NumberFormat,
    Peer,
    RowLayout,
    RowQueue,
    Status,
    build_reply,
    raw_value,
    spell,
)
from multidrop.core.columns import (
    CodeTable,
    find_codes,
    greatest_code,
    narrow_up,
    wide_codes,
    widen,
)

UTC = 1_700_000_000_000_000_000  # ns; UTC - CLOCK_MONOTONIC

NUMBERS = [
    (NumberFormat.U16, "FF FE", 65534),
    (NumberFormat.I16, "FF FE", -2),
    (NumberFormat.U32, "FF FF FF FE", 4294967294),
    (NumberFormat.I32, "FF FF FF FE", -2),
    (NumberFormat.U32 | LOW_WORD_FIRST, "00 01 00 02", 0x20001),
    (NumberFormat.I32 | LOW_WORD_FIRST, "FF FE FF FF", -2),
    (NumberFormat.U32_EITHER, "00 00 02 00", 512),
    (NumberFormat.U32_EITHER, "02 00 00 00", 512),
    (NumberFormat.F32, "42 47 00 00", 49.75),
    (NumberFormat.F32 | LOW_WORD_FIRST, "00 00 42 47", 49.75),
    (NumberFormat.F32 | LOW_BYTE_FIRST, "47 42 00 00", 49.75),
    (NumberFormat.F32 | LOW_WORD_FIRST | LOW_BYTE_FIRST, "00 00 47 42", 49.75),
    (NumberFormat.U16 | LOW_BYTE_FIRST, "34 12", 0x1234),
    (NumberFormat.I8, "7F FE", -2),
    (NumberFormat.I8 | LOW_BYTE_FIRST, "FE 7F", -2),
    (NumberFormat.U64, "00 20 00 00 00 00 00 00", 2**53),
    (NumberFormat.I64, "FF FF FF FF FF FF FF FE", -2),
    (NumberFormat.I64 | LOW_WORD_FIRST, "FF FE FF FF FF FF FF FF", -2),
    (NumberFormat.F64, "40 48 E0 00 00 00 00 00", 49.75),
    (NumberFormat.F16, "52 38", 49.75),
    (NumberFormat.F16 | LOW_BYTE_FIRST, "38 52", 49.75),
    (NumberFormat.F16, "83 FF", -1023 / 2**24),  # subnormal
    (NumberFormat.F16, "FB FF", -65504),
    (NumberFormat.F16, "FC 00", -math.inf),
    (NumberFormat.BCD16, "12 34", 1234),
    (NumberFormat.BCD32, "98 76 54 32", 98765432),
    (NumberFormat.BIT, "01", 1),
]


@table(("wire", "data", "value"), NUMBERS)
def test_each_number_format_is_decoded_to_its_raw_value(wire: int, data: str, value: float) -> None:
    assert raw_value(bytes.fromhex(data), 0, wire) == value


def test_every_16_bit_float_is_decoded_as_by_struct() -> None:
    data = b"".join(bits.to_bytes(2) for bits in range(1 << 16))
    for at, (number,) in enumerate(iter_unpack(">e", data)):
        found = raw_value(data, at, NumberFormat.F16)
        assert found == number or (math.isnan(found) and math.isnan(number))
        assert math.copysign(1, found) == math.copysign(1, number) or math.isnan(number)


def test_the_list_of_tested_number_formats_is_complete() -> None:
    assert {wire & (LOW_WORD_FIRST - 1) for wire, _, _ in NUMBERS} == set(NumberFormat)


def test_the_first_coil_is_the_least_significant_bit_of_the_first_byte() -> None:
    """In the example of the application protocol V1.1b3, 6.1, the reply for coils 20 to 38 is CD 6B 05."""
    coils = [raw_value(bytes.fromhex("CD 6B 05"), at, NumberFormat.BIT) for at in range(19)]
    assert coils == [1, 0, 1, 1, 0, 0, 1, 1, 1, 1, 0, 1, 0, 1, 1, 0, 1, 0, 1]


@table("wire", list(NumberFormat))
def test_a_number_beyond_the_end_of_the_data_is_nan(wire: NumberFormat) -> None:
    for at in (8, 9, 2**15, sys.maxsize, sys.maxsize + 1, 2 * sys.maxsize + 1):
        assert math.isnan(raw_value(b"\xff", at, wire))
    assert math.isnan(raw_value(b"", 0, wire))


def completed(request: Message, received: bytes) -> Any:
    """Return the result of an exchange sent at 1000 ms, whose reply starts 30 ms later."""
    line = LineDriver()
    line.begin(
        Exchange(
            Framing.RTU,
            request,
            Peer(least_timeout=0.1, most_timeout=0.1),
            baudrate=9600,
            format="8N1",
            character=1e-6,
            silence=0,
        )
    )
    line.wait_until_write()
    line.now += 30 * MS
    line.receive(received)
    line.wait_until_done()
    return line.found


def reply(*values: int) -> Any:
    request = Message(1, 0x03, 0, len(values))
    return completed(request, build_reply(Framing.RTU, Message(1, 0x03, data=words(*values))))


def test_reply_gives_one_row_for_each_requested_register() -> None:
    block = RowLayout(
        5,
        [
            Field(0, NumberFormat.U16, register=50, multiplier=1, divisor=10),
            Field(2, NumberFormat.I16, register=51, multiplier=1, divisor=100),
            Field(1, NumberFormat.U32, register=52, multiplier=60, divisor=1),
        ],
    )
    columns = Columns(8)
    assert add_rows(columns, block, reply(3, 0xFFFF, 0xFF9C), UTC)
    assert len(columns) == 3
    sent = 1000 * MS
    assert list(columns.array("time")) == [UTC + sent] * 3
    assert list(columns.array("sent")) == [sent] * 3
    assert list(columns.array("uncertainty")) == [30 * MS - 10 * 1000] * 3
    assert list(columns.array("drive")) == [5, 5, 5]
    assert list(columns.array("reg")) == [50, 51, 52]
    assert list(columns.array("status")) == [0, 0, 0]
    assert list(columns.array("value")) == [0.3, -1.0, 0xFFFFFF9C * 60]
    assert columns.array("valid")[0] & 0b111 == 0b111


@table(("raw", "divisor"), [(3, 10), (7, 100), (5000, 100), (65535, 1000), (1, 3)])
def test_a_scaled_value_is_the_float_nearest_to_the_exact_result(raw: int, divisor: int) -> None:
    """Three steps of 0.1 give 0.3, not 0.30000000000000004."""
    columns = Columns(1)
    assert add_rows(columns, RowLayout(0, [Field(0, NumberFormat.U16, 0, 1, divisor)]), reply(raw), 0)
    assert columns.array("value")[0] == raw / divisor


ONE = RowLayout(1, [Field(0, NumberFormat.U16, 2, 1, 1)])


@table(
    ("received", "status", "text"),
    [
        (b"", Status.NO_REPLY, "no reply"),
        (b"\x01\x03", Status.CUT_SHORT, "reply cut short"),
        (b"\x01\x03\x02\x00\x00\x00\x00", Status.BAD_CHECKSUM, "bad checksum"),
        (build_reply(Framing.RTU, Message(1, 0x03, exception=0x12)), EXCEPTION_STATUS + 0x12, "exception 12"),
    ],
)
def test_a_missing_value_has_a_row_with_the_reason_as_status(received: bytes, status: int, text: str) -> None:
    columns = Columns(1)
    assert add_rows(columns, ONE, completed(Message(1, 0x03, 0, 1), received), UTC)
    assert list(columns.array("status")) == [status]
    assert STATUSES[columns.array("status")[0]] == text
    assert (columns.array("valid")[0] & 1, columns.array("value")[0]) == (0, 0.0)
    assert (columns.array("time")[0], columns.array("uncertainty")[0]) == (UTC + 1000 * MS, 0)


def test_row_is_added_for_a_due_value_that_was_not_requested() -> None:
    columns = Columns(2)
    assert add_miss(columns, ONE, Status.NOT_ASKED, 77 * MS, UTC)
    assert (columns.array("status")[0], columns.array("sent")[0]) == (Status.NOT_ASKED, 77 * MS)
    assert columns.array("valid")[0] & 1 == 0


def test_row_of_an_unsent_request_has_the_time_of_its_turn() -> None:
    line = LineDriver()
    line.now = 5000 * MS
    line.begin(
        Exchange(
            Framing.RTU,
            Message(1, 3, 0, 1),
            Peer(least_timeout=1, most_timeout=1),
            baudrate=9600,
            format="8N1",
            character=1e-3,
            silence=1,
        )
    )
    line.lose(5)
    columns = Columns(1)
    assert add_rows(columns, ONE, line.found, UTC)
    assert (columns.array("time")[0], columns.array("status")[0]) == (UTC + 5000 * MS, Status.LINE_LOST)


def test_row_has_no_value_if_the_reply_is_too_short_for_the_register() -> None:
    columns = Columns(2)
    block = RowLayout(1, [Field(0, NumberFormat.U16, 2, 1, 1), Field(1, NumberFormat.U16, 3, 1, 1)])
    assert add_rows(columns, block, reply(9), 0)
    assert list(columns.array("status")) == [0, Status.BAD_LENGTH]
    assert list(columns.array("value")) == [9, 0]


def test_the_bitmap_marks_rows_with_a_value() -> None:
    columns = Columns(20)
    good, bad = reply(1), completed(Message(1, 0x03, 0, 1), b"")
    pattern = [1, 0, 0, 1, 1, 1, 0, 1, 0, 0, 1, 1, 0, 1, 0, 1, 1, 0, 0, 1]
    for bit in pattern:
        assert add_rows(columns, ONE, good if bit else bad, 0)
    valid = columns.array("valid")
    assert [valid[at // 8] >> at % 8 & 1 for at in range(20)] == pattern


def test_reply_adds_no_row_if_the_columns_cannot_hold_all_rows() -> None:
    columns = Columns(3)
    two = RowLayout(1, [Field(0, NumberFormat.U16, 2, 1, 1), Field(1, NumberFormat.U16, 3, 1, 1)])
    answer = reply(1, 2)
    assert add_rows(columns, two, answer, 0)
    assert not add_rows(columns, two, answer, 0)
    assert len(columns) == 2
    assert add_rows(columns, ONE, answer, 0)
    assert not add_rows(columns, ONE, answer, 0)
    assert list(columns.array("value")) == [1, 2, 1]


def test_codes_of_a_column_are_converted_to_names() -> None:
    names = Names(["pump-1", "вентилятор", ""])
    offsets, text = spell(memoryview(array("H", [1, 0, 2, 1])), names)
    ends = list(offsets)
    found = [bytes(text[begin:end]).decode() for begin, end in pairwise(ends)]
    assert found == ["вентилятор", "pump-1", "", "вентилятор"]


def test_names_added_later_appear_in_the_text_column() -> None:
    names = Names()
    numbers = [names.number(name) for name in ("pump", "fan", "pump")]
    spell(memoryview(array("H", numbers)), names)
    numbers.append(names.number("насос"))
    _, text = spell(memoryview(array("H", numbers)), names)
    assert (numbers, bytes(text).decode()) == ([0, 1, 0, 2], "".join(["pump", "fan", "pump", "насос"]))


def test_an_empty_list_of_codes_gives_an_empty_column() -> None:
    offsets, text = spell(memoryview(array("H")), Names("a"))
    assert (list(offsets), bytes(text)) == ([0], b"")


BLOCK = RowLayout(0, [Field(0, NumberFormat.U16, register, 1.0, 1.0) for register in range(3)])


def test_missed_read_of_no_registers_adds_no_row() -> None:
    row_queue = RowQueue()
    row_queue.add_miss(RowLayout(0, []), Status.NOT_ASKED, 5)
    assert (row_queue.chunks, row_queue.dropped, row_queue.take()) == (0, 0, None)


def test_rows_are_counted_as_dropped_if_a_chunk_cannot_hold_them() -> None:
    row_queue = RowQueue(chunk_rows=2)
    row_queue.add_miss(BLOCK, Status.NOT_ASKED, 5)
    assert row_queue.dropped == 3


def test_row_queue_frees_returned_memory_beyond_its_reserve() -> None:
    """The reader returns more chunks than the queue keeps."""
    row_queue = RowQueue(chunk_rows=3, most_chunks=100)
    for turn in (1, 2):
        for due in range(100):
            row_queue.add_miss(BLOCK, Status.NOT_ASKED, due * turn)
        taken = [row_queue.take() for _ in range(100)]
        assert [[*each.array("sent")] for each in taken if each] == [[due * turn] * 3 for due in range(100)]
        del taken
    assert (row_queue.take(), row_queue.dropped) == (None, 0)


def test_a_code_without_a_name_raises() -> None:
    with pytest.raises(
        ValueError, match=r"^a row has a code without a name, or the names of one batch have more than 2 GiB"
    ):
        spell(memoryview(array("H", [0, 1])), Names(["pump"]))


EDGES = [0, 1, -1, 2**24, 2**24 + 1, 2**53 + 1, 2**63 - 1, -(2**63), -(2**63) + 1, 2**63 - 2**38]


def as_float32(bits: int) -> Fraction:
    return Fraction(*struct.unpack("<f", struct.pack("<I", bits))[0].as_integer_ratio())


@given(st.lists(st.one_of(st.integers(-(2**63), 2**63 - 1), st.sampled_from(EDGES)), max_size=9))
def test_integer_is_rounded_up_to_the_next_float32(numbers: list[int]) -> None:
    """In IEEE 754, the bits of the next float are those of the float plus one, as an integer."""
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


def test_only_valid_uncertainties_are_widened_to_64_bits() -> None:
    floats = struct.pack("<4f", 7.0, float("nan"), float("inf"), 1e30)
    assert list(widen(memoryview(floats), memoryview(b"\x01"), 4).cast("q")) == [7, 0, 0, 0]
    for bit in (2, 4, 8):
        with pytest.raises(ValueError, match="an uncertainty is not a finite number"):
            widen(memoryview(floats), memoryview(bytes([bit])), 4)
    for cut in (floats[:15], b""):
        with pytest.raises(ValueError, match="stated length of a column does not match its data"):
            widen(memoryview(cut), None, 4)
    with pytest.raises(ValueError, match="stated length of a column does not match its data"):
        widen(memoryview(floats), memoryview(b""), 4)


def test_one_byte_codes_are_assigned_in_the_order_of_use() -> None:
    table = CodeTable([f"name {number}" for number in range(400)])
    assert bytes(table.narrow(memoryview(array("H", [9, 0, 9, 399]))) or b"") == bytes([0, 1, 0, 2])
    assert table.used == ("name 9", "name 0", "name 399")
    # too many codes for one byte: with "name 399" they are 257
    assert table.narrow(memoryview(array("H", range(256)))) is None
    table.forget()
    assert bytes(table.narrow(memoryview(array("H", range(256)))) or b"") == bytes(range(256))
    with pytest.raises(ValueError, match="status 400 has no name"):
        table.narrow(memoryview(array("H", [400])))


def test_one_byte_codes_are_widened_to_two_bytes() -> None:
    assert list(wide_codes(memoryview(bytes([0, 255, 7])), 3, 1)) == [0, 255, 7]
    assert list(wide_codes(memoryview(b"x" + struct.pack("=2H", 1, 65535))[1:], 2, 2)) == [1, 65535]
    with pytest.raises(ValueError, match="stated length of a column does not match its data"):
        wide_codes(memoryview(b"123"), 2, 2)


codes = st.integers(0, 65535)


@given(st.lists(codes))
def test_the_greatest_code_of_a_column_is_found(given_codes: list[int]) -> None:
    assert greatest_code(memoryview(array("H", given_codes))) == max(given_codes, default=0)


@given(st.lists(st.tuples(codes, codes) | st.just((7, 65535))), st.frozensets(st.tuples(codes, codes)))
def test_rows_are_found_by_drive_and_register_codes(
    rows: list[tuple[int, int]], others: frozenset[tuple[int, int]]
) -> None:
    wanted = frozenset({(7, 65535), *rows[::3], *others})
    drives, registers = (memoryview(array("H", [row[side] for row in rows])) for side in (0, 1))
    assert find_codes(drives, registers, wanted) == [at for at, row in enumerate(rows) if row in wanted]
    assert find_codes(drives, registers, ()) == []
