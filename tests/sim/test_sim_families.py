"""The simulated drive of every family replies to whole frames as its document says.

A frame whose checksum is written out is printed in the family's manual, unless its comment says that it was
written by hand. checksums.py computes the checksums of all other frames.
"""

from __future__ import annotations

from collections.abc import Callable

import checksums
import pytest
from tables import table

from multidrop.core import Framing, Message, build_request, parse_reply
from multidrop.drive import Drive
from multidrop.drive.register import HOLDING, Carrier, setting
from multidrop.families.delixi import PARAMETER, DelixiModbus, DelixiNative
from multidrop.families.erman_er_g_220 import ErmanERG220
from multidrop.families.innovert_ibd import InnovertIBD
from multidrop.families.invt_che import InvtCHE, parameter
from multidrop.families.yd1000 import YD1000
from multidrop.sim import EncodedDrive, MotorDrive, Wire, encoded, simulated
from multidrop.sim.families import SimulatedCHE, SimulatedDelixiNative, SimulatedYD1000


class Bench:
    """One simulated drive on a wire without delays, and its simulated time."""

    def __init__(self, drive: Drive) -> None:
        sim = simulated(drive)
        assert isinstance(sim, MotorDrive)
        self.sim = sim
        self.motor = sim.motor
        self.wire = Wire([sim], unpaced=True)
        self.now = 100.0

    def send(self, frame: bytes) -> bytes:
        """Send a frame; return the reply, empty if the drive does not reply."""
        self.wire.receive(frame, self.now)
        self.now += 0.1
        return self.wire.advance(self.now)

    def exchange(self, frame: str) -> str:
        """Send a frame and return the reply as documents print them: RTU in hex, text without line end."""
        if frame.startswith(":"):
            return self.send(f"{frame}\r\n".encode()).decode().removesuffix("\r\n")
        return self.send(bytes.fromhex(frame)).hex(" ").upper()

    def read(self, function: int, start: int, count: int = 1) -> list[int]:
        """Read `count` registers; return their raw counts."""
        reply = self.sim.answer(Message(self.sim.drive.address, function, start, count), self.now)
        assert reply is not None
        assert not reply.exception
        return [int.from_bytes(reply.data[at : at + 2]) for at in range(0, len(reply.data), 2)]

    def write(self, start: int, value: int, function: int = 6) -> int | None:
        """Write a register; return the exception code, 0 if confirmed, None without a reply."""
        data = value.to_bytes(4 if function == 4 else 2)
        reply = self.sim.answer(Message(self.sim.drive.address, function, start, data=data), self.now)
        return None if reply is None else reply.exception

    def wait(self, seconds: float) -> None:
        self.now += seconds
        self.motor.run_to(self.now)


@pytest.fixture
def erman() -> Bench:
    return Bench(ErmanERG220(1))


def test_simulated_erman_control_registers_are_read_as_documented(erman: Bench) -> None:
    erman.sim["control_register"] = 0x0100
    erman.sim["frequency"] = 50.0
    erman.sim["maximum_frequency"] = 50.0
    erman.sim["minimum_frequency"] = 5.0
    assert erman.exchange("01 03 00 01 00 04 15 C9") == "01 03 08 01 00 01 F4 01 F4 00 32 25 C4"


def test_simulated_erman_state_registers_are_read_as_documented(erman: Bench) -> None:
    erman.sim["output_frequency"] = 50.0
    erman.sim["output_current"] = 21.4
    erman.sim["dc_bus_voltage"] = 562
    assert erman.exchange("01 04 00 01 00 05 61 C9") == "01 04 0A 01 F4 00 00 00 D6 00 00 02 32 7F 1B"


def test_simulated_erman_writes_several_registers_with_function_10h(erman: Bench) -> None:
    assert erman.exchange("01 10 00 0C 00 02 04 00 C8 01 90 73 F8") == "01 10 00 0C 00 02 81 CB"
    assert (erman.sim["acceleration_time"], erman.sim["deceleration_time"]) == (20, 40)
    assert (erman.motor.acceleration_time, erman.motor.deceleration_time) == (20, 40)
    assert erman.exchange("01 0F 00 00 00 09 02 01 01 25 2C") == "01 0F 00 00 00 09 95 CD"


def test_simulated_erman_coils_are_read_as_documented(erman: Bench) -> None:
    assert erman.exchange("01 01 00 00 00 0C 3C 0F")[:11] == "01 01 02 00"
    erman.exchange("01 05 00 00 FF 00 8C 3A")
    assert erman.exchange("01 01 00 00 00 0C 3C 0F")[:14] == "01 01 02 01 00"


