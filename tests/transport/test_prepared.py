"""Reads with `Bus` are planned once, and planned again only if port, settings or drive change."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from enum import IntEnum
from fractions import Fraction
from itertools import permutations
from threading import Barrier
from typing import Any

import pytest
from completions import completed
from hypothesis import example, given
from hypothesis import strategies as st
from toy import PatientToy, Toy

from multidrop.bus import Bus
from multidrop.core import Completion, Exchange, Message, NumberFormat
from multidrop.drive import Drive
from multidrop.drive.line_settings import Settings
from multidrop.drive.register import HOLDING, reading
from multidrop.errors import NoReply
from multidrop.planning.blocks import Block
from multidrop.planning.bus_time import silence
from multidrop.sim import SimulatedDrive, Simulator, Wire
from multidrop.transport import prepared as prepared_reads
from multidrop.transport.prepared import BlockDecoder, decoder_of

WANTED = (Toy.output_frequency, Toy.mystery, Toy.acceleration_time)


class Counted:
    """Counts how often blocks are planned, and the exchanges."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.plans = self.made = 0
        blocks, make_read = prepared_reads.blocks, prepared_reads.make_read

        def choose(*given: Any) -> Any:
            self.plans += 1
            return blocks(*given)

        def make(*given: Any, **details: Any) -> Any:
            self.made += 1
            return make_read(*given, **details)

        monkeypatch.setattr(prepared_reads, "blocks", choose)
        monkeypatch.setattr(prepared_reads, "make_read", make)

    def since(self) -> tuple[int, int]:
        """Return the numbers of plans and exchanges since the last call."""
        found = self.plans, self.made
        self.plans = self.made = 0
        return found


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> Counted:
    return Counted(monkeypatch)


@pytest.fixture
def bus() -> Iterator[Bus]:
    drives = [SimulatedDrive(Toy(address)) for address in (1, 2)]
    with Simulator([Wire(drives, unpaced=True)]) as sim, Bus(sim.wires[0].path) as opened:
        yield opened


def completions_of(
    bus: Bus, monkeypatch: pytest.MonkeyPatch, meet: Callable[[], object] = lambda: None
) -> list[Completion]:
    """Return a list to which the completion of each exchange is appended."""
    carry_out = bus.line.carry_out
    asked: list[Completion] = []

    def noting(exchange: Exchange, **details: Any) -> Completion:
        meet()
        asked.append(carry_out(exchange, **details))
        return asked[-1]

    monkeypatch.setattr(bus.line, "carry_out", noting)
    return asked


@pytest.mark.slow
def test_repeated_reads_of_the_same_registers_are_planned_once(bus: Bus, counted: Counted) -> None:
    one, other = bus.attach(PatientToy, 1), bus.attach(PatientToy, 2)
    first = one.read_many(WANTED)
    assert counted.since() == (1, 2)
    assert [one.read_many(WANTED) for _ in range(5)] == 5 * [first]
    assert counted.since() == (0, 0)
    one.read(Toy.acceleration_time)  # the same block as in WANTED
    assert counted.since() == (1, 0)
    other.read_many(WANTED)
    assert counted.since() == (1, 2)


@pytest.mark.slow
def test_detaching_a_drive_removes_its_prepared_reads(bus: Bus, counted: Counted) -> None:
    drive = bus.attach(PatientToy, 1)
    drive.read_many(WANTED)
    bus.detach(drive)
    with pytest.raises(ValueError, match="is not attached to this bus"):
        drive.read_many(WANTED)
    assert bus._exchanges._prepared == {}
    counted.since()
    bus.attach(drive)
    drive.read_many(WANTED)
    assert counted.since() == (1, 2)


def test_reads_are_planned_again_after_the_port_is_reopened(bus: Bus, counted: Counted) -> None:
    drive = bus.attach(PatientToy, 1)
    drive.read_many(WANTED)
    bus.line.reopen()
    counted.since()
    drive.read_many(WANTED)
    assert counted.since() == (1, 2)


