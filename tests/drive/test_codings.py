"""Decode and encode every number format, byte order, bit range, offset and scale."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
from batches import UTC_0, add_rows, completion
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from simulated_bus import SimulatedBus
from tables import examples, table

from multidrop.capture.decoding import RegisterLookup
from multidrop.control.outcome import Effect
from multidrop.core import Columns, Framing, Message, Names, NumberFormat, RowLayout
from multidrop.drive import Drive
from multidrop.drive.register import HOLDING, INPUT, Kept, reading, row_field, setting
from multidrop.errors import NoValue
from multidrop.plant.model import PlantLine, PolledDrive
from multidrop.polling.batch import Batch, Row
from multidrop.recording import open_recording, open_writer
from multidrop.sim import SimulatedDrive

PACKED = {
    NumberFormat.U16: ">H",
    NumberFormat.I16: ">h",
    NumberFormat.U32: ">I",
    NumberFormat.I32: ">i",
    NumberFormat.U64: ">Q",
    NumberFormat.I64: ">q",
    NumberFormat.F16: ">e",
    NumberFormat.F32: ">f",
    NumberFormat.F64: ">d",
}
DIGITS = {NumberFormat.BCD16: 4, NumberFormat.BCD32: 8}
FLOATS = (NumberFormat.F16, NumberFormat.F32, NumberFormat.F64)
WRITTEN = [*PACKED, *DIGITS]
SPELT = {  # names of byte orders in documents; A is the most significant byte
    2: {"ABCD": "AB", "CDAB": "AB", "BADC": "BA", "DCBA": "BA", "AB": "AB", "BA": "BA"},
    4: {"ABCD": "ABCD", "CDAB": "CDAB", "BADC": "BADC", "DCBA": "DCBA", "AB": "ABCD"},
    8: {"ABCD": "ABCDEFGH", "CDAB": "GHEFCDAB", "BADC": "BADCFEHG", "DCBA": "HGFEDCBA", "AB": "ABCDEFGH"},
}
LONGEST = (NumberFormat.U64, NumberFormat.I64)
STEPS = [1, 0.1, 0.01, 0.001, 10, -1, -0.1, 2.5, 0.05, 60, -0.25]
OFFSETS = [0, -40, 273.15, 0.5, 1000, -0.01]


def most_significant_first(number_format: NumberFormat, raw: float) -> bytes:
    """Return the bytes of a number, most significant first, as documents print them."""
    if number_format in DIGITS:
        return bytes.fromhex(f"{raw:0{DIGITS[number_format]}d}")
    if number_format is NumberFormat.I8:
        return bytes([0x5A, int(raw) % 256])  # the high byte of the word does not belong to the value
    return struct.pack(PACKED[number_format], raw)


def on_the_wire(number_format: NumberFormat, order: str, raw: float) -> bytes:
    big = most_significant_first(number_format, raw)
    return bytes(big["ABCDEFGH".index(letter)] for letter in SPELT[len(big)][order])


def words_of(data: bytes) -> tuple[int, ...]:
    return struct.unpack(f">{len(data) // 2}H", data)


def counts(number_format: NumberFormat) -> st.SearchStrategy[Any]:
    """Return a strategy for raw counts of a format. It draws the smallest and largest counts more often."""
    if number_format is NumberFormat.F64:
        return st.floats(allow_nan=False, allow_infinity=False)
    if number_format in (NumberFormat.F16, NumberFormat.F32):
        width = 32 if number_format is NumberFormat.F32 else 16
        return st.floats(width=width, allow_nan=False, allow_infinity=False)
    if number_format in DIGITS:
        return st.integers(0, 10 ** DIGITS[number_format] - 1)
    if number_format is NumberFormat.I8:
        return st.integers(-128, 127)
    bits = 8 * struct.calcsize(PACKED[number_format])
    low = -(2 ** (bits - 1)) if number_format.name[0] == "I" else 0
    return st.integers(low, low + 2**bits - 1)


def orders(number_format: NumberFormat) -> st.SearchStrategy[str]:
    size = len(most_significant_first(number_format, 0))
    return st.sampled_from(sorted(SPELT[size]))


def declared(**registers: Any) -> type[Drive]:
    return type("Meter", (Drive,), {"most_registers": {INPUT: 125, HOLDING: 125}, **registers})


def row_of(family: type[Drive], name: str, data: bytes, at: int = 0) -> Row:
    """Return the polled row that the C core makes of a reply's data."""
    columns = Columns(1)
    layout = RowLayout(0, [row_field(family.register(name), at, 0)])
    assert add_rows(columns, layout, completion(5, first_ns=9, words=words_of(data)), UTC_0)
    (row,) = Batch(columns, Names(["meter"]), Names([name]))
    return row


