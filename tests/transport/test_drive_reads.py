"""Reads with `Bus`: plans are reused until the port, the settings or the drive change. Also raw reads."""

from __future__ import annotations

import itertools
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from enum import IntEnum
from fractions import Fraction
from itertools import permutations
from pathlib import Path
from threading import Barrier
from typing import Any

import checksums
import pytest
from batches import completed
from hypothesis import example, given
from hypothesis import strategies as st
from lines import line, plant, polled, proofs, rows_of, until
from simulated_bus import SimulatedBus, one
from toy import PatientToy, Picky, Toy, expected_values, family

from multidrop.bus import Bus
from multidrop.control.records import read_audit
from multidrop.core import Completion, Exchange, Failure, Message, NumberFormat
from multidrop.drive import Drive
from multidrop.drive.line_settings import Settings
from multidrop.drive.register import HOLDING, reading
from multidrop.errors import BadReply, DriveException, Expired, NoReply, NotAttached
from multidrop.families import DelixiModbus, DelixiNative, InnovertIBD
from multidrop.planning.blocks import Block
from multidrop.planning.bus_time import silence
from multidrop.poller import Poller
from multidrop.sim import EncodedDrive, SimulatedDrive, Simulator, Wire, proof
from multidrop.transport import drive_reads
from multidrop.transport.drive_reads import BlockDecoder, decoder_of

WANTED = (Toy.output_frequency, Toy.mystery, Toy.acceleration_time)