@pytest.mark.parametrize(
    ("name", "value"),
    [("settings", Settings(19200, "8N1")), ("agreed_silence", 0.01), ("response_delay", 0.2), ("address", 3)],
)
def test_a_prepared_read_follows_changed_settings(bus: Bus, name: str, value: object) -> None:
    drive = bus.attach(PatientToy, 1)
    before = bus._exchanges._prepare(drive)
    assert bus._exchanges._prepare(drive) is before
    setattr(drive, name, value)
    after = bus._exchanges._prepare(drive)
    assert after is not before
    assert bus._exchanges._prepare(drive) is after
    made = after.of(WANTED).reads[0].exchange
    assert made.settings[0] == drive.settings.baudrate
    assert made.request.address == drive.address
    assert made.c.silence_ns == round(silence(drive) * 1e9)


def test_the_number_of_cached_read_plans_is_limited(bus: Bus, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prepared_reads, "MOST_PREPARED", 3)
    drive = bus.attach(PatientToy, 1)
    for wanted in permutations(WANTED):
        assert set(drive.read_many(wanted)) == {register.name for register in WANTED}
    prepared = bus._exchanges._prepare(drive)
    assert prepared.of.cache_info().currsize == 3


def test_repeated_reads_reuse_their_completion(bus: Bus, monkeypatch: pytest.MonkeyPatch) -> None:
    drive = bus.attach(PatientToy, 1)
    asked = completions_of(bus, monkeypatch)
    first = drive.read_many(WANTED)
    assert [drive.read_many(WANTED) for _ in range(3)] == 3 * [first]
    assert len(asked) == 8
    assert len(set(asked)) == 2
    assert asked[:2] * 4 == asked


def test_concurrent_reads_use_separate_completions(bus: Bus, monkeypatch: pytest.MonkeyPatch) -> None:
    drive = bus.attach(PatientToy, 1)
    value = drive.read(Toy.acceleration_time)
    both = Barrier(2)
    asked = completions_of(bus, monkeypatch, lambda: both.wait(60))
    with ThreadPoolExecutor(2) as threads:
        found = [*threads.map(lambda drive: drive.read(Toy.acceleration_time), 2 * [drive])]
    assert found == 2 * [value]
    assert len(set(asked)) == 2


@pytest.mark.slow
def test_the_completion_of_a_failed_read_is_not_reused(bus: Bus, monkeypatch: pytest.MonkeyPatch) -> None:
    gone = bus.attach(Toy, 3)
    asked = completions_of(bus, monkeypatch)
    for _ in range(2):
        with pytest.raises(NoReply):
            bus._exchanges.values(gone, [Toy.acceleration_time], 1)
    assert len(set(asked)) == len(asked) >= 2


# ---- decoding ----


class Mode(IntEnum):
    OFF = 0
    ON = 1


class Mixed(Drive):
    """A drive with registers that the core decodes and others that it cannot."""

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
    """Return the values of this data, computed with `struct` instead of the core."""
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
        "fine": fine * 123456789 / 10,  # before the division, too many digits for a float
    }


def reply(data: bytes) -> Completion:
    """Return the completion of a read whose reply has this data."""
    return completed(5 + len(data), Message(1, 3, data=data), b"", at_ns=1)


def decoder() -> BlockDecoder:
    return decoder_of(Block.of(Mixed(1), REGISTERS))


@given(st.binary(min_size=2 * WORDS, max_size=2 * WORDS))
def test_each_value_is_decoded_from_its_bytes(data: bytes) -> None:
    found = decoder().decode(reply(data))
    assert found == expected(data)
    assert type(found["pulses"]) is int  # too many digits for a float


@example(bytes(2 * WORDS - 1))
@given(st.binary(max_size=2 * WORDS - 1))
def test_a_short_reply_has_the_values_that_are_complete(data: bytes) -> None:
    block = Block.of(Mixed(1), REGISTERS)
    found = decoder_of(block).decode(reply(data))
    assert found == {one.name: one.value_in(data, one.address - FIRST) for one in REGISTERS}
    assert found["fine"] is None


def test_the_core_decodes_floats() -> None:
    assert set(decoder().names) == {one.name for one in REGISTERS} - {"pulses", "drift", "flow", "fine"}


def test_drives_of_a_model_share_a_decoder_and_other_blocks_do_not() -> None:
    assert decoder_of(Block.of(Mixed(2), REGISTERS)) is decoder()
    assert decoder_of(Block.of(Mixed(2), REGISTERS[1:])) is not decoder()
