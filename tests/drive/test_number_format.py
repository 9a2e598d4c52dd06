"""Numbers of every format are written to a simulated drive and read back."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from simulated_bus import SimulatedBus, real_clock
from tables import examples, table

from multidrop.cli.support.values import as_json, nearest_value, value_text
from multidrop.core import Message, NumberFormat
from multidrop.drive import Drive
from multidrop.drive.register import Carrier, Kept, Register, Table, command, reading, setting
from multidrop.drive.request import write_request
from multidrop.errors import WriteForbidden
from multidrop.sim import SimulatedDrive

SEVERAL = Table("holding register, several at once", 0x03, 0x10)
RELAYS = Table("coil, several at once", 0x01, 0x0F, Carrier.BIT)
PACKED = {  # the number formats in the notation of `struct`
    NumberFormat.U16: ">H",
    NumberFormat.I16: ">h",
    NumberFormat.U32: ">I",
    NumberFormat.I32: ">i",
    NumberFormat.F16: ">e",
    NumberFormat.F32: ">f",
}


class Meter(Drive):
    """A drive with a setting of each number format, and without a stated read limit."""

    u16 = setting(0, "V", kept=Kept.RAM)
    i16 = setting(1, "V", number_format=NumberFormat.I16, kept=Kept.RAM)
    u32 = setting(2, "V", number_format=NumberFormat.U32, kept=Kept.RAM)
    i32 = setting(4, "V", number_format=NumberFormat.I32, kept=Kept.RAM)
    u32_swapped = setting(6, "V", number_format=NumberFormat.U32, order="CDAB", kept=Kept.RAM)
    i32_swapped = setting(8, "V", number_format=NumberFormat.I32, order="CDAB", kept=Kept.RAM)
    f32 = setting(10, "V", number_format=NumberFormat.F32, kept=Kept.RAM)
    f32_swapped = setting(12, "V", number_format=NumberFormat.F32, order="CDAB", kept=Kept.RAM)

    scaled = setting(14, "V", number_format=NumberFormat.F32, step=0.1, kept=Kept.RAM)
    narrow = setting(16, "V", number_format=NumberFormat.F32, span=(0, 0.1), kept=Kept.RAM)
    unscaled = setting(18, number_format=NumberFormat.F32, step=None, kept=Kept.RAM)
    downwards = setting(20, "V", step=-0.1, kept=Kept.RAM)
    alone = setting(22, "V", table=SEVERAL, kept=Kept.RAM)
    lamp = setting(3, table=RELAYS)
    f16 = setting(32, "V", number_format=NumberFormat.F16, kept=Kept.RAM)
    total = reading(24, "kWh", number_format=NumberFormat.U32)
    status = reading(30)
    control = command(30, span=(0, 7), moves=False)


FORMATS = [
    *(Meter.register(wire.name.lower()) for wire in PACKED),
    *(Meter.u32_swapped, Meter.i32_swapped, Meter.f32_swapped),
]
formats = pytest.mark.parametrize("register", FORMATS, ids=lambda each: each.name)


def numbers(register: Register[Any]) -> st.SearchStrategy[float]:
    """Return a strategy for numbers that the register can hold."""
    if register.is_float:
        width = 16 if register.number_format is NumberFormat.F16 else 32
        return st.floats(width=width, allow_nan=False, allow_infinity=False)
    low, high = {"H": (0, 0xFFFF), "h": (-0x8000, 0x7FFF), "I": (0, 0xFFFFFFFF), "i": (-(2**31), 2**31 - 1)}[
        PACKED[register.number_format][1]
    ]
    return st.integers(low, high)


def on_the_wire(register: Register[Any], number: float) -> bytes:
    data = struct.pack(PACKED[register.number_format], number)
    return data[2:] + data[:2] if register.order == "CDAB" else data


@formats
@settings(max_examples=examples(30))
@given(data=st.data())
def test_written_number_has_the_bytes_of_its_format(register: Register[float], data: st.DataObject) -> None:
    number = data.draw(numbers(register))
    request = write_request(Meter(1), register, register.encode(number))
    # 0 replaces -0.0, which is sent without its sign
    assert request.data == on_the_wire(register, number or 0)
    function, count = (0x10, 2) if register.words == 2 else (0x06, 0)
    assert (request.function, request.start, request.count) == (function, register.address, count)


@pytest.fixture(scope="module")
def attached() -> Iterator[Any]:
    with real_clock():
        sim = SimulatedDrive(Meter(1))
        line = SimulatedBus(sim)
        yield line, line.attach(Meter(1, confirmed=1)), sim


@settings(max_examples=examples(50))
@given(st.floats(-3e38, 3e38))
@example(12.1)
@example(16_777_217)
def test_written_float_is_rounded_to_the_nearest_float32(attached: Any, value: float) -> None:
    _, meter, sim = attached
    (nearest,) = struct.unpack(">f", struct.pack(">f", value))
    assert meter.write(Meter.f32, value) == nearest == sim["f32"]
    assert Meter.f32.encode(value) == nearest


@table("name", ["f32", "f32_swapped", "scaled", "unscaled", "u16"])
@table("value", [math.nan, math.inf, -math.inf, 3.5e38, -1e300, 10**400, -(10**5000)], ids=range(7))
def test_value_beyond_its_number_format_is_refused(attached: Any, name: str, value: float) -> None:
    line, meter, _ = attached
    before = len(line.written)
    with pytest.raises(WriteForbidden, match=rf"{name} (takes a finite number, not|= .* does not fit:)"):
        meter.write(meter.register(name), value)
    assert len(line.written) == before


@given(st.floats(width=32, allow_nan=False, allow_infinity=False))
@example(struct.unpack(">f", struct.pack(">f", 1e-45))[0])
@pytest.mark.parametrize("register", [Meter.f32, Meter.scaled, Meter.unscaled], ids=lambda each: each.name)
def test_formatted_float_has_enough_digits_to_be_parsed_back(register: Register[float], raw: float) -> None:
    shown = register.format(register.decode(raw)).partition(" ")[0]
    assert register.encode(register.parse(shown)) == raw
    assert len(shown.lstrip("-").replace(".", "").partition("e")[0].strip("0")) <= 9


@table(
    ("value", "text"),
    [(12.5, "12.5 V"), (12.0, "12 V"), (12.1, "12.1 V"), (0.1, "0.1 V"), (-0.0, "0 V"),
     (1 / 3, "0.33333334 V"), (1e20, "1e+20 V"), (math.nan, "nan V"), (math.inf, "inf V"),
     (16_777_217, "16777216 V")],
)  # fmt: skip
def test_floats_are_formatted_as_their_shortest_decimals(value: float, text: str) -> None:
    assert Meter.f32.format(value) == text
    if math.isfinite(value):
        assert Meter.f32.format(Meter.f32.decode(Meter.f32.encode(value))) == text


def test_half_float_is_formatted_as_its_shortest_decimal(capsys: pytest.CaptureFixture[str]) -> None:
    assert Meter.f16.format(nearest_value(Meter.f16, 12.1)) == "12.1 V"
    assert capsys.readouterr().err == ""
    assert nearest_value(Meter.f16, 2049.0) == 2048
    assert capsys.readouterr().err == ("multidrop: f16 holds half-precision numbers: 2049.0 becomes 2048 V\n")
    with pytest.raises(ValueError, match=r"f16 = 65520 does not fit: the register holds -65504 to 65504 V"):
        Meter.f16.encode(65520)


def test_a_limit_between_two_float32_values_can_be_written(attached: Any) -> None:
    _, meter, _ = attached
    assert meter.write(Meter.narrow, 0.1) == pytest.approx(0.1)
    with pytest.raises(WriteForbidden, match=r"narrow = 0\.10001 is outside 0 to 0\.1 V"):
        meter.write(Meter.narrow, 0.10001)


def test_simulated_drive_refuses_floats_outside_the_limits() -> None:
    sim = SimulatedDrive(Meter(1))

    def answer(value: float) -> Message:
        reply = sim.answer(Message(1, 0x10, 16, 2, struct.pack(">f", value)), 0.0)
        assert reply is not None
        return reply

    assert not answer(0.05).exception
    for value in (0.2, -1e-9, math.nan, math.inf):
        assert answer(value).exception == 3
    assert sim["narrow"] == pytest.approx(0.05)
    sim["f32"] = 1e300  # too large for a float32
    assert sim["f32"] == math.inf


def test_command_line_warns_if_a_float_register_rounds_the_number(capsys: pytest.CaptureFixture[str]) -> None:
    (single,) = struct.unpack(">f", struct.pack(">f", 12.1))
    assert nearest_value(Meter.f32, Meter.f32.parse("12.1")) == single
    # no warning, because the rounded number is shown with the digits that the user typed
    assert capsys.readouterr().err == ""
    assert nearest_value(Meter.f32, 16_777_217.0) == 16_777_216
    assert capsys.readouterr().err == (
        "multidrop: f32 holds single-precision numbers: 16777217.0 becomes 16777216 V\n"
    )
    assert as_json(Meter.f32, 12.5) == {"value": 12.5, "unit": "V"}
    assert as_json(Meter.unscaled, 12.5) == {"value": None, "raw": 12.5}
    assert as_json(Meter.unscaled, math.nan) == {"value": None, "raw": None}
    assert as_json(Meter.f32, math.inf)["value"] is None


@pytest.mark.parametrize(("value", "text"), [(12.345678, "12.345678 raw"), (1_234_567, "1234567 raw")])
def test_number_without_a_known_scale_is_formatted_with_all_its_digits(value: float, text: str) -> None:
    assert value_text(Meter.unscaled, value) == text


def test_register_of_several_words_is_read_without_a_stated_read_limit(attached: Any) -> None:
    _, meter, sim = attached
    sim["total"] = 0x12345
    assert meter.read(Meter.total) == 0x12345


@pytest.mark.parametrize("order", [1, -1])
def test_a_reading_and_a_command_may_share_an_address(order: int) -> None:
    declared = [("status", reading(5)), ("control", command(5, span=(0, 7), moves=False))][::order]
    both = type("Both", (Drive,), dict(declared))
    line = SimulatedBus(SimulatedDrive(both(1)))
    drive = line.attach(both(1, confirmed=1))
    assert drive.write(drive.control, 3) == 3
    assert drive.read(drive.status) == 3
    reply = line.sims[0].answer(Message(1, 6, 5, data=bytes([0, 8])), line.seconds)
    assert reply is not None
    assert reply.exception == 3  # exception 3: the value is outside the command's limits


def test_single_register_is_written_by_function_16_if_its_table_requires_it(attached: Any) -> None:
    line, meter, sim = attached
    assert write_request(meter, Meter.alone, 7) == Message(1, 0x10, 22, 1, bytes([0, 7]))
    assert meter.write(Meter.alone, 7) == 7
    assert meter.write(Meter.lamp, 1) == 1
    assert (sim["alone"], sim["lamp"]) == (7, 1)
    assert line.frames[-2][0].function == 0x0F


def test_the_step_of_a_register_may_be_negative(attached: Any) -> None:
    _, meter, sim = attached
    assert meter.write(Meter.downwards, -5.0) == -5.0 == sim["downwards"]
    assert Meter.downwards.format(Meter.downwards.decode(0.0)) == "0.0 V"
    with pytest.raises(
        WriteForbidden, match=r"downwards = 5 does not fit: the register holds -6553\.5 to 0 V$"
    ):
        meter.write(Meter.downwards, 5)


@table(
    ("step", "decimals"), [(1, 0), (0.1, 1), (0.01, 2), (100, 0), (1e-7, 7), (-0.05, 2), (2.5, 1), (1e6, 0)]
)
def test_the_number_of_decimals_follows_from_the_registers_step(step: float, decimals: int) -> None:
    assert reading(1, "V", step=step).decimals == decimals
