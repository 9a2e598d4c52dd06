"""Registers: exact scaling, enforced spans, readable names."""

from __future__ import annotations

from enum import IntEnum, IntFlag
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tables import table

from multidrop.core import NumberFormat
from multidrop.drive import Drive
from multidrop.drive.line_settings import Settings
from multidrop.drive.register import COIL, Kept, Register, command, reading, setting


class Run(IntEnum):
    STOP = 1
    GO = 2


class Bits(IntFlag):
    RUN = 1
    FAULT = 8


class Example(Drive):
    """A drive for these tests."""

    current = reading(3, "A", step=0.1)
    unknown = reading(4, "V", step=None)
    temperature = reading(5, "degC", number_format=NumberFormat.I16)
    bits = reading(6, Bits)
    energy = reading(8, "kWh", step=0.01, number_format=NumberFormat.U32)
    frequency = setting(0x2001, "Hz", step=0.01, span=(0, 400), kept=Kept.RAM)
    run = command(0x2000, Run)
    word = command(0x2002, Bits)
    coil = command(1, table=COIL)
    coarse = setting(9, "V", step=5)
    choice = setting(10, span=(0, 2))


@table(("raw", "value"), [(3, 0.3), (7, 0.7), (285, 28.5), (65535, 6553.5)])
def test_a_decoded_value_is_the_float_nearest_to_raw_times_step(raw: int, value: float) -> None:
    assert Example.current.decode(raw) == value


def test_a_register_is_named_like_its_class_attribute() -> None:
    assert Example.current.name == "current"
    assert list(Example.registers)[:2] == ["current", "unknown"]


def test_a_raw_count_without_a_member_decodes_to_its_number() -> None:
    assert Example.run.decode(2) is Run.GO
    assert Example.run.decode(9) == 9
    assert Example.bits.decode(9) == Bits.RUN | Bits.FAULT


@table(
    ("register", "value", "error"),
    [
        (Example.frequency, 400.01, ValueError),
        (Example.frequency, -0.01, ValueError),
        (Example.frequency, float("nan"), ValueError),
        (Example.frequency, float("inf"), ValueError),
        (Example.frequency, "50", TypeError),
        (Example.frequency, True, TypeError),
        (Example.run, 2, TypeError),
        (Example.word, Bits(2), ValueError),  # a reserved bit
        (Example.temperature, 40000, ValueError),
        (Example.coil, 2, ValueError),
        (Example.coarse, 5 * 65536, ValueError),
        (Example.unknown, 2.5, ValueError),  # a raw count
        (Example.choice, 1.5, ValueError),
    ],
)
def test_values_that_a_register_refuses(
    register: Register[Any], value: object, error: type[Exception]
) -> None:
    with pytest.raises(error, match=register.name):
        register.encode(value)


@given(st.integers(0, 40000))
def test_every_raw_count_survives_decoding_and_encoding(raw: int) -> None:
    assert Example.frequency.encode(Example.frequency.decode(raw)) == raw


@given(st.floats(0, 400))
def test_encoding_rounds_to_the_nearest_raw_count(value: float) -> None:
    assert abs(Example.frequency.decode(Example.frequency.encode(value)) - value) <= 0.00501


@table(
    ("register", "value", "text"),
    [
        (Example.current, 2.5, "2.5 A"),
        (Example.frequency, 50.0, "50.00 Hz"),
        (Example.unknown, 311, "311 (scale not stated)"),
        (Example.bits, Bits.RUN | Bits.FAULT, "RUN|FAULT"),
        (Example.bits, Bits(0), "none"),
        (Example.bits, Bits(0x1100), "bit 8, bit 12"),
        (Example.bits, Bits(0x8009), "RUN|FAULT, bit 15"),
        (Example.run, Run.STOP, "STOP"),
        (Example.coarse, 15.0, "15 V"),
    ],
)
def test_format_returns_values_with_their_unit(register: Register[Any], value: object, text: str) -> None:
    assert register.format(value) == text


def test_typed_text_becomes_a_value() -> None:
    assert Example.frequency.parse("25.5") == 25.5
    assert Example.run.parse("go") is Run.GO
    assert Example.word.parse("run|fault") == Bits.RUN | Bits.FAULT
    with pytest.raises(ValueError, match="number in Hz"):
        Example.frequency.parse("fast")
    with pytest.raises(ValueError, match="it takes stop, go"):
        Example.run.parse("jump")
    with pytest.raises(ValueError, match="one of"):
        Example.run.parse("go|stop")


def test_words_is_the_number_of_addresses_of_a_register() -> None:
    assert (Example.energy.words, Example.current.words, Example.coil.words) == (2, 1, 1)


def test_the_error_for_an_unknown_register_names_similar_registers() -> None:
    with pytest.raises(ValueError, match="did you mean current"):
        Example.register("curent")


def test_an_address_outside_the_protocol_is_refused() -> None:
    with pytest.raises(ValueError, match=r"^Far\.frequency: address = 65536 is not an address"):
        type("Far", (Drive,), {"frequency": reading(0x10000, "Hz")})


@table("number", [10**400, -(10**400), 1 << 64])
@table("name", ["current", "energy", "frequency", "choice", "unknown"])
def test_number_too_large_for_a_float_is_refused(name: str, number: int) -> None:
    with pytest.raises(ValueError, match=rf"^{name} "):
        Example.register(name).encode(number)


# ---- line settings ----


@table(
    ("baudrate", "format", "bits"),
    [
        (9600, "8N1", 10),
        (9600, "8E1", 11),
        (9600, "8N2", 11),
        (9600, "7N2", 10),
        (9600, "7E1", 10),
        (9600, "8O2", 12),
    ],
)
def test_the_duration_of_a_character_includes_start_parity_and_stop_bits(
    baudrate: int, format: str, bits: int
) -> None:
    assert Settings(baudrate, format).character == pytest.approx(bits / baudrate)


@table(
    ("baudrate", "format", "seconds"),
    [
        (9600, "8E1", 4.0104e-3),  # 3.5 characters of 11 bits
        (19200, "8E1", 2.0052e-3),
        (38400, "8N1", 1.75e-3),  # fixed above 19200
        (115200, "8N1", 1.75e-3),
    ],
)
def test_t3_5(baudrate: int, format: str, seconds: float) -> None:
    assert Settings(baudrate, format).t3_5 == pytest.approx(seconds, rel=1e-4)


@table("format", ["8X1", "9N1", "8N3", "8n1", "", "8N1 "])
def test_invalid_format_is_refused(format: str) -> None:
    with pytest.raises(ValueError, match="format"):
        Settings(9600, format)


@pytest.mark.parametrize("baudrate", [0, -9600, 10**9])
def test_invalid_baud_rate_is_refused(baudrate: int) -> None:
    with pytest.raises(ValueError, match="baud rate"):
        Settings(baudrate, "8N1")