@pytest.mark.parametrize(
    ("request_", "reply"),
    [
        (Message(1, 1, 0x0C, 2), "01 81 03 00 51"),
        (Message(1, 3, 0x59, 1), "01 83 03 01 31"),
        (Message(1, 3, 0, 89), "01 83 03 01 31"),
        (Message(1, 4, 0x1000, 1), "01 84 03 03 01"),
        (Message(1, 5, 0x0D, data=b"\xff\x00"), "01 85 03 02 91"),
        (Message(1, 6, 0x59, data=b"\x00\x01"), "01 86 03 02 61"),
        (Message(1, 0x0F, 0x0C, 2, b"\x00"), "01 8F 03 04 31"),
        (Message(1, 0x10, 0x58, 2, b"\x00\x00\x00\x00"), "01 90 03 0C 01"),
    ],
)
def test_simulated_erman_refuses_addresses_as_documented(erman: Bench, request_: Message, reply: str) -> None:
    assert erman.send(build_request(Framing.RTU, request_)) == bytes.fromhex(reply)


def test_simulated_erman_refuses_an_unknown_function_with_exception_01(erman: Bench) -> None:
    assert erman.send(checksums.rtu("01 2B")) == checksums.rtu("01 AB 01")


@pytest.mark.parametrize(
    "frame",
    [
        bytes.fromhex("01 04 00 01 00 05 15 C9"),  # the checksum is wrong in the document
        checksums.rtu("02 04 00 01 00 05"),  # the request is for another drive
        checksums.rtu("00 05 00 01 FF 00"),  # a broadcast
        checksums.rtu("01 03 00 01 00"),  # the request is too short
        checksums.rtu("01 10 00 0C 00 02 03 00 C8 01"),
    ],
)
def test_simulated_erman_ignores_damaged_foreign_and_broadcast_frames(erman: Bench, frame: bytes) -> None:
    assert erman.send(frame) == b""
    assert erman.sim.counters.replies == 0


def test_simulated_erman_ramps_the_motor_at_start_and_stop(erman: Bench) -> None:
    erman.exchange("01 06 00 02 01 1D E9 93")  # setpoint 28.5 Hz
    assert erman.read(4, 0x400, 2) == [0, 0]
    erman.exchange("01 05 00 00 FF 00 8C 3A")
    erman.wait(1)
    assert erman.read(4, 0x400, 2) == [0, 2]
    erman.wait(60)
    assert erman.read(4, 0x400, 2) == [0, 1]
    assert erman.read(4, 0x01) == [285]
    erman.exchange("01 05 00 01 FF 00 DD FA")  # stop (frame made by hand from the manual's tables)
    erman.wait(0.1)
    assert erman.read(4, 0x400, 2) == [0, 3]
    erman.wait(60)
    assert (erman.read(4, 0x400, 2), erman.read(4, 0x01)) == ([0, 0], [0])


def test_simulated_erman_ignores_a_start_while_the_stop_coil_is_on(erman: Bench) -> None:
    erman.exchange("01 06 00 02 01 1D E9 93")
    erman.exchange("01 05 00 01 FF 00 DD FA")  # stop on
    erman.exchange("01 05 00 00 FF 00 8C 3A")  # start on
    assert not erman.motor.energised
    erman.exchange("01 05 00 01 00 00 9C 0A")  # stop off
    assert not erman.motor.energised
    erman.exchange("01 05 00 00 FF 00 8C 3A")
    assert erman.motor.energised


def test_simulated_erman_emergency_stop_prevents_a_start_until_a_reset(erman: Bench) -> None:
    erman.exchange("01 05 00 00 FF 00 8C 3A")
    erman.exchange("01 05 00 02 FF 00 2D FA")  # emergency stop (frame made by hand from the manual's tables)
    assert not erman.motor.energised
    assert erman.read(4, 0x402, 2) == [0, 1]
    erman.send(checksums.rtu("01 05 00 02 00 00"))
    erman.exchange("01 05 00 00 FF 00 8C 3A")
    assert not erman.motor.energised
    erman.exchange("01 05 00 09 FF 00 5C 38")  # reset (frame made by hand from the manual's tables)
    assert not erman.motor.energised
    assert erman.read(4, 0x402, 2) == [0, 1]
    erman.exchange("01 05 00 00 FF 00 8C 3A")
    assert erman.motor.energised


class MyCHE(InvtCHE):
    jump = parameter(8)
    acceleration_time = parameter(11, "s", step=0.1, default=10)
    locked = parameter(12, while_running=False)


@pytest.fixture
def che() -> Bench:
    return Bench(MyCHE(1, maximum_frequency=60))


def test_simulated_invt_che_device_code_register_reads_0101h(che: Bench) -> None:
    assert che.exchange("01 03 30 16 00 01 6A CE")[:14] == "01 03 02 01 01"


def test_simulated_invt_che_stores_a_written_parameter() -> None:
    che = Bench(MyCHE(2))
    frame = "02 06 00 08 13 88 05 6D"  # example in section 11.6.2 of the CHE manual
    assert che.exchange(frame) == frame
    assert che.sim["jump"] == 0x1388


def test_simulated_invt_che_setpoint_is_a_percentage_of_the_maximum_frequency(che: Bench) -> None:
    che.exchange("01 06 20 00 13 88 8F 5C")  # 50.00 %
    che.exchange("01 06 10 00 00 01 4C CA")
    che.wait(60)
    assert che.read(3, 0x3000) == [3000]
    assert che.read(3, 0x3001) == [3000]
    assert che.read(3, 0x1001) == [1]


