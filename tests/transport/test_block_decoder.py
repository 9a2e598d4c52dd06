"""A block's numbers are decoded at once, and mean what each register by itself means."""

from __future__ import annotations

import struct
from enum import IntEnum
from fractions import Fraction
from typing import Any

from completions import completed
from hypothesis import example, given
from hypothesis import strategies as st

from multidrop.core import Completion, Message, NumberFormat
from multidrop.drive import Drive
from multidrop.drive.register import HOLDING, reading
from multidrop.planning.blocks import Block
from multidrop.transport.prepared import BlockDecoder, decoder_of


class Mode(IntEnum):
    OFF = 0
    ON = 1


class Mixed(Drive):
    """A drive whose table holds what can be decoded at once and what cannot."""

    model = "mixed"
    title = "MIXED"
    manual = "none"
    most_registers = {HOLDING: 40}

    tenths = reading(1, "Hz", step=0.1)
    celsius = reading(2, "°C", number_format=NumberFormat.I16, offset=-40)
    energy = reading(3, "kWh", number_format=NumberFormat.U32, step=0.001)
    swapped = reading(5, "kWh", number_format=NumberFormat.U32, order="CDAB")
    power = reading(7, "W", number_format=NumberFormat.F32)
    pulses = reading(10, "", number_format=NumberFormat.U64)
    drift = reading(14, "", number_format=NumberFormat.I64, step=0.5)
    mode = reading(18, Mode)
    again = reading(18, "")
    perhaps = reading(19, "V", invalid=0xFFFF)
    balance = reading(20, "J", number_format=NumberFormat.I32)
    flow = reading(22, "m3/h", scale_register="flow_power")
    flow_power = reading(23, "", number_format=NumberFormat.I16)
    nibble = reading(24, "", part=(4, 7))
    decimal = reading(25, "rpm", number_format=NumberFormat.BCD16)
    fine = reading(26, "J", number_format=NumberFormat.U32, step=12345678.9)


REGISTERS = tuple(Mixed.registers.values())
FIRST, WORDS = 1, 27


def expected(data: bytes) -> dict[str, Any]:
    """Return the values as `struct` and the table's own words tell them."""
    tenths, celsius, energy, low, high, power = struct.unpack_from(">HhIHHf", data)
    pulses, drift, mode, perhaps, balance, flow, power_of_ten = struct.unpack_from(">QqHHiHh", data, 18)
    part, digits, fine = struct.unpack_from(">HHI", data, 46)
    return {
        "tenths": tenths / 10,
        "celsius": celsius - 40,
        "energy": energy / 1000,
        "swapped": high << 16 | low,
        "power": None if power != power else power,
        "pulses": pulses,
        "drift": drift / 2,
        "mode": Mode(mode) if mode in (0, 1) else mode,
        "again": mode,
        "perhaps": None if perhaps == 0xFFFF else perhaps,
        "balance": balance,
        "flow": float(flow * Fraction(10) ** power_of_ten) if abs(power_of_ten) <= 22 else None,
        "flow_power": power_of_ten,
        "nibble": part >> 4 & 0xF,
        "decimal": int(f"{digits:x}") if f"{digits:x}".isdecimal() else None,
        "fine": fine * 123456789 / 10,  # more than a float holds before it is divided
    }


def reply(data: bytes) -> Completion:
    """Return the completion of a read whose reply has this data."""
    return completed(5 + len(data), Message(1, 3, data=data), b"", at_ns=1)


def decoder() -> BlockDecoder:
    return decoder_of(Block.of(Mixed(1), REGISTERS))


@given(st.binary(min_size=2 * WORDS, max_size=2 * WORDS))
def test_each_value_is_the_one_that_its_bytes_say(data: bytes) -> None:
    found = decoder().decode(reply(data))
    assert found == expected(data)
    assert type(found["pulses"]) is int  # a float would not hold all of it


@example(bytes(2 * WORDS - 1))
@given(st.binary(max_size=2 * WORDS - 1))
def test_a_reply_that_ends_too_soon_has_the_values_that_are_whole(data: bytes) -> None:
    block = Block.of(Mixed(1), REGISTERS)
    found = decoder_of(block).decode(reply(data))
    assert found == {one.name: one.value_in(data, one.address - FIRST) for one in REGISTERS}
    assert found["fine"] is None


def test_the_core_reads_what_a_float_holds() -> None:
    assert set(decoder().names) == {one.name for one in REGISTERS} - {"pulses", "drift", "flow", "fine"}


def test_drives_of_a_kind_share_a_decoder_and_other_blocks_have_their_own() -> None:
    assert decoder_of(Block.of(Mixed(2), REGISTERS)) is decoder()
    assert decoder_of(Block.of(Mixed(2), REGISTERS[1:])) is not decoder()