class Counted:
    """Counts how often blocks are planned and exchanges are created."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.plans = self.made = 0
        blocks, make_read = drive_reads.blocks, drive_reads.make_read

        def choose(*given: Any) -> Any:
            self.plans += 1
            return blocks(*given)

        def make(*given: Any, **details: Any) -> Any:
            self.made += 1
            return make_read(*given, **details)

        monkeypatch.setattr(drive_reads, "blocks", choose)
        monkeypatch.setattr(drive_reads, "make_read", make)

    def since(self) -> tuple[int, int]:
        """Return the numbers of plans and new exchanges since the last call."""
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
    """Return a list to which the result of each exchange is appended."""
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
    one.read(Toy.acceleration_time)  # a new plan whose exchange exists since an earlier read
    assert counted.since() == (1, 0)
    other.read_many(WANTED)
    assert counted.since() == (1, 2)


@pytest.mark.slow
def test_detaching_a_drive_removes_its_cached_reads(bus: Bus, counted: Counted) -> None:
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
def test_a_cached_read_uses_changed_settings(bus: Bus, name: str, value: object) -> None:
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
    monkeypatch.setattr(drive_reads, "MOST_PREPARED", 3)
    drive = bus.attach(PatientToy, 1)
    for wanted in permutations(WANTED):
        assert set(drive.read_many(wanted)) == {register.name for register in WANTED}
    prepared = bus._exchanges._prepare(drive)
    assert prepared.of.cache_info().currsize == 3


def test_repeated_reads_reuse_the_memory_of_their_result(bus: Bus, monkeypatch: pytest.MonkeyPatch) -> None:
    drive = bus.attach(PatientToy, 1)
    asked = completions_of(bus, monkeypatch)
    first = drive.read_many(WANTED)
    assert [drive.read_many(WANTED) for _ in range(3)] == 3 * [first]
    assert len(asked) == 8
    assert len(set(asked)) == 2
    assert asked[:2] * 4 == asked


def test_concurrent_reads_use_separate_memory_for_results(bus: Bus, monkeypatch: pytest.MonkeyPatch) -> None:
    drive = bus.attach(PatientToy, 1)
    value = drive.read(Toy.acceleration_time)
    both = Barrier(2)
    asked = completions_of(bus, monkeypatch, lambda: both.wait(60))
    with ThreadPoolExecutor(2) as threads:
        found = [*threads.map(lambda drive: drive.read(Toy.acceleration_time), 2 * [drive])]
    assert found == 2 * [value]
    assert len(set(asked)) == 2


@pytest.mark.slow
def test_the_result_memory_of_a_failed_read_is_not_reused(bus: Bus, monkeypatch: pytest.MonkeyPatch) -> None:
    gone = bus.attach(Toy, 3)
    asked = completions_of(bus, monkeypatch)
    for _ in range(2):
        with pytest.raises(NoReply):
            bus._exchanges.values(gone, [Toy.acceleration_time], 1)
    assert len(set(asked)) == len(asked) >= 2


class Mode(IntEnum):
    OFF = 0
    ON = 1


class Mixed(Drive):
    """A drive with registers that the C core decodes and others that it cannot."""

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
    """Return the values of this data, computed with `struct` instead of the C core."""
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
        "fine": fine * 123456789 / 10,  # more digits than a float has
    }


def reply(data: bytes) -> Completion:
    """Return the result of a read whose reply has this data."""
    return completed(5 + len(data), Message(1, 3, data=data), b"", at_ns=1)


def decoder() -> BlockDecoder:
    return decoder_of(Block.of(Mixed(1), REGISTERS))


@given(st.binary(min_size=2 * WORDS, max_size=2 * WORDS))
def test_each_value_is_decoded_from_its_bytes(data: bytes) -> None:
    found = decoder().decode(reply(data))
    assert found == expected(data)
    assert type(found["pulses"]) is int  # it has more digits than a float


@example(bytes(2 * WORDS - 1))
@given(st.binary(max_size=2 * WORDS - 1))
def test_short_reply_yields_only_completely_received_values(data: bytes) -> None:
    block = Block.of(Mixed(1), REGISTERS)
    found = decoder_of(block).decode(reply(data))
    assert found == {one.name: one.value_in(data, one.address - FIRST) for one in REGISTERS}
    assert found["fine"] is None


def test_values_that_need_exact_arithmetic_are_decoded_in_python() -> None:
    assert set(decoder().names) == {one.name for one in REGISTERS} - {"pulses", "drift", "flow", "fine"}


def test_drives_of_one_model_share_a_decoder_for_equal_reads() -> None:
    assert decoder_of(Block.of(Mixed(2), REGISTERS)) is decoder()
    assert decoder_of(Block.of(Mixed(2), REGISTERS[1:])) is not decoder()


WIDE = 24


def picky(**faults: Any) -> tuple[Drive, Picky, SimulatedBus]:
    """Return a drive on a bus with registers 0 to WIDE - 1, its simulation with these faults, and the bus."""
    drive = family(WIDE)(1, name="pump-1")
    sim = Picky(drive, **faults)
    bus = SimulatedBus(sim)
    bus.attach(drive)
    return drive, sim, bus


def test_split_of_a_refused_read_is_kept_until_the_port_is_reopened() -> None:
    drive, sim, bus = picky(most=8)
    first = drive.read_many(drive.registers.values())
    assert first == expected_values(range(WIDE))
    assert [count for _, count in sim.asked] == [24, 12, 6, 6, 12, 6, 6]
    sim.asked.clear()
    assert drive.read_many(drive.registers.values()) == first
    assert [count for _, count in sim.asked] == [6] * 4
    bus.queue = object()  # a new queue, as after the port was reopened
    sim.asked.clear()
    assert drive.read_many(drive.registers.values()) == first
    assert sim.asked[0] == (0, WIDE)


def test_the_error_for_a_refused_request_names_the_refused_register() -> None:
    drive, sim, _ = picky(refused={3})
    with pytest.raises(DriveException, match=r"^pump-1 refuses r3: ") as caught:
        drive.read_many(drive.registers.values())
    assert caught.value.register == "r3"
    assert sim.asked[-1] == (3, 1)
    assert len(sim.asked) <= 11
    sim.asked.clear()
    with pytest.raises(DriveException, match=r"^pump-1 refuses r3: "):
        drive.read_many(drive.registers.values())
    assert sim.asked == [(3, 1)]  # only the refused register is requested again
    sim.missing.clear()
    assert drive.read_many(drive.registers.values()) == expected_values(range(WIDE))
    others = [register for register in drive.registers.values() if register.address != 3]
    assert drive.read_many(others) == expected_values(set(range(WIDE)) - {3})


@given(st.sets(st.integers(0, 5), max_size=2), st.integers(1, 6), st.sets(st.integers(0, 5), min_size=1))
def test_a_failed_read_reports_a_refused_register(refused: set[int], most: int, asked: set[int]) -> None:
    drive = family(6)(1, name="pump-1")
    bus = SimulatedBus(Picky(drive, refused, most)).bus
    bus.attach(drive)
    registers = [drive.register(f"r{at}") for at in sorted(asked)]
    for _ in range(2):  # the second read starts with the smaller blocks that the first one has found
        if not refused & asked:
            assert drive.read_many(registers) == expected_values(asked)
            continue
        with pytest.raises(DriveException) as caught:
            drive.read_many(registers)
        assert caught.value.register in {f"r{at}" for at in refused & asked}


@pytest.mark.parametrize("code", [1, 5, 6])
def test_a_request_to_a_busy_drive_is_not_split(code: int, monkeypatch: pytest.MonkeyPatch) -> None:
    drive, sim, _ = picky()
    sim.limit = 0
    monkeypatch.setattr(sim, "_code", lambda reason: code)
    with pytest.raises(DriveException):
        drive.read_many(drive.registers.values())
    assert sim.asked == [(0, WIDE)]


def test_error_names_no_register_if_several_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    scaled = {"flow": reading(2, scale_register="power"), "power": reading(3, number_format=NumberFormat.I16)}
    drive = family(2, **scaled)(1, name="pump-1")
    bus = SimulatedBus(sim := Picky(drive))
    bus.attach(drive)
    sim.limit = 0
    monkeypatch.setattr(sim, "_code", lambda reason: 6)
    with pytest.raises(DriveException, match=r"^pump-1 refuses: ") as caught:
        drive.read(drive.register("r1"), drive.register("flow"))
    assert caught.value.register is None


def test_a_long_request_without_a_reply_is_split() -> None:
    drive, sim, _ = picky(silent_beyond=8)
    assert drive.read_many(drive.registers.values()) == expected_values(range(WIDE))
    sim.asked.clear()
    assert drive.read_many(drive.registers.values()) == expected_values(range(WIDE))
    assert [count for _, count in sim.asked] == [6] * 4


def test_a_dead_drive_gets_only_one_additional_shorter_request() -> None:
    drive, sim, _ = picky(silent_beyond=0)
    with pytest.raises(NoReply):
        drive.read_many(drive.registers.values())
    assert sim.asked == [(0, WIDE)] * 3 + [(0, 1)]
    sim.silent_beyond = 125
    assert drive.read_many(drive.registers.values()) == expected_values(range(WIDE))
    sim.asked.clear()
    sim.silent_beyond = 1  # the drive once answered the whole block, so the block is not split
    with pytest.raises(NoReply):
        drive.read_many(drive.registers.values())
    assert sim.asked == [(0, WIDE)] * 3


@pytest.mark.parametrize("silent", [{1}, {1, 2}, {0, 2}])
def test_wrong_address_is_reported_even_if_other_attempts_get_no_reply(silent: set[int]) -> None:
    """The attempts in `silent` get no reply. The other attempts get a reply from another address."""
    drive = family(2)(1, name="pump-1")
    bus = SimulatedBus(Picky(drive))
    bus.attach(drive)
    attempts = itertools.count()
    foreign = checksums.rtu(bytes.fromhex("63 03 02 00 07"))
    bus.loses = lambda request: next(attempts) in silent
    bus.answers = lambda request: foreign
    with pytest.raises(BadReply, match="another address"):
        drive.read_many(drive.registers.values())


@pytest.fixture
def simulated(tmp_path: Path) -> Iterator[SimulatedBus]:
    toy = SimulatedDrive(Toy(7))
    toy["output_frequency"], toy["output_current"] = 12.3, 1.5
    bus = SimulatedBus(toy, audit=tmp_path / "audit.jsonl")
    bus.attach(toy.drive)
    with bus.bus:
        yield bus


@pytest.fixture
def toy(simulated: SimulatedBus) -> Drive:
    (toy,) = simulated.bus.drives
    return toy


def test_a_raw_read_matches_the_example_in_the_standard(simulated: SimulatedBus, toy: Drive) -> None:
    """The request is that of the application protocol V1.1b3, 6.3; its CRC was calculated separately."""
    assert toy.read_raw(3, 1, 2) == bytes.fromhex("007B 0096")
    assert [frame for _, frame in simulated.frames] == ["07 03 00 01 00 02 95 AD"]


def test_a_raw_read_is_not_treated_as_a_write(simulated: SimulatedBus, toy: Drive, tmp_path: Path) -> None:
    """The read is not audited, retried or reported as unconfirmed, and no identity check precedes it."""
    simulated.loses = lambda request: True
    with pytest.raises(NoReply):
        toy.read_raw(3, 1, 2)
    assert len(simulated.frames) == 1
    assert list(read_audit(tmp_path / "audit.jsonl")) == []


def test_an_exception_reply_to_a_raw_read_raises_an_error(simulated: SimulatedBus, toy: Drive) -> None:
    with pytest.raises(DriveException) as refusal:
        toy.read_raw(3, 0x4000, 1)
    assert refusal.value.code == 2


def test_a_raw_read_expires_if_it_cannot_start_in_time(simulated: SimulatedBus, toy: Drive) -> None:
    simulated.queue_time = 0.3
    with pytest.raises(Expired, match=r"a read of 2 from 1 by function 03H was not sent: .* within 0.2 s"):
        toy.read_raw(3, 1, 2, expiry=0.2)
    assert simulated.frames == []
    assert toy.read_raw(3, 1, 2, expiry=0.4) == bytes.fromhex("007B 0096")


def test_a_raw_read_waits_for_late_replies_only_until_it_expires(
    monkeypatch: pytest.MonkeyPatch, simulated: SimulatedBus, toy: Drive
) -> None:
    found = completed(int(Failure.LATE_ANSWER_DUE), Message(0, 0), b"", at_ns=0)
    found.c.late_until_ns = round((simulated.seconds + 60) * 1e9)
    monkeypatch.setattr(simulated, "carry_out", lambda exchange, **times: found)
    begun = simulated.seconds
    with pytest.raises(Expired, match=r"was not sent: .* within 0.2 s"):
        toy.read_raw(3, 1, 2, expiry=0.2)
    assert simulated.seconds - begun < 0.21


def test_a_copy_of_the_request_is_not_returned_as_a_raw_reply(simulated: SimulatedBus, toy: Drive) -> None:
    """The reply to a read of 17 coils from 03xxH has its request's length and first three bytes."""
    echo = checksums.rtu(bytes.fromhex("07 01 03 20 00 11"))
    simulated.answers = lambda request: echo
    with pytest.raises(BadReply, match="copy of the request"):
        toy.read_raw(1, 0x320, 17)
    assert simulated.frames[0][1] == echo.hex(" ").upper()
    simulated.has_echo = True  # on a line known to echo, a copy and a reply are distinguishable
    assert toy.read_raw(1, 0x320, 17) == bytes.fromhex("20 00 11")