def test_simulated_invt_che_runs_in_reverse_at_a_negative_setpoint(che: Bench) -> None:
    assert che.write(0x2000, 0x10000 - 5000) == 0
    che.write(0x1000, 1)
    che.wait(60)
    assert che.motor.frequency == pytest.approx(-30)
    assert che.read(3, 0x1001) == [2]
    assert che.write(0x2000, 10_001) == 0x12


@pytest.mark.parametrize(("word", "stopped_after"), [(5, False), (6, True), (8, False)])
def test_simulated_invt_che_ramps_down_or_coasts(che: Bench, word: int, stopped_after: bool) -> None:
    che.write(0x2000, 10_000)
    che.write(0x1000, 2)
    che.wait(60)
    assert che.read(3, 0x1001) == [2]
    che.write(0x1000, word)
    che.wait(0.01)
    assert (che.read(3, 0x1001) == [3]) is stopped_after
    che.wait(60)
    assert che.read(3, 0x1001) == [3]


def test_simulated_invt_che_refuses_a_start_during_a_fault_until_a_reset(che: Bench) -> None:
    che.sim.trip(10)
    assert (che.read(3, 0x1001), che.read(3, 0x5000)) == ([4], [10])
    assert che.write(0x1000, 1) == 0x01  # the manual uses this code also for a command during a fault
    assert che.write(0x1000, 7) == 0
    assert (che.read(3, 0x1001), che.read(3, 0x5000)) == ([3], [0])


@pytest.mark.parametrize(
    ("body", "reply"),
    [
        ("01 03 40 00 00 01", "01 83 02"),  # undefined address
        ("01 03 80 0B 00 01", "01 83 02"),  # the address in RAM cannot be read
        ("01 03 30 00 00 11", "01 83 03"),  # 17 registers are one too many
        ("01 06 10 00 00 09", "01 86 12"),
        ("01 04 30 00 00 01", "01 84 01"),
    ],
)
def test_simulated_invt_che_refuses_requests_as_documented(che: Bench, body: str, reply: str) -> None:
    assert che.send(checksums.rtu(body)) == checksums.rtu(reply)


def test_simulated_invt_che_refuses_a_write_while_it_stores_the_previous_one(che: Bench) -> None:
    assert isinstance(che.sim, SimulatedCHE)
    che.sim.storing = 0.5
    assert che.write(11, 50) == 0
    assert che.write(11, 60) == 6
    assert che.read(3, 0x5001) == [8]
    che.wait(0.6)
    assert che.write(11, 60) == 0


def test_simulated_invt_che_refuses_to_change_a_locked_parameter_while_running(che: Bench) -> None:
    che.write(0x2000, 5000)
    assert che.write(12, 1) == 0
    che.write(0x1000, 1)
    assert che.write(12, 2) == 0x12
    assert che.sim["locked"] == 1


def test_simulated_invt_che_replies_to_a_damaged_frame_with_exception_11h(che: Bench) -> None:
    assert che.send(bytes.fromhex("01 03 10 01 00 01 D1 0B")) == checksums.rtu("01 83 11")
    assert che.send(bytes.fromhex("02 03 10 01 00 01 D1 0B")) == b""
    assert che.sim.counters.damaged == 1


@pytest.fixture
def ibd() -> Bench:
    return Bench(InnovertIBD(1))


def test_simulated_innovert_ibd_reports_the_bits_of_its_terminals(ibd: Bench) -> None:
    assert ibd.exchange("01 03 00 16 00 01 65 CE") == "01 03 02 18 00 B2 44"


def test_simulated_innovert_ibd_outputs_show_the_motors_state(ibd: Bench) -> None:
    ibd.exchange("01 06 20 01 13 88 DE 9C")
    ibd.exchange("01 06 20 00 00 02 03 CB")
    ibd.wait(1)
    assert ibd.read(3, 22) == [0x1800 | 1 << 8 | 1 << 9]
    ibd.wait(60)
    assert ibd.read(3, 22) == [0x1800 | 1 << 8]
    ibd.exchange("01 06 20 00 00 01 43 CA")
    ibd.wait(1)
    assert ibd.read(3, 22) == [0x1800 | 1 << 8 | 1 << 10]
    ibd.sim.trip(1)
    assert ibd.read(3, 22) == [0x1800 | 1 << 13]
    ibd.sim["output_virtual"] = 1
    assert ibd.read(3, 22) == [0x1800]


def test_a_running_simulated_innovert_ibd_is_reversed_by_direction_bits_alone(ibd: Bench) -> None:
    assert ibd.write(0x2001, 2000) == 0
    # bits for reverse, for forward, and both bits together, which mean reverse
    for bits, direction in ((0x06, -1), (0x08, 1), (0x0C, -1)):
        assert ibd.write(0x2000, bits) == 0
        assert ibd.motor.direction == direction
        assert ibd.motor.energised