def is_near(found: float, exact: Fraction, parts: list[Fraction]) -> bool:
    """Return True if `found` is `exact`, apart from rounding errors of float64 arithmetic with `parts`."""
    try:
        least = Fraction(2) ** -1074  # the smallest float64; below 2^-1022 a float64 has fewer digits
        return abs(Fraction(found) - exact) <= 4 * Fraction(2) ** -52 * max(map(abs, [exact, *parts])) + least
    except OverflowError:  # the expected value is beyond the largest float, so `found` is infinite
        return max(map(abs, [exact, *parts])) > Fraction(2) ** 1020


@st.composite
def numbers(draw: st.DrawFn) -> tuple[NumberFormat, str, float, float, float]:
    number_format = draw(st.sampled_from([*WRITTEN, NumberFormat.I8]))
    return (
        number_format,
        draw(orders(number_format)),
        draw(st.sampled_from(STEPS)),
        draw(st.sampled_from(OFFSETS)),
        draw(counts(number_format)),
    )


@pytest.mark.slow
@settings(max_examples=examples(400))
@given(numbers())
@example((NumberFormat.U64, "CDAB", 1, 0, 2**64 - 1))
@example((NumberFormat.I64, "DCBA", 0.001, 0, -(2**63)))
@example((NumberFormat.I16, "ABCD", -0.1, 0, 0))
@example((NumberFormat.F64, "AB", 0.01, 0, 2.225073858507203e-309))
def test_every_number_format_byte_order_step_and_offset_is_decoded_and_encoded(
    case: tuple[NumberFormat, str, float, float, float],
) -> None:
    number_format, order, step, offset, raw = case
    details: dict[str, Any] = {"number_format": number_format, "order": order, "step": step, "offset": offset}
    family = declared(level=reading(7, "m", table=INPUT, **details))
    data = on_the_wire(number_format, order, raw)
    parts = [Fraction(raw) * Fraction(str(step)), Fraction(str(offset))]
    exact = sum(parts, Fraction(0))

    row = row_of(family, "level", data)
    assert (row.status, row.value is not None) == ("ok", True)
    assert row.value is not None
    assert math.isinf(row.value) or is_near(row.value, exact, parts)
    assert math.copysign(1, row.value) == 1 or row.value != 0  # never -0.0

    value = family.level.value_in(data, 0)  # type: ignore[attr-defined]
    assert math.isinf(value) or is_near(value, exact, parts)
    if (
        number_format in (NumberFormat.U64, NumberFormat.I64)
        and exact.denominator == 1
        and step in (1, 10, 60)
    ):
        assert value == exact or offset % 1
    assert number_format in (NumberFormat.U64, NumberFormat.I64) or value == row.value