WRONG = {
    (6, 1, 1): "function = 6 is not a function that reads; use 1, 2, 3, 4",
    (0, 1, 1): "function = 0 is not a function that reads",
    (3, -1, 1): "start = -1 is not an address from 0 to 65535",
    (3, 65536, 1): "start = 65536 is not an address",
    (3, 65535, 2): r"start \+ count = 65537 is beyond the last address, 65535",
    (3, 1, 0): "count = 0 is outside 1 to 10, the limit of one request to toy@7",
    (3, 1, 11): "count = 11 is outside 1 to 10",  # the family's limit
    (4, 1, 126): "count = 126 is outside 1 to 125",
    (1, 1, 2001): "count = 2001 is outside 1 to 2000",
}


@pytest.mark.parametrize("asked", WRONG)
def test_an_impossible_raw_read_raises_before_any_frame_is_sent(
    simulated: SimulatedBus, toy: Drive, asked: tuple[int, int, int]
) -> None:
    with pytest.raises(ValueError, match=WRONG[asked]):
        toy.read_raw(*asked)
    assert simulated.frames == []


@pytest.mark.parametrize("asked", [(True, 1, 1), (3, 1.0, 1), (3, 1, "2")])
def test_a_raw_read_with_a_count_that_is_not_a_number_raises(
    simulated: SimulatedBus, toy: Drive, asked: tuple[int, int, int]
) -> None:
    with pytest.raises(TypeError, match="is not a whole number"):
        toy.read_raw(*asked)
    for expiry in (0, -1, float("nan"), float("inf"), True):
        with pytest.raises(ValueError, match="must be a number of seconds above 0"):
            toy.read_raw(3, 1, 1, expiry=expiry)
    assert simulated.frames == []