def test_simulated_innovert_ibd_jogs_until_a_stop_command(ibd: Bench) -> None:
    ibd.write(0x2001, 5000)
    ibd.write(0x2000, 3)
    ibd.wait(60)
    assert ibd.write(0x2000, 2) == 0  # the run command is confirmed, but has no effect during a jog
    ibd.wait(60)
    assert ibd.motor.frequency == ibd.motor.jog_frequency
    ibd.write(0x2000, 0)
    ibd.write(0x2000, 2)
    ibd.wait(60)
    assert ibd.motor.frequency == ibd.motor.jog_frequency
    ibd.write(0x2000, 1)
    ibd.write(0x2000, 2)
    ibd.wait(60)
    assert ibd.motor.frequency == 50


def test_fault_ends_jogging_of_a_simulated_innovert_ibd(ibd: Bench) -> None:
    ibd.write(0x2001, 5000)
    ibd.write(0x2000, 3)
    ibd.sim.trip(1)
    ibd.write(0x2000, 0x10)
    ibd.write(0x2000, 2)
    ibd.wait(60)
    assert ibd.motor.frequency == 50


def test_simulated_innovert_ibd_obeys_the_line_only_if_configured(ibd: Bench) -> None:
    ibd.write(0x2001, 5000)
    ibd.write(102, 0)  # Prb.02
    assert ibd.write(0x2000, 2) == 0
    assert not ibd.motor.energised
    ibd.write(102, 2)
    ibd.write(100, 3000)  # Prb.00
    ibd.write(101, 0)  # Prb.01
    ibd.write(0x2000, 2)
    ibd.wait(60)
    assert ibd.motor.frequency == 30
    ibd.write(101, 5)
    ibd.wait(60)
    assert ibd.motor.frequency == 50


def test_simulated_innovert_ibd_stores_the_maximum_for_a_larger_value(ibd: Bench) -> None:
    assert ibd.write(107, 60_000) == 0
    assert ibd.read(3, 107) == [36_000]
    assert ibd.write(0x2001, 50_000) == 0
    assert ibd.sim["frequency"] == 400


@pytest.mark.parametrize(
    ("function", "start", "count"), [(3, 107, 5), (3, 0x2000, 1), (3, 50, 1), (4, 3, 1), (0x10, 107, 1)]
)
def test_simulated_innovert_ibd_ignores_invalid_requests(
    ibd: Bench, function: int, start: int, count: int
) -> None:
    data = b"\0\1" if function == 0x10 else b""
    assert ibd.sim.answer(Message(1, function, start, count, data), 0.0) is None
    assert len(ibd.read(3, 100, 3)) == 3


def test_simulated_innovert_ibd_replies_to_a_read_of_4_registers_but_not_5(ibd: Bench) -> None:
    """All five registers are readable, so only their number can be the reason for the silence."""
    ibd.sim.memory.make_readable(HOLDING, range(100, 105))
    assert len(ibd.read(3, 100, 4)) == 4
    assert ibd.sim.answer(Message(1, 3, 100, 5), 0.0) is None


def test_simulated_innovert_ibd_carries_out_a_broadcast_without_a_reply(ibd: Bench) -> None:
    ibd.exchange("01 06 20 01 13 88 DE 9C")
    ibd.exchange("01 06 20 00 00 02 03 CB")
    ibd.wait(60)
    assert ibd.exchange("00 06 20 00 00 01 42 1B") == ""  # stop (frame made by hand from the manual's tables)
    ibd.wait(60)
    assert not ibd.motor.energised


def test_command_word_10h_resets_a_fault_of_a_simulated_innovert_ibd(ibd: Bench) -> None:
    ibd.sim.trip(1)
    ibd.exchange("01 06 20 00 00 10 83 C6")  # frame made by hand from the manual's tables
    assert (ibd.motor.fault, ibd.motor.energised) == (0, False)


@pytest.fixture
def delixi() -> Bench:
    return Bench(DelixiModbus(1))


def test_simulated_delixi_output_frequency_is_read_as_documented(delixi: Bench) -> None:
    delixi.exchange("01 06 00 02 13 88 25 5C")
    delixi.exchange("01 06 20 00 00 12 02 07")
    delixi.wait(60)
    assert delixi.exchange("01 03 01 F4 00 01 C4 04") == "01 03 02 13 88 B5 12"
    delixi.sim.trip(9)
    assert delixi.read(3, 0x0213) == [9]
    assert delixi.read(3, 0x020D) == [9]


def test_simulated_delixi_output_frequency_is_read_in_ascii_as_documented() -> None:
    delixi = Bench(DelixiModbus(1, framing=Framing.ASCII))
    delixi.sim["output_frequency"] = 50
    assert delixi.exchange(":010301F4000106") == ":01030213885F"


def test_simulated_delixi_obeys_the_line_only_if_configured(delixi: Bench) -> None:
    delixi.exchange("01 06 00 02 13 88 25 5C")
    delixi.sim["run_source"] = 0  # P00.00
    assert delixi.exchange("01 06 20 00 00 12 02 07") == "01 06 20 00 00 12 02 07"
    assert not delixi.motor.energised
    delixi.sim["run_source"] = 2
    delixi.sim["frequency_source"] = 0  # P00.01
    delixi.exchange("01 06 20 00 00 12 02 07")
    delixi.wait(60)
    assert (delixi.motor.energised, delixi.motor.frequency) == (True, 0)


