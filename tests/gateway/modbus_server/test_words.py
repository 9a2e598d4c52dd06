"""Words computed from polled values equal the drive's words bit for bit, or are unknown."""

from __future__ import annotations

import math
import struct
from enum import IntEnum
from typing import Any

import pytest
from batches import UTC_0, add_rows, completion
from hypothesis import example, given
from hypothesis import strategies as st
from tables import PART, table

from multidrop.core import Columns, Names, NumberFormat, RowLayout
from multidrop.drive import Drive
from multidrop.drive.register import COIL, DISCRETE, HOLDING, INPUT, Register, reading, row_field
from multidrop.gateway.live.hub import KeptRow
from multidrop.gateway.modbus_server.protocol import InvalidHeader, MbapRequest, take_request
from multidrop.gateway.modbus_server.words import DriveWords, Unavailable, exact_data
from multidrop.plant.model import Polled, PolledDrive
from multidrop.polling.batch import Batch

BYTES = {
    NumberFormat.U16: 2,
    NumberFormat.I16: 2,
    NumberFormat.BCD16: 2,
    NumberFormat.I8: 2,
    NumberFormat.F16: 2,
    NumberFormat.U32: 4,
    NumberFormat.I32: 4,
    NumberFormat.U32_EITHER: 4,
    NumberFormat.F32: 4,
    NumberFormat.BCD32: 4,
    NumberFormat.U64: 8,
    NumberFormat.I64: 8,
    NumberFormat.F64: 8,
}
ORDERS = ["ABCD", "CDAB", "BADC", "DCBA"]
STEPS = [1, 0.1, 0.01, 0.001, 10, -1, -0.1, 2.5, 0.05, 60, -0.25, 0.0333]
OFFSETS = [0, -40, 273.15, 0.5, 1000, -0.01]
WHOLE = [NumberFormat.U16, NumberFormat.I16, NumberFormat.U32, NumberFormat.I32]


def declared(**details: Any) -> Register[Any]:
    family = type("Meter", (Drive,), {"level": reading(0, "m", **details)})
    return family.registers["level"]


def value_of(register: Register[Any], data: bytes) -> float | None:
    """Return the value that the core decodes from these bytes, or None if it has no value."""
    words = struct.unpack(f">{len(data) // 2}H", data)
    columns = Columns(1)
    assert add_rows(
        columns, RowLayout(0, [row_field(register, 0, 0)]), completion(5, first_ns=9, words=words), UTC_0
    )
    (row,) = Batch(columns, Names(["meter"]), Names(["level"]))
    return row.value


@st.composite
def sent(draw: st.DrawFn) -> tuple[NumberFormat, str, float, float, bytes]:
    number_format = draw(st.sampled_from([*BYTES]))
    size = BYTES[number_format]
    data = draw(st.binary(min_size=size, max_size=size))
    order = draw(st.sampled_from(ORDERS if size > 2 else ["AB", "BA"]))
    if number_format is NumberFormat.U32_EITHER:
        order = "ABCD"
    return number_format, order, draw(st.sampled_from(STEPS)), draw(st.sampled_from(OFFSETS)), data


@given(sent())
@example((NumberFormat.F32, "ABCD", 1, 0, b"\x80\0\0\0"))  # -0.0, which the core returns as 0.0
@example((NumberFormat.F32, "ABCD", 1, 0, bytes(4)))
@example((NumberFormat.F32, "ABCD", 1, 0, b"\x7f\x80\0\0"))  # infinity
@example((NumberFormat.F32, "ABCD", 1, 0, b"\0\0\0\x01"))  # the smallest positive float
@example((NumberFormat.U64, "ABCD", 1, 0, (2**53 + 1).to_bytes(8)))  # not representable as float64
@example((NumberFormat.U64, "ABCD", 0.1, 0, (2**53 + 1).to_bytes(8)))
@example((NumberFormat.U64, "ABCD", 60, 0, (2**53 + 1).to_bytes(8)))
@example((NumberFormat.I64, "ABCD", 1, 0, (-(2**53) - 1).to_bytes(8, signed=True)))
@example((NumberFormat.F64, "ABCD", 0.1, 0, struct.pack(">d", 0.30000000000000004)))
# the sum of 1e-20 and the offset equals the offset, so that the raw value cannot be computed
@example((NumberFormat.F64, "ABCD", 1, 1000, struct.pack(">d", 1e-20)))
@example((NumberFormat.F32, "ABCD", 1, 273.15, struct.pack(">f", 1e-20)))
def test_words_computed_from_a_value_equal_the_drives_words_or_none(
    case: tuple[NumberFormat, str, float, float, bytes],
) -> None:
    number_format, order, step, offset, data = case
    register = declared(number_format=number_format, order=order, step=step, offset=offset)
    value = value_of(register, data)
    if value is not None:
        assert exact_data(register, value) in (data, None)