@pytest.mark.parametrize("function", [1, 2, 3, 4])
def test_send_raw_refuses_read_functions(simulated: SimulatedBus, toy: Drive, function: int) -> None:
    """A read sent as a write would wait so long that a late reply to an earlier read could be accepted."""
    with pytest.raises(
        ValueError, match=rf"{function:02X}H, which reads: call drive.read_raw\({function}, 80, 2\)"
    ):
        toy.send_raw(function, 80, count=2)
    assert simulated.frames == []


def test_a_raw_read_respects_the_familys_limits() -> None:
    _, native, _ = one(DelixiNative(1))
    with pytest.raises(ValueError, match="speaks Delixi's own protocol"):
        native.read_raw(3, 1, 1)
    bus, modbus, _ = one(DelixiModbus(1))
    with pytest.raises(ValueError, match="count = 2 is outside 1 to 1"):
        modbus.read_raw(3, 1, 2)
    with pytest.raises(NotAttached, match="fan is not attached to a bus: use bus"):
        InnovertIBD(1, name="fan").read_raw(3, 1, 1)
    assert bus.frames == []


@pytest.mark.slow
def test_a_raw_read_works_on_a_polled_line() -> None:
    """Even on a busy computer, neither the poller nor the raw read accepts a reply to the other's request."""
    drive = polled(Toy(1), [Toy.output_frequency, Toy.mystery])
    expected = proofs(drive)
    status = int(proof(drive.drive, Toy.status)).to_bytes(2)
    answers = Counter[bytes]()
    with Simulator([Wire([EncodedDrive(Toy(1))], unpaced=True)]) as sim:
        with Poller(plant(line(sim.wires[0].path, drive))) as poller:

            def asked() -> bool:
                with suppress(NoReply, BadReply):
                    answers[drive.drive.read_raw(3, Toy.status.address, 1, expiry=60.0)] += 1
                return answers.total() >= 20

            until(asked)
            polls = poller.summary()["samples"]
            until(lambda: poller.summary()["samples"] > polls + 20)
        rows = rows_of(poller)
    assert set(answers) == {status}
    good = [row for row in rows if row.status == "ok"]
    assert {row.register: row.value for row in good} == {name: value for (_, name), value in expected.items()}
    assert all(row.value == expected[row.drive, row.register] for row in good)