@settings(max_examples=examples(60), deadline=None)
@given(numbers().filter(lambda case: case[0] in WRITTEN and case[0] not in FLOATS))
@example((NumberFormat.U64, "BADC", 1, 0, 2**64 - 1))
def test_written_whole_number_is_read_back(case: tuple[NumberFormat, str, float, float, float]) -> None:
    number_format, order, step, offset, raw = case
    details: dict[str, Any] = {"number_format": number_format, "order": order, "step": step, "offset": offset}
    family = declared(level=setting(7, "m", kept=Kept.RAM, **details))
    register = family.registers["level"]
    data = on_the_wire(number_format, order, raw)
    sim = SimulatedDrive(family(1))
    line = SimulatedBus(sim)
    drive = line.attach(family(1))
    value = register.decode(raw)
    if Fraction(value) == Fraction(raw) * Fraction(str(step)) + Fraction(str(offset)) or abs(raw) < 2**50:
        outcome = drive.try_write(register, value)
        assert (outcome.effect, outcome.held) == (Effect.DONE, value)
        assert bytes.fromhex(line.written[-1])[-2 - len(data) : -2] == data
    sim.memory.set_raw(register, int.from_bytes(most_significant_first(number_format, raw)))
    assert sim.read(3, 7, len(data) // 2) == list(words_of(data))
    assert drive.read(register) == value == sim["level"]


@pytest.mark.parametrize("number_format", FLOATS)
@pytest.mark.parametrize("order", ["ABCD", "CDAB", "BADC", "DCBA"])
@settings(
    max_examples=examples(30), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_written_float_is_read_back(number_format: NumberFormat, order: str, data: st.DataObject) -> None:
    raw = data.draw(counts(number_format))
    family = declared(level=setting(7, "m", kept=Kept.RAM, number_format=number_format, order=order))
    register = family.registers["level"]
    sim = SimulatedDrive(family(1))
    line = SimulatedBus(sim)
    drive = line.attach(family(1))
    assert drive.write(register, raw) == raw == sim["level"]
    held = on_the_wire(number_format, order, raw or 0.0)  # -0.0 is stored as 0
    assert sim.read(3, 7, len(held) // 2) == list(words_of(held))
    assert register.encode(register.parse(register.format(raw).removesuffix(" m"))) == raw


@dataclass
class Bits:
    number_format: NumberFormat
    order: str
    part: tuple[int, int]
    whole: int


@st.composite
def bit_fields(draw: st.DrawFn) -> Bits:
    number_format = draw(st.sampled_from([one for one in PACKED if one not in FLOATS]))
    bits = 8 * struct.calcsize(PACKED[number_format])
    low = draw(st.integers(0, bits - 1))
    high = draw(st.integers(low, bits - 1))
    return Bits(number_format, draw(orders(number_format)), (low, high), draw(st.integers(0, 2**bits - 1)))


@settings(max_examples=examples(300))
@given(bit_fields())
@example(Bits(NumberFormat.U64, "CDAB", (0, 63), 2**64 - 1))
@example(Bits(NumberFormat.I16, "BA", (15, 15), 0x8000))
def test_a_range_of_bits_in_a_register_is_decoded_and_encoded(case: Bits) -> None:
    low, high = case.part
    size = struct.calcsize(PACKED[case.number_format])
    digits = f"{case.whole:0{8 * size}b}"[::-1][low : high + 1][
        ::-1
    ]  # the bits of the register's range, most significant first
    exact = int(digits, 2)
    if case.number_format.name[0] == "I" and digits[0] == "1":
        exact -= 2 ** len(digits)
    big = case.whole.to_bytes(size)
    data = bytes(big["ABCDEFGH".index(letter)] for letter in SPELT[size][case.order])
    register = reading(7, table=INPUT, number_format=case.number_format, order=case.order, part=case.part)
    family = declared(field=register)
    assert row_of(family, "field", data).value == float(exact)
    assert register.value_in(data, 0) == exact

    sim = SimulatedDrive(family(1))
    for at, word in enumerate(words_of(data)):
        sim.memory._cell(INPUT, 7 + at).raw = word
    assert sim["field"] == exact
    sim["field"] = 0
    sim["field"] = exact  # this must not change the word's other bits
    assert sim.read(4, 7, size // 2) == list(words_of(data))


class Phase(IntEnum):
    IDLE = 0
    HEATING = 5


class Alarm(IntFlag):
    DOOR = 1
    SENSOR = 2


def test_a_range_of_bits_in_a_register_can_be_an_enumeration() -> None:
    family = declared(
        phase=reading(7, Phase, part=(4, 7), table=INPUT), alarms=reading(7, Alarm, part=(8, 9), table=INPUT)
    )
    data = bytes.fromhex("0252")
    assert family.registers["phase"].value_in(data, 0) is Phase.HEATING
    assert family.registers["alarms"].value_in(data, 0) is Alarm.SENSOR
    assert row_of(family, "phase", data).value == 5
    sim = SimulatedDrive(family(1))
    sim["phase"], sim["alarms"] = Phase.HEATING, Alarm.SENSOR
    assert sim.read(4, 7, 1) == [0x0250]


@pytest.mark.slow
@settings(max_examples=examples(300))
@given(numbers().filter(lambda case: case[0] not in DIGITS), st.data())
@example((NumberFormat.U64, "CDAB", 1, 0, 2**64 - 2), None)
def test_a_raw_count_declared_invalid_is_read_as_no_value(
    case: tuple[NumberFormat, str, float, float, float], data: st.DataObject | None
) -> None:
    number_format, order, step, offset, raw = case
    others = data.draw(st.lists(counts(number_format), max_size=3)) if data else [2**64 - 1]
    details: dict[str, Any] = {"number_format": number_format, "order": order, "step": step, "offset": offset}
    family = declared(level=reading(7, "m", table=INPUT, invalid=(*others,), **details))
    register = family.registers["level"]
    for count in (raw, *others):
        wire = on_the_wire(number_format, order, count)
        is_value = count not in others
        row = row_of(family, "level", wire)
        assert row.status == ("ok" if is_value else "no valid value")
        assert (row.value is not None, row.uncertainty_ns is not None) == (is_value, is_value)
        assert (register.value_in(wire, 0) is not None) == is_value


@table(
    ("number_format", "part", "invalid", "wire"),
    [
        # both the bit pattern and the signed number are accepted as the "no value" count
        (NumberFormat.I16, None, 0x8000, "80 00"),
        (NumberFormat.I16, None, -32768, "80 00"),
        (NumberFormat.I32, None, 0x80000000, "80 00 00 00"),
        (NumberFormat.U64, None, 0xFFFFFFFFFFFFFFFF, "FF FF FF FF FF FF FF FF"),
        (NumberFormat.U64, None, -1, "FF FF FF FF FF FF FF FF"),
        (NumberFormat.I64, None, 0x8000000000000000, "80 00 00 00 00 00 00 00"),
        (NumberFormat.I8, None, 0x80, "12 80"),
        (NumberFormat.F16, None, (), "7E 00"),
        (NumberFormat.F16, None, math.inf, "7C 00"),
        (NumberFormat.F16, None, 0, "80 00"),
        (NumberFormat.F32, None, (), "7F C0 00 00"),  # a NaN
        (NumberFormat.F32, None, (), "FF A0 00 01"),  # another NaN
        (NumberFormat.F64, None, (), "7F F8 00 00 00 00 00 00"),
        (NumberFormat.F32, None, math.inf, "7F 80 00 00"),
        (NumberFormat.F32, None, -9999.9, "C6 1C 3F 9A"),
        (NumberFormat.F32, None, 0, "80 00 00 00"),  # -0.0 is the same count as 0
        (NumberFormat.BCD16, None, (), "12 3A"),
        (NumberFormat.BCD32, None, (), "F0 00 00 00"),
        (NumberFormat.BCD16, None, 9999, "99 99"),
        # the "no value" count does not fit into bit 0, so it is compared with the whole word
        (NumberFormat.U16, (0, 0), 0xFFFF, "FF FF"),
        # the "no value" count fits into the bits of the register, and only these bits are compared
        (NumberFormat.U16, (0, 7), 0xFF, "12 FF"),
        (NumberFormat.U16, (8, 15), 0xFF, "FF 12"),
        (NumberFormat.I16, (0, 3), -8, "00 08"),
    ],
)
def test_an_invalid_raw_count_is_recognised_in_all_number_formats(
    number_format: NumberFormat, part: Any, invalid: Any, wire: str
) -> None:
    data = bytes.fromhex(wire)
    register = reading(7, table=INPUT, number_format=number_format, part=part, invalid=invalid)
    family = declared(level=register)
    assert row_of(family, "level", data).status == "no valid value"
    assert register.value_in(data, 0) is None
    other = bytes(len(data) - 1) + b"\x01"
    assert row_of(family, "level", other).status == "ok"
    assert register.value_in(other, 0) is not None


def test_a_read_raises_an_error_if_a_raw_count_is_invalid() -> None:
    family = declared(
        level=reading(0, "m", invalid=0x7FFF),
        speed=reading(1, "rpm"),
        limit=setting(2, "m", invalid=0xFFFF, kept=Kept.EEPROM),
    )
    sim = SimulatedDrive(family(1))
    line = SimulatedBus(sim)
    drive = line.attach(family(1, name="tank"))
    sim["level"], sim["speed"], sim["limit"] = None, 20, None
    assert sim.read(3, 0, 3) == [0x7FFF, 20, 0xFFFF]
    with pytest.raises(NoValue, match=r"^tank: level holds no valid value at present$") as lack:
        drive.read(drive.level, drive.speed)
    assert (lack.value.register, dict(lack.value.values)) == ("level", {"speed": 20})
    # the write is allowed although the register held an invalid count before
    assert drive.write(drive.limit, 7) == 7
    with pytest.raises(
        ValueError, match=r"limit = 65535 cannot be written: its raw count stands for a missing"
    ):
        drive.write(drive.limit, 0xFFFF)
    assert sim["limit"] == 7


@settings(max_examples=examples(300))
@given(
    st.sampled_from([NumberFormat.U16, NumberFormat.I16, NumberFormat.U32, NumberFormat.I32]),
    st.sampled_from([1, 0.1, -1]),
    st.integers(-30, 30),
    st.sampled_from([-3, -1, 1, 4]),
    st.data(),
)
def test_a_value_is_multiplied_by_the_power_in_its_scale_register(
    number_format: NumberFormat, step: float, power: int, distance: int, data: st.DataObject
) -> None:
    raw = data.draw(counts(number_format))
    size = struct.calcsize(PACKED[number_format])
    at = 10 + (distance if distance < 0 else distance + size // 2 - 1)
    registers = {
        "level": reading(
            10, "m", table=INPUT, number_format=number_format, step=step, scale_register="power"
        ),
        "power": reading(at, table=INPUT, number_format=NumberFormat.I16, invalid=5),
    }
    start, stop = min(10, at), max(10 + size // 2, at + 1)
    gaps = {INPUT: range(start, stop)}
    family = type("Meter", (Drive,), {"readable_gaps": gaps, **registers})
    register = family.registers["level"]
    assert register.reach == range(start, stop)
    held = dict(
        zip(range(10, 10 + size // 2), words_of(on_the_wire(number_format, "ABCD", raw)), strict=True)
    )
    held[at] = power % 65536
    reply = struct.pack(f">{stop - start}H", *(held.get(address, 0xDEAD) for address in range(start, stop)))
    row, value = row_of(family, "level", reply, 10 - start), register.value_in(reply, 10 - start)
    if abs(power) > 22 or power == 5:
        assert (row.status, value) == ("no valid value", None)
        return
    exact = Fraction(raw) * Fraction(str(step)) * Fraction(10) ** power
    assert row.value is not None
    assert value == (exact.numerator / exact.denominator)
    assert is_near(row.value, exact, [])

    sim = SimulatedDrive(family(1))
    sim["power"] = power
    sim["level"] = value
    assert sim["level"] == value or abs(raw) > 2**50
    known = RegisterLookup(PlantLine("hall", "none", drives=[PolledDrive(family(1), ())]))
    places = known.find(Framing.RTU, Message(1, 4, start, stop - start)).places
    assert [place.at for place in places if place.name == "level"] == [10 - start]
    apart = known.find(Framing.RTU, Message(1, 4, 10, size // 2)).places
    assert "level" not in [place.name for place in apart]  # a reply without the scale register gives no value


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".arrows", ".csv", ".parquet"])
@settings(max_examples=10, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(cases=st.lists(numbers(), min_size=1, max_size=20))
def test_recorded_values_equal_the_values_decoded_by_the_c_core(
    tmp_path: Path, suffix: str, cases: list[tuple[NumberFormat, str, float, float, float]]
) -> None:
    columns = Columns(len(cases))
    for number_format, order, step, offset, raw in cases:
        register: Any = reading(
            7,
            "m",
            number_format=number_format,
            order=order,
            step=step,
            offset=offset,
            invalid=(raw,) * (raw == 1),
        )
        data = on_the_wire(number_format, order, raw)
        found = completion(5, first_ns=9, words=words_of(data))
        assert add_rows(columns, RowLayout(0, [row_field(register, 0, 0)]), found, UTC_0)
    batch = Batch(columns, Names(["meter"]), Names(["level"]))
    path = tmp_path / f"a{suffix}"
    with open_writer(path, {}) as writer:
        writer.write(batch)
    rows = [row for part in open_recording(path) for row in part]
    assert rows == list(batch)
    assert all(
        (row.status == "no valid value") == (case[4] == 1) for row, case in zip(rows, cases, strict=True)
    )
    path.unlink()