@given(st.sampled_from(WHOLE), st.sampled_from(STEPS), st.sampled_from(OFFSETS), st.data())
def test_register_words_can_be_computed_from_each_integer_value(
    number_format: NumberFormat, step: float, offset: float, data: st.DataObject
) -> None:
    size = BYTES[number_format]
    order = data.draw(st.sampled_from(ORDERS if size > 2 else ["AB", "BA"]))
    raw = data.draw(st.binary(min_size=size, max_size=size))
    register = declared(number_format=number_format, order=order, step=step, offset=offset)
    value = value_of(register, raw)
    assert value is not None
    assert exact_data(register, value) == raw


@pytest.mark.slow
def test_register_words_can_be_computed_from_each_16_bit_number() -> None:
    """A usual run tests only every 19th raw count."""
    for step in (0.1, 0.01, -0.25):
        register = declared(step=step)
        for raw in range(0, 0x10000, 2 * PART - 1):
            value = raw * round(step * 100) / 100
            assert exact_data(register, value) == raw.to_bytes(2)


@given(st.floats(width=32, allow_nan=False).filter(bool), st.sampled_from(ORDERS))
def test_register_words_can_be_computed_from_each_float_other_than_zero(number: float, order: str) -> None:
    register = declared(number_format=NumberFormat.F32, order=order)
    data = struct.pack(">f", number)
    places = {"ABCD": (0, 1, 2, 3), "CDAB": (2, 3, 0, 1), "BADC": (1, 0, 3, 2), "DCBA": (3, 2, 1, 0)}[order]
    on_the_wire = bytes(data[at] for at in places)
    value = value_of(register, on_the_wire)
    assert value == number
    assert exact_data(register, number) == on_the_wire
    assert exact_data(register, 0.0) is None


@table("value", [math.inf, -math.inf, math.nan, 1e300, 0.3, -1, 65536, 2**70])
def test_no_register_words_are_computed_for_a_value_that_does_not_fit(value: float) -> None:
    assert exact_data(declared(), value) is None


@table(
    "details",
    [
        {"part": (0, 3)},
        {"number_format": NumberFormat.I8},
        {"number_format": NumberFormat.U32_EITHER},
        {"invalid": 5},  # the raw count that means "no value"
    ],
)
def test_no_register_words_are_computed_for_a_format_with_undefined_bits(details: dict[str, Any]) -> None:
    assert exact_data(declared(**details), 5.0) is None


def test_no_register_words_are_computed_if_another_register_sets_the_scale() -> None:
    family = type(
        "Scaled",
        (Drive,),
        {
            "level": reading(0, "m", scale_register="power"),
            "power": reading(1, number_format=NumberFormat.I16),
        },
    )
    assert exact_data(family.registers["level"], 5.0) is None
    assert exact_data(family.registers["power"], -2.0) == b"\xff\xfe"


class Status(IntEnum):
    STANDS = 3


class Meter(Drive):
    """A drive with registers of all kinds at adjacent addresses."""

    speed = reading(0, "rpm")
    energy = reading(1, "kWh", number_format=NumberFormat.U32, order="CDAB", step=0.1)
    status = reading(3, Status)
    low = reading(4, part=(0, 7))
    level = reading(5, "m", number_format=NumberFormat.F32)
    again = reading(0, "Hz", step=0.01, table=HOLDING)
    pressure = reading(0, "bar", table=INPUT)
    relay = reading(7, table=COIL)
    door = reading(8, table=DISCRETE)
    unpolled = reading(9)


def row(value: float, at_ns: int = 1000) -> KeptRow:
    return 0, at_ns, value, 0


ROWS = {
    "speed": row(1450.0, at_ns=500),
    "energy": row(0x0001_0002 / 10),
    "status": row(3.0),
    "low": row(7.0),
    "level": row(1.5),
    "again": row(14.5, at_ns=400),
    "pressure": row(12.0),
    "relay": row(1.0),
    "door": row(0.0),
}