def test_simulated_delixi_reverse_command_turns_the_motor_in_reverse(delixi: Bench) -> None:
    delixi.exchange("01 06 00 02 13 88 25 5C")
    delixi.exchange("01 06 20 00 00 22 02 13")  # frame made by hand from the manual's tables
    delixi.wait(60)
    assert delixi.motor.frequency == -50


@pytest.mark.parametrize(("function", "start", "count"), [(3, 0x01F4, 2), (3, 0x9999, 1), (4, 0x01F4, 1)])
def test_simulated_delixi_ignores_invalid_requests(
    delixi: Bench, function: int, start: int, count: int
) -> None:
    assert delixi.sim.answer(Message(1, function, start, count), 0.0) is None


def test_simulated_delixi_obeys_only_run_commands_among_broadcasts(delixi: Bench) -> None:
    delixi.sim.answer(Message(0, 6, 2, data=b"\x13\x88"), 0.0)
    assert delixi.sim["frequency"] == 0
    delixi.sim.answer(Message(0, 6, 0x2000, data=b"\x00\x12"), 0.0)
    assert delixi.motor.energised


@pytest.fixture
def native() -> Bench:
    return Bench(DelixiNative(1))


def test_simulated_delixi_native_frequency_and_run_state_are_read(native: Bench) -> None:
    # A frame made by hand from the manual's tables. State 1 means stopped.
    assert native.exchange(":010300000000000004")[:9] == ":01030001"
    native.exchange(":0104000100001388A1")
    native.exchange(":010200020000000005")
    native.wait(60)
    assert native.exchange(":010701F400000000FD") == ":010701F40000138898"
    assert native.exchange(":010300000000000004")[:9] == ":01030002"
    native.exchange(":010200030000000006")  # reverse (frame made by hand from the manual's tables)
    native.wait(60)
    assert native.exchange(":010300000000000004")[:9] == ":01030003"


@pytest.mark.parametrize(
    ("fault", "shown", "state"),
    [(9, "00000009", 4), (10, "00000010", 4), (14, "00000014", 4), (7, "00000007", 5)],
)
def test_simulated_delixi_native_sends_fault_numbers_as_decimal_digits(
    native: Bench, fault: int, shown: str, state: int
) -> None:
    native.sim.trip(fault)
    assert native.exchange(":01070213000000001D")[9:17] == shown
    assert native.sim["fault"] == fault
    for number, record in enumerate((shown, "00000000", "00000000", "00000000")):
        asked = checksums.delixi(f"0107{0x020D + number:04X}00000000")
        assert native.send(asked)[9:17].decode() == record
    assert native.exchange(":010300000000000004")[5:9] == f"{state:04X}"
    assert native.exchange(":010200040000000007") == ":010200040000000007"  # reset
    assert native.exchange(":010300000000000004")[5:9] == "0001"


@pytest.mark.parametrize(
    ("frame", "reply"),
    [
        (checksums.delixi("0102000900000000"), b":01F0000000000000F1\r\n"),  # this run command does not exist
        # this parameter does not exist
        (checksums.delixi("0107270F00000000"), checksums.delixi("01FC000000000000")),
        (b":010200020000000006\r\n", b":01FF00000000000000\r\n"),  # the checksum 06 is wrong; 05 is right
        (b":0102000205\r\n", b""),  # the request is too short
    ],
)
def test_simulated_delixi_native_sends_documented_errors(native: Bench, frame: bytes, reply: bytes) -> None:
    assert native.send(frame) == reply


class MyNative(DelixiNative):
    ramp = setting(17, "s", step=0.1, span=(0.1, 600), table=PARAMETER, while_running=False)


def test_simulated_delixi_native_refuses_wrong_values_and_locked_parameters() -> None:
    native = Bench(MyNative(1))
    assert native.send(checksums.delixi("0106001100000064")) == checksums.delixi("0106001100000064")
    assert native.send(checksums.delixi("0106001100001771")) == checksums.delixi(
        "01FD000000000000"
    )  # 600.1 s
    native.exchange(":010200020000000005")
    assert native.send(checksums.delixi("0106001100000032")) == checksums.delixi("01FE000000000000")
    assert native.sim["ramp"] == 10


def test_simulated_delixi_native_refuses_a_start_during_a_fault(native: Bench) -> None:
    native.sim.trip(1)
    assert native.exchange(":010200020000000005") == ":01F0000000000000F1"
    assert not native.motor.energised


def test_simulated_delixi_native_refuses_parameter_writes_while_locked(native: Bench) -> None:
    assert isinstance(native.sim, SimulatedDelixiNative)
    native.sim.locked = True
    locked = checksums.delixi("01FE000000000000")
    assert native.exchange(":0106000200001388A4").encode() + b"\r\n" == locked
    assert native.send(checksums.delixi("0105000200001388")) == locked
    # the setpoint in RAM is not locked
    assert native.exchange(":0104000100001388A1") == ":0104000100001388A1"
    assert native.exchange(":010200020000000005") == ":010200020000000005"
    native.sim.locked = False
    assert native.exchange(":0106000200001388A4") == ":0106000200001388A4"


def test_simulated_delixi_native_refuses_run_commands_if_the_keypad_is_selected(native: Bench) -> None:
    native.sim["run_source"] = 0  # P00.00
    assert native.exchange(":010200020000000005") == ":01F0000000000000F1"
    assert not native.motor.energised


def test_only_function_06_wears_the_eeprom_of_a_simulated_delixi_native(native: Bench) -> None:
    native.exchange(":0104000100001388A1")
    assert not native.sim.counters.eeprom_writes
    native.exchange(":0106000200001388A4")
    assert native.sim.counters.eeprom_writes == {"stored_frequency": 1}


def test_simulated_delixi_native_carries_out_a_broadcast_without_a_reply(native: Bench) -> None:
    native.exchange(":0104000100001388A1")
    native.exchange(":010200020000000005")
    native.wait(60)
    assert native.exchange(":000200010000000003") == ""  # stop (frame made by hand from the manual's tables)
    native.wait(60)
    assert not native.motor.energised


def test_simulated_delixi_drives_ignore_frames_of_the_other_protocol(native: Bench) -> None:
    assert native.exchange(":010301F4000106") == ""
    assert Bench(DelixiModbus(1, framing=Framing.ASCII)).exchange(":010701F400000000FD") == ""


@pytest.fixture
def yd() -> Bench:
    return Bench(YD1000(1))


FORWARD, STOP, RESET = 0xC400, 0xC000, 0xE000


def run_at(yd: Bench, setpoint: int, word: int = FORWARD) -> None:
    """Write a setpoint and a control word, and wait until the ramp has ended."""
    yd.write(0x1001, setpoint)
    yd.write(0x1000, word)
    yd.wait(60)


def test_simulated_yd1000_address_and_maximum_frequency_are_readable(yd: Bench) -> None:
    assert yd.exchange("01 03 08 02 00 01 27 AA")[:14] == "01 03 02 00 01"
    # register 0011H (FH, the maximum frequency) is 80 Hz
    assert yd.exchange("01 03 00 11 00 01 D4 0F")[:14] == "01 03 02 1F 40"


def test_simulated_yd1000_refuses_to_read_two_registers_at_once(yd: Bench) -> None:
    assert yd.sim.answer(Message(1, 3, 0x1100, 2), 0.0) == Message(1, 3, exception=3)


def test_simulated_yd1000_runs_at_the_setpoint_written_over_the_line(yd: Bench) -> None:
    run_at(yd, 5000)
    assert (yd.read(3, 0x1100), yd.read(3, 0x1201)) == ([5000], [1 << 10])
    yd.write(0x1000, FORWARD | 1 << 9)
    yd.wait(60)
    assert (yd.motor.frequency, yd.read(3, 0x1201)) == (-50, [1 << 10 | 1 << 9])
    yd.write(0x1000, STOP)
    yd.wait(60)
    assert yd.read(3, 0x1100) == [0]


def test_simulated_yd1000_shows_current_and_voltage_in_percent(yd: Bench) -> None:
    run_at(yd, 5000)
    assert yd.read(3, 0x1203) == [round(10_000 * yd.motor.current / yd.motor.rating.current)]
    assert yd.read(3, 0x1205) == [10_000]  # 100 %, because 50 Hz are the rated frequency


def test_simulated_yd1000_obeys_the_panel_while_bit_15_is_off(yd: Bench) -> None:
    assert isinstance(yd.sim, SimulatedYD1000)
    yd.sim.panel_runs = True
    yd.write(0x1002, 3000)
    yd.write(0x1000, 0x0000)
    yd.wait(60)
    assert yd.motor.frequency == 30


def test_emergency_stop_freezes_two_registers_of_a_simulated_yd1000(yd: Bench) -> None:
    run_at(yd, 5000)
    yd.read(3, 0x1200)
    yd.write(0x1000, STOP | 1 << 12)  # emergency stop
    yd.wait(1)
    assert yd.read(3, 0x1100) == [0]
    assert yd.read(3, 0x1200) == [5000]
    assert yd.read(3, 0x1201) == [1 << 10]
    assert yd.read(3, 0x1202) == [5000]
    assert (yd.read(3, 0x1203), yd.read(3, 0x1205)) == ([0], [0])  # other registers are not frozen
    assert yd.read(3, 0x1210) != [0]


def test_simulated_yd1000_ignores_requests_during_a_restart(yd: Bench) -> None:
    yd.write(0x1001, 5000)
    yd.sim.trip(3)
    assert yd.write(0x1000, RESET) == 0
    assert yd.write(0x1000, STOP) is None
    yd.wait(2.5)
    assert yd.read(3, 0x1210) == [3]
    assert yd.read(3, 0x1001) == [0]
    assert yd.read(3, 0x1200) == [0]