def read(function: int, start: int, count: int, **changed: KeptRow | None) -> list[int] | Unavailable:
    polls = tuple(Polled(Meter.registers[name], 0.1) for name in ROWS)
    rows = {**ROWS, **changed}
    return DriveWords(PolledDrive(Meter(1), polls)).read(function, range(start, start + count), rows.get)


def test_a_range_of_addresses_is_answered_with_the_drives_words() -> None:
    assert read(3, 0, 4) == [1450, 0x0002, 0x0001, 3]
    assert read(3, 2, 1) == [0x0001]  # the second half of a 32-bit register
    assert read(4, 0, 1) == [12]
    assert read(3, 5, 2) == [0x3FC0, 0]
    assert read(1, 7, 1) == [1]
    assert read(2, 8, 1) == [0]


def test_an_address_range_is_not_answered_if_one_word_is_unknown() -> None:
    # this range contains a register that has only some bits of its word
    assert read(3, 3, 2) is Unavailable.UNPOLLED
    assert read(3, 9, 1) is Unavailable.UNPOLLED
    assert read(4, 0, 2) is Unavailable.UNPOLLED
    assert read(1, 0, 1) is Unavailable.UNPOLLED
    assert read(3, 5, 2, level=row(0.0)) is Unavailable.UNPOLLED  # 0.0, whose sign is unknown


def test_an_address_range_is_not_answered_if_one_value_is_not_fresh() -> None:
    assert read(3, 0, 4, status=None) is Unavailable.STALE
    assert read(3, 0, 1, speed=None, again=None) is Unavailable.STALE


def test_the_newest_value_is_used_if_two_registers_have_one_address() -> None:
    # address 0 has the register `speed`, and the register `again`, which was polled earlier
    assert read(3, 0, 1, again=row(14.49)) == [1449]
    assert read(3, 0, 1, speed=None) == [1450]


# ---- MBAP: requests are parsed correctly however their bytes are divided ----


# From the MODBUS Messaging on TCP/IP Implementation Guide V1.0b, 4.4.2.1 and the example of section 3.1.3:
# transaction 1501H, protocol 0, length 6, unit FFH, function 03, start 0004H, count 0001H
PRINTED = bytes.fromhex("15 01 00 00 00 06 FF 03 00 04 00 01")


def test_the_example_of_the_modbus_guide_is_parsed_and_answered() -> None:
    buffer = bytearray(PRINTED)
    found = take_request(buffer)
    assert found == MbapRequest(0x1501, 0xFF, 3, bytes.fromhex("00 04 00 01"))
    assert not buffer
    assert found.reply(bytes.fromhex("02 00 05")) == bytes.fromhex("15 01 00 00 00 05 FF 03 02 00 05")
    assert found.exception(2) == bytes.fromhex("15 01 00 00 00 03 FF 83 02")


@table(
    "header",
    [
        "00 01 00 01",  # the protocol id is not 0
        "00 01 FF FF 00 06 01 03",
        "47 45 54 20",  # GET
        "16 03 01 02",  # TLS
        "00 01 00 00 00 00",
        "00 01 00 00 00 01",
        "00 01 00 00 00 FF",  # one byte longer than the longest allowed frame
        "00 01 00 00 FF FF",
    ],
)
def test_an_invalid_mbap_header_is_refused_before_the_rest_of_its_frame_arrives(header: str) -> None:
    with pytest.raises(InvalidHeader):
        take_request(bytearray.fromhex(header))


frames = st.builds(
    lambda transaction, unit, function, data: (
        struct.pack(">HHHBB", transaction, 0, 2 + len(data), unit, function) + data
    ),
    st.integers(0, 0xFFFF),
    st.integers(0, 255),
    st.integers(0, 255),
    st.binary(max_size=252),
)


@given(st.lists(frames, max_size=6), st.lists(st.integers(1, 40), min_size=1, max_size=40))
def test_modbus_requests_are_parsed_from_pieces_of_any_size(sent: list[bytes], cuts: list[int]) -> None:
    whole = b"".join(sent)
    buffer, found, at = bytearray(), [], 0
    while at < len(whole):
        size = cuts[len(found) % len(cuts)]
        buffer += whole[at : at + size]
        at += size
        while taken := take_request(buffer):
            found.append(taken)
    assert not buffer
    assert [
        struct.pack(">HHHBB", one.transaction, 0, 2 + len(one.data), one.unit, one.function) + one.data
        for one in found
    ] == sent