@pytest.mark.parametrize("bit", [13, 12, 11, 10, 8, 7], ids=lambda bit: f"bit {bit}")
def test_simulated_yd1000_ignores_command_bits_without_bit_15(yd: Bench, bit: int) -> None:
    """Without bit 15, the panel commands the drive (8.1). Here the panel lets the motor run."""
    assert isinstance(yd.sim, SimulatedYD1000)
    yd.sim.panel_runs = True
    run_at(yd, 3000)
    assert yd.write(0x1000, 1 << 14 | 1 << bit) == 0
    yd.wait(60)
    assert (yd.motor.frequency, yd.motor.fault) == (30, 0)
    assert yd.read(3, 0x1001) == [3000]


@pytest.mark.parametrize(
    ("word", "state"),
    [
        (0xC400, 1 << 10),
        (0xC600, 1 << 10 | 1 << 9),
        (0xC440, 1 << 10 | 1 << 6),
        (0xC100, 1 << 10 | 1 << 8),
        # the bit "run" is also set while the motor is braked with direct current (8.2, table 2)
        (0xC080, 1 << 10 | 1 << 7),
        (0xC000, 0),
    ],
)
def test_simulated_yd1000_status_bits_show_the_motors_state(yd: Bench, word: int, state: int) -> None:
    run_at(yd, 3000, word)
    assert yd.read(3, 0x1201) == [state]
    yd.write(0x1000, STOP)
    yd.wait(60)
    assert not yd.motor.energised


def test_direct_current_brake_of_a_simulated_yd1000_keeps_voltage_at_0_hz(yd: Bench) -> None:
    run_at(yd, 3000)
    yd.write(0x1000, STOP | 1 << 7)
    yd.wait(10)
    assert (yd.read(3, 0x1100), yd.motor.energised) == ([0], True)


@pytest.mark.parametrize(
    ("bits", "speed"), [(0x8, 1), (0x4, 2), (0xC, 3), (0x2, 4), (0xA, 5), (0x6, 6), (0xE, 7)]
)
def test_preset_speed_bits_of_a_simulated_yd1000_select_the_speed(yd: Bench, bits: int, speed: int) -> None:
    yd.write(0x1001, 5000)
    for number, address in enumerate((0x18, 0x19, 0x20, 0x21, 0x22, 0x23, 0x24), start=1):
        assert yd.write(address, 1000 + number * 100) == 0
    yd.write(0x1000, FORWARD | bits)
    yd.wait(60)
    assert yd.read(3, 0x1100) == yd.read(3, 0x1202) == [1000 + speed * 100]


@pytest.mark.parametrize(
    ("address", "value"),
    [
        (0x0012, 8001),  # UL, the upper frequency limit: 0.5 Hz to FH, the maximum frequency
        (0x0012, 49),
        (0x0013, 8001),  # LL, the lower frequency limit: 0 Hz to UL
        (0x0018, 8001),  # Sr1, preset speed 1: LL to UL
        (0x0100, 8001),  # F100, the low-speed frequency: 0 Hz to FH
        (0x1001, 8001),  # the setpoint: 0 Hz to FH, the maximum frequency
        (0x1002, 8001),
        (0x0802, 64),
        (0x0803, 101),
    ],
    ids=lambda each: f"{each:04X}",
)
def test_simulated_yd1000_refuses_values_beyond_its_limits(yd: Bench, address: int, value: int) -> None:
    before = yd.read(3, address)
    assert yd.write(address, value) == 3
    assert yd.read(3, address) == before


def test_limits_of_a_simulated_yd1000_follow_other_parameters(yd: Bench) -> None:
    assert yd.write(0x0012, 6000) == 0  # UL
    assert (yd.write(0x0013, 6001), yd.write(0x0013, 2000)) == (3, 0)  # LL
    assert (yd.write(0x0018, 1999), yd.write(0x0018, 2000)) == (3, 0)  # Sr1
    # refused, because UL would be below LL, and FH below UL
    assert (yd.write(0x0012, 1999), yd.write(0x0011, 5999)) == (3, 3)


@pytest.mark.parametrize("address", [0x0001, 0x0007, 0x0015])
def test_simulated_yd1000_confirms_panel_parameters_without_storing(yd: Bench, address: int) -> None:
    assert yd.write(address, 1) == 0
    assert yd.read(3, address) == [0]
    assert not yd.sim.counters.eeprom_writes


def test_simulated_yd1000_watchdog_waits_for_the_first_message_after_a_reset(yd: Bench) -> None:
    yd.write(0x0803, 1)
    yd.write(0x1000, RESET)
    yd.now += 5
    assert yd.read(3, 0x1210) == [0]
    yd.now += 5
    assert yd.read(3, 0x1210) != [0]


def test_simulated_yd1000_obeys_a_broadcast_setpoint_but_no_setting(yd: Bench) -> None:
    yd.sim.answer(Message(0, 6, 0x1001, data=b"\x13\x88"), 0.0)
    yd.sim.answer(Message(0, 6, 0x0009, data=b"\x00\x32"), 0.0)
    assert (yd.sim["frequency"], yd.sim["acceleration_time"]) == (50, 10)


def test_only_parameter_writes_wear_the_eeprom_of_a_simulated_yd1000(yd: Bench) -> None:
    yd.write(0x0009, 50)
    yd.write(0x1001, 5000)
    assert yd.sim.counters.eeprom_writes == {"acceleration_time": 1}


def test_simulated_yd1000_refuses_to_change_some_parameters_while_running(yd: Bench) -> None:
    assert yd.write(0x0012, 6000) == 0  # lower UL first, because FH must not be below UL
    assert yd.write(0x0011, 6000) == 0
    yd.write(0x1001, 5000)
    yd.write(0x1000, FORWARD)
    assert yd.write(0x0011, 8000) == 4


def test_simulated_yd1000_watchdog_trips_if_the_line_is_silent_too_long(yd: Bench) -> None:
    yd.write(0x0803, 5)
    yd.write(0x1001, 5000)
    yd.write(0x1000, FORWARD)
    yd.now += 4
    assert yd.read(3, 0x1100) != [0]
    yd.now += 6
    assert yd.read(3, 0x1100) == [0]
    assert yd.motor.fault


# Write requests, which a drive confirms with a copy. The manuals do not print those of InvtCHE and YD1000,
# which were made by hand from the manuals' tables.
CONFIRMED = {
    "erman": (
        lambda: ErmanERG220(1),
        "01 05 00 00 FF 00 8C 3A",  # start
        "01 06 00 02 01 1D E9 93",  # setpoint 28.5 Hz; the address is corrected
        # the printed frame with the wrong address 0001H, which the library never sends
        "01 06 00 01 01 1D 19 93",
        "01 08 00 00 A5 37 DA 8D",
    ),
    "che": (
        lambda: MyCHE(1, maximum_frequency=60),
        *("01 06 10 00 00 01 4C CA", "01 06 10 00 00 05 4D 09", "01 06 10 00 00 06 0D 08"),
        *("01 06 10 00 00 07 CC C8", "01 06 20 00 13 88 8F 5C", "01 06 20 00 00 00 82 0A"),
    ),
    "ibd": (
        lambda: InnovertIBD(1),
        *("01 06 20 01 13 88 DE 9C", "01 06 20 00 00 02 03 CB"),
        *("01 06 20 00 00 01 43 CA", "01 06 00 6B 00 C8 F9 80"),
    ),
    "ibd in ascii": (
        lambda: InnovertIBD(1, framing="ascii"),
        *(":0106200113883D", ":010620000002D7", ":010620000001D8", ":01060065000391", ":0106006500058F"),
    ),
    "delixi": (lambda: DelixiModbus(1), "01 06 20 00 00 12 02 07", "01 06 00 02 13 88 25 5C"),
    "delixi in ascii": (
        lambda: DelixiModbus(1, framing=Framing.ASCII),
        *(":010620000012C7", ":0106000213885C"),
    ),
    "native": (
        lambda: DelixiNative(1),
        *(":010200020000000005", ":0104000100001388A1", ":0106000200001388A4"),
    ),
    "yd1000": (
        lambda: YD1000(1),
        *("01 06 10 00 C4 00 DF CA", "01 06 10 00 84 00 EE 0A", "01 06 10 00 C6 00 DE AA"),
        *("01 06 10 00 80 00 EC CA", "01 06 10 01 1F 40 D5 0A"),
    ),
}


@table(("make", "frame"), [(make, frame) for make, *frames in CONFIRMED.values() for frame in frames])
def test_simulated_drive_confirms_a_write_with_a_copy(make: Callable[[], Drive], frame: str) -> None:
    assert Bench(make()).exchange(frame) == frame


@table("family", [ErmanERG220, InvtCHE, InnovertIBD, DelixiModbus, DelixiNative, YD1000])
def test_simulated_registers_are_readable_and_writable_as_declared(family: type[Drive]) -> None:
    bench = Bench(family(1))
    for register in family.registers.values():
        if register.readable:
            assert bench.sim[register.name] is not None
            assert all(
                bench.sim.memory.readable(register.table.read or 0, register.address + at)
                for at in range(register.words)
            )
        if register.writable:
            assert bench.sim.memory.writable(register.table.write or 0, register.address)


@table("family", [ErmanERG220, InvtCHE, InnovertIBD, DelixiModbus, DelixiNative, YD1000])
def test_encoded_drive_returns_expected_values_in_every_family(family: type[Drive]) -> None:
    """Each register, read with whole frames, has the value that `encoded` or `known_counts` returns."""
    drive = family(5)
    known = drive.known_counts()
    wire = Wire([EncodedDrive(drive)], unpaced=True)
    for at, register in enumerate(each for each in family.registers.values() if each.readable):
        table = register.table
        asked = Message(5, table.read or 0, register.address, 1)
        if drive.framing is Framing.DELIXI:
            asked = Message(5, table.read or 0, register.address, data=bytes(4))
        wire.receive(build_request(drive.framing, asked), float(at))
        used, reply = parse_reply(drive.framing, wire.advance(at + 0.5), asked)
        assert used > 0
        assert reply is not None
        bits = 0x1 if table.carrier is Carrier.BIT else 0xFFFF
        raw = int.from_bytes(reply.data)
        least, most = known.get(register, (encoded(5, table, register.address) & bits,) * 2)
        assert least <= raw <= most
