"""Every family answers as its document says: whole frames in, whole frames out, at chosen times.

Frames with a written checksum are printed in the family's document, unless they are marked as built from its
tables. checksums.py computes the checksums of all other frames.
"""

from __future__ import annotations

import checksums
import pytest
from tables import table

from multidrop.core import Framing, Message, build_request, parse_reply
from multidrop.drive import Drive
from multidrop.drive.register import Carrier, setting
from multidrop.families.delixi_modbus import DelixiModbus
from multidrop.families.delixi_native import PARAMETER, DelixiNative
from multidrop.families.erman_er_g_220 import ErmanERG220
from multidrop.families.innovert_ibd import InnovertIBD
from multidrop.families.invt_che import InvtCHE, parameter
from multidrop.families.yd1000 import YD1000
from multidrop.sim import EncodedDrive, MotorDrive, Wire, encoded, simulated
from multidrop.sim.che import SimulatedCHE
from multidrop.sim.delixi import SimulatedDelixiNative
from multidrop.sim.yd1000 import SimulatedYD1000


class Bench:
    """One simulated drive on an unpaced wire, and the time."""

    def __init__(self, drive: Drive) -> None:
        sim = simulated(drive)
        assert isinstance(sim, MotorDrive)
        self.sim = sim
        self.motor = sim.motor
        self.wire = Wire([sim], unpaced=True)
        self.now = 100.0

    def hear(self, frame: bytes) -> bytes:
        """Return the reply; empty if the drive is silent."""
        self.wire.receive(frame, self.now)
        self.now += 0.1
        return self.wire.advance(self.now)

    def say(self, frame: str) -> str:
        """The same as the documents print it: RTU as hex digits, text without its end."""
        if frame.startswith(":"):
            return self.hear(f"{frame}\r\n".encode()).decode().removesuffix("\r\n")
        return self.hear(bytes.fromhex(frame)).hex(" ").upper()

    def ask(self, function: int, start: int, count: int = 1) -> list[int]:
        """The words that are read there."""
        reply = self.sim.answer(Message(self.sim.drive.address, function, start, count), self.now)
        assert reply is not None
        assert not reply.exception
        return [int.from_bytes(reply.data[at : at + 2]) for at in range(0, len(reply.data), 2)]

    def write(self, start: int, value: int, function: int = 6) -> int | None:
        """The exception code, 0 for a confirmation, None for silence."""
        data = value.to_bytes(4 if function == 4 else 2)
        reply = self.sim.answer(Message(self.sim.drive.address, function, start, data=data), self.now)
        return None if reply is None else reply.exception

    def wait(self, seconds: float) -> None:
        self.now += seconds
        self.motor.run_to(self.now)


# ---- ERMAN ER-G-220-01(02) ----


@pytest.fixture
def erman() -> Bench:
    return Bench(ErmanERG220(1))


def test_erman_reads_control_registers(erman: Bench) -> None:
    erman.sim["control_register"] = 0x0100
    erman.sim["frequency"] = 50.0
    erman.sim["maximum_frequency"] = 50.0
    erman.sim["minimum_frequency"] = 5.0
    assert erman.say("01 03 00 01 00 04 15 C9") == "01 03 08 01 00 01 F4 01 F4 00 32 25 C4"


def test_erman_reads_state_registers_with_the_checksum_corrected(erman: Bench) -> None:
    erman.sim["output_frequency"] = 50.0
    erman.sim["output_current"] = 21.4
    erman.sim["dc_bus_voltage"] = 562
    assert erman.say("01 04 00 01 00 05 61 C9") == "01 04 0A 01 F4 00 00 00 D6 00 00 02 32 7F 1B"


@pytest.mark.parametrize(
    "frame",
    [
        "01 05 00 00 FF 00 8C 3A",  # start
        "01 06 00 02 01 1D E9 93",  # 28.5 Hz, the address corrected
        "01 06 00 01 01 1D 19 93",  # as printed: the drive takes it, the library never sends it
        "01 08 00 00 A5 37 DA 8D",
    ],
)
def test_erman_confirms_with_a_copy(erman: Bench, frame: str) -> None:
    assert erman.say(frame) == frame


def test_erman_writes_several(erman: Bench) -> None:
    assert erman.say("01 10 00 0C 00 02 04 00 C8 01 90 73 F8") == "01 10 00 0C 00 02 81 CB"
    assert (erman.sim["acceleration_time"], erman.sim["deceleration_time"]) == (20, 40)
    assert (erman.motor.acceleration_time, erman.motor.deceleration_time) == (20, 40)
    assert erman.say("01 0F 00 00 00 09 02 01 01 25 2C") == "01 0F 00 00 00 09 95 CD"


def test_erman_reads_coils(erman: Bench) -> None:
    assert erman.say("01 01 00 00 00 0C 3C 0F")[:11] == "01 01 02 00"
    erman.say("01 05 00 00 FF 00 8C 3A")
    assert erman.say("01 01 00 00 00 0C 3C 0F")[:14] == "01 01 02 01 00"


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
def test_erman_refuses_wrong_addresses_as_printed(erman: Bench, request_: Message, reply: str) -> None:
    assert erman.hear(build_request(Framing.RTU, request_)) == bytes.fromhex(reply)


def test_erman_has_an_exception_for_an_unknown_function(erman: Bench) -> None:
    assert erman.hear(checksums.rtu("01 2B")) == checksums.rtu("01 AB 01")


@pytest.mark.parametrize(
    "frame",
    [
        bytes.fromhex("01 04 00 01 00 05 15 C9"),  # the printed checksum, which is wrong
        checksums.rtu("02 04 00 01 00 05"),  # another drive's
        checksums.rtu("00 05 00 01 FF 00"),  # a broadcast
        checksums.rtu("01 03 00 01 00"),  # of a wrong length
        checksums.rtu("01 10 00 0C 00 02 03 00 C8 01"),
    ],
)
def test_erman_is_silent(erman: Bench, frame: bytes) -> None:
    assert erman.hear(frame) == b""
    assert erman.sim.counters.replies == 0


def test_erman_runs_a_motor(erman: Bench) -> None:
    erman.say("01 06 00 02 01 1D E9 93")  # 28.5 Hz
    assert erman.ask(4, 0x400, 2) == [0, 0]
    erman.say("01 05 00 00 FF 00 8C 3A")
    erman.wait(1)
    assert erman.ask(4, 0x400, 2) == [0, 2]
    erman.wait(60)
    assert erman.ask(4, 0x400, 2) == [0, 1]
    assert erman.ask(4, 0x01) == [285]
    erman.say("01 05 00 01 FF 00 DD FA")  # stop (built)
    erman.wait(0.1)
    assert erman.ask(4, 0x400, 2) == [0, 3]
    erman.wait(60)
    assert (erman.ask(4, 0x400, 2), erman.ask(4, 0x01)) == ([0, 0], [0])


def test_erman_starts_only_while_stop_is_off_and_not_by_clearing_it(erman: Bench) -> None:
    erman.say("01 06 00 02 01 1D E9 93")
    erman.say("01 05 00 01 FF 00 DD FA")  # stop on
    erman.say("01 05 00 00 FF 00 8C 3A")  # start on
    assert not erman.motor.energised
    erman.say("01 05 00 01 00 00 9C 0A")  # stop off
    assert not erman.motor.energised
    erman.say("01 05 00 00 FF 00 8C 3A")
    assert erman.motor.energised


def test_erman_emergency_stop_is_a_fault_that_a_reset_clears_and_the_record_keeps(erman: Bench) -> None:
    erman.say("01 05 00 00 FF 00 8C 3A")
    erman.say("01 05 00 02 FF 00 2D FA")  # emergency stop (built)
    assert not erman.motor.energised
    assert erman.ask(4, 0x402, 2) == [0, 1]
    erman.hear(checksums.rtu("01 05 00 02 00 00"))
    erman.say("01 05 00 00 FF 00 8C 3A")
    assert not erman.motor.energised
    erman.say("01 05 00 09 FF 00 5C 38")  # reset (built)
    assert not erman.motor.energised
    assert erman.ask(4, 0x402, 2) == [0, 1]
    erman.say("01 05 00 00 FF 00 8C 3A")
    assert erman.motor.energised


# ---- INVT CHE ----


class MyCHE(InvtCHE):
    jump = parameter(8)
    acceleration_time = parameter(11, "s", step=0.1, default=10)
    locked = parameter(12, while_running=False)


@pytest.fixture
def che() -> Bench:
    return Bench(MyCHE(1, maximum_frequency=60))


@pytest.mark.parametrize(
    "frame",  # built; those of the control word and setpoint
    [
        "01 06 10 00 00 01 4C CA",
        "01 06 10 00 00 05 4D 09",
        "01 06 10 00 00 06 0D 08",
        "01 06 10 00 00 07 CC C8",
        "01 06 20 00 13 88 8F 5C",
        "01 06 20 00 00 00 82 0A",
    ],
)
def test_che_confirms_with_a_copy(che: Bench, frame: str) -> None:
    assert che.say(frame) == frame


def test_che_says_that_it_is_one(che: Bench) -> None:
    assert che.say("01 03 30 16 00 01 6A CE")[:14] == "01 03 02 01 01"


def test_che_writes_a_parameter() -> None:
    che = Bench(MyCHE(2))
    frame = "02 06 00 08 13 88 05 6D"  # 11.6.2
    assert che.say(frame) == frame
    assert che.sim["jump"] == 0x1388


def test_che_setpoint_is_a_percentage_of_the_maximum_frequency(che: Bench) -> None:
    che.say("01 06 20 00 13 88 8F 5C")  # 50.00 %
    che.say("01 06 10 00 00 01 4C CA")
    che.wait(60)
    assert che.ask(3, 0x3000) == [3000]
    assert che.ask(3, 0x3001) == [3000]
    assert che.ask(3, 0x1001) == [1]


def test_che_a_negative_setpoint_turns_the_motor_the_other_way(che: Bench) -> None:
    assert che.write(0x2000, 0x10000 - 5000) == 0
    che.write(0x1000, 1)
    che.wait(60)
    assert che.motor.frequency == pytest.approx(-30)
    assert che.ask(3, 0x1001) == [2]
    assert che.write(0x2000, 10_001) == 0x12


@pytest.mark.parametrize(("word", "stopped_after"), [(5, False), (6, True), (8, False)])
def test_che_stops_along_the_ramp_or_coasts(che: Bench, word: int, stopped_after: bool) -> None:
    che.write(0x2000, 10_000)
    che.write(0x1000, 2)
    che.wait(60)
    assert che.ask(3, 0x1001) == [2]
    che.write(0x1000, word)
    che.wait(0.01)
    assert (che.ask(3, 0x1001) == [3]) is stopped_after
    che.wait(60)
    assert che.ask(3, 0x1001) == [3]


def test_che_in_a_fault(che: Bench) -> None:
    che.sim.trip(10)
    assert (che.ask(3, 0x1001), che.ask(3, 0x5000)) == ([4], [10])
    assert che.write(0x1000, 1) == 0x01  # "or the drive has a fault"
    assert che.write(0x1000, 7) == 0
    assert (che.ask(3, 0x1001), che.ask(3, 0x5000)) == ([3], [0])


@pytest.mark.parametrize(
    ("body", "reply"),
    [
        ("01 03 40 00 00 01", "01 83 02"),  # nothing there
        ("01 03 80 0B 00 01", "01 83 02"),  # the alias in RAM cannot be read
        ("01 03 30 00 00 11", "01 83 03"),  # 17 words
        ("01 06 10 00 00 09", "01 86 12"),
        ("01 04 30 00 00 01", "01 84 01"),
    ],
)
def test_che_refuses(che: Bench, body: str, reply: str) -> None:
    assert che.hear(checksums.rtu(body)) == checksums.rtu(reply)


def test_che_parameters_wear_the_eeprom_and_their_aliases_do_not(che: Bench) -> None:
    for _ in range(3):
        che.write(11, 50)
    che.write(0x800B, 70)
    assert che.sim["acceleration_time"] == 7
    assert che.sim.counters.eeprom_writes == {"acceleration_time": 3}


def test_che_is_busy_while_it_stores(che: Bench) -> None:
    assert isinstance(che.sim, SimulatedCHE)
    che.sim.storing = 0.5
    assert che.write(11, 50) == 0
    assert che.write(11, 60) == 6
    assert che.ask(3, 0x5001) == [8]
    che.wait(0.6)
    assert che.write(11, 60) == 0


def test_che_some_parameters_cannot_be_changed_while_it_runs(che: Bench) -> None:
    che.write(0x2000, 5000)
    assert che.write(12, 1) == 0
    che.write(0x1000, 1)
    assert che.write(12, 2) == 0x12
    assert che.sim["locked"] == 1


def test_che_answers_a_damaged_frame_with_a_fault_frame(che: Bench) -> None:
    assert che.hear(bytes.fromhex("01 03 10 01 00 01 D1 0B")) == checksums.rtu("01 83 11")
    assert che.hear(bytes.fromhex("02 03 10 01 00 01 D1 0B")) == b""
    assert che.sim.counters.damaged == 1


# ---- INNOVERT IBD ----


@pytest.fixture
def ibd() -> Bench:
    return Bench(InnovertIBD(1))


@pytest.fixture
def ibd_ascii() -> Bench:
    return Bench(InnovertIBD(1, framing="ascii"))


@pytest.mark.parametrize(
    "frame",
    [
        "01 06 20 01 13 88 DE 9C",
        "01 06 20 00 00 02 03 CB",
        "01 06 20 00 00 01 43 CA",
        "01 06 00 6B 00 C8 F9 80",
    ],
)
def test_ibd_confirms_with_a_copy(ibd: Bench, frame: str) -> None:
    assert ibd.say(frame) == frame


@pytest.mark.parametrize(
    "frame",
    [
        ":0106200113883D",
        ":010620000002D7",
        ":010620000001D8",
        ":01060065000391",
        ":0106006500058F",
    ],
)
def test_ibd_confirms_with_a_copy_in_ascii(ibd_ascii: Bench, frame: str) -> None:
    assert ibd_ascii.say(frame) == frame


def test_ibd_shows_its_terminals(ibd: Bench) -> None:
    assert ibd.say("01 03 00 16 00 01 65 CE") == "01 03 02 18 00 B2 44"


def test_ibd_programmed_outputs_show_the_motor_s_state(ibd: Bench) -> None:
    ibd.say("01 06 20 01 13 88 DE 9C")
    ibd.say("01 06 20 00 00 02 03 CB")
    ibd.wait(1)
    assert ibd.ask(3, 22) == [0x1800 | 1 << 8 | 1 << 9]
    ibd.wait(60)
    assert ibd.ask(3, 22) == [0x1800 | 1 << 8]
    ibd.say("01 06 20 00 00 01 43 CA")
    ibd.wait(1)
    assert ibd.ask(3, 22) == [0x1800 | 1 << 8 | 1 << 10]
    ibd.sim.trip(1)
    assert ibd.ask(3, 22) == [0x1800 | 1 << 13]
    ibd.sim["output_virtual"] = 1
    assert ibd.ask(3, 22) == [0x1800]


def test_ibd_reverses_without_a_run_command(ibd: Bench) -> None:
    assert ibd.write(0x2001, 2000) == 0
    for bits, direction in ((0x06, -1), (0x08, 1), (0x0C, -1)):  # run reverse; forward; the other way
        assert ibd.write(0x2000, bits) == 0
        assert ibd.motor.direction == direction
        assert ibd.motor.energised


def test_ibd_a_jog_is_left_by_a_stop_and_a_new_run_alone(ibd: Bench) -> None:
    ibd.write(0x2001, 5000)
    ibd.write(0x2000, 3)
    ibd.wait(60)
    assert ibd.write(0x2000, 2) == 0  # confirmed, and of no effect
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


def test_ibd_a_trip_ends_a_jog(ibd: Bench) -> None:
    ibd.write(0x2001, 5000)
    ibd.write(0x2000, 3)
    ibd.sim.trip(1)
    ibd.write(0x2000, 0x10)
    ibd.write(0x2000, 2)
    ibd.wait(60)
    assert ibd.motor.frequency == 50


def test_ibd_runs_by_the_line_only_if_it_is_set_up_for_it(ibd: Bench) -> None:
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


def test_ibd_clamps_silently(ibd: Bench) -> None:
    assert ibd.write(107, 60_000) == 0
    assert ibd.ask(3, 107) == [36_000]
    assert ibd.write(0x2001, 50_000) == 0
    assert ibd.sim["frequency"] == 400


@pytest.mark.parametrize(
    ("function", "start", "count"), [(3, 107, 5), (3, 0x2000, 1), (3, 50, 1), (4, 3, 1), (0x10, 107, 1)]
)
def test_ibd_does_not_answer_impossible_requests(ibd: Bench, function: int, start: int, count: int) -> None:
    data = b"\0\1" if function == 0x10 else b""
    assert ibd.sim.answer(Message(1, function, start, count, data), 0.0) is None


def test_ibd_reads_at_most_four_registers(ibd: Bench) -> None:
    reply = ibd.sim.answer(Message(1, 3, 3, 2), 0.0)
    assert reply is not None
    assert len(reply.data) == 4


def test_ibd_obeys_a_broadcast_in_silence(ibd: Bench) -> None:
    ibd.say("01 06 20 01 13 88 DE 9C")
    ibd.say("01 06 20 00 00 02 03 CB")
    ibd.wait(60)
    assert ibd.say("00 06 20 00 00 01 42 1B") == ""  # stop (built)
    ibd.wait(60)
    assert not ibd.motor.energised


def test_ibd_the_bit_that_is_delixi_s_forward_resets_the_fault(ibd: Bench) -> None:
    ibd.sim.trip(1)
    ibd.say("01 06 20 00 00 10 83 C6")  # built
    assert (ibd.motor.fault, ibd.motor.energised) == (0, False)


# ---- Delixi, standard Modbus ----


@pytest.fixture
def delixi() -> Bench:
    return Bench(DelixiModbus(1))


@pytest.mark.parametrize("frame", ["01 06 20 00 00 12 02 07", "01 06 00 02 13 88 25 5C"])
def test_delixi_confirms_with_a_copy(delixi: Bench, frame: str) -> None:
    assert delixi.say(frame) == frame


@pytest.mark.parametrize("frame", [":010620000012C7", ":0106000213885C"])
def test_delixi_confirms_with_a_copy_in_ascii(frame: str) -> None:
    assert Bench(DelixiModbus(1, framing=Framing.ASCII)).say(frame) == frame


def test_delixi_shows_its_frequency(delixi: Bench) -> None:
    delixi.say("01 06 00 02 13 88 25 5C")
    delixi.say("01 06 20 00 00 12 02 07")
    delixi.wait(60)
    assert delixi.say("01 03 01 F4 00 01 C4 04") == "01 03 02 13 88 B5 12"
    delixi.sim.trip(9)
    assert delixi.ask(3, 0x0213) == [9]
    assert delixi.ask(3, 0x020D) == [9]


def test_delixi_shows_its_frequency_in_ascii() -> None:
    delixi = Bench(DelixiModbus(1, framing=Framing.ASCII))
    delixi.sim["output_frequency"] = 50
    assert delixi.say(":010301F4000106") == ":01030213885F"


def test_delixi_runs_by_the_line_only_if_it_is_set_up_for_it(delixi: Bench) -> None:
    delixi.say("01 06 00 02 13 88 25 5C")
    delixi.sim["run_source"] = 0  # P00.00
    assert delixi.say("01 06 20 00 00 12 02 07") == "01 06 20 00 00 12 02 07"
    assert not delixi.motor.energised
    delixi.sim["run_source"] = 2
    delixi.sim["frequency_source"] = 0  # P00.01
    delixi.say("01 06 20 00 00 12 02 07")
    delixi.wait(60)
    assert (delixi.motor.energised, delixi.motor.frequency) == (True, 0)


def test_delixi_turns_backwards(delixi: Bench) -> None:
    delixi.say("01 06 00 02 13 88 25 5C")
    delixi.say("01 06 20 00 00 22 02 13")  # built
    delixi.wait(60)
    assert delixi.motor.frequency == -50


@pytest.mark.parametrize(("function", "start", "count"), [(3, 0x01F4, 2), (3, 0x9999, 1), (4, 0x01F4, 1)])
def test_delixi_does_not_answer_impossible_requests(
    delixi: Bench, function: int, start: int, count: int
) -> None:
    assert delixi.sim.answer(Message(1, function, start, count), 0.0) is None


def test_delixi_obeys_only_run_commands_as_broadcasts(delixi: Bench) -> None:
    delixi.sim.answer(Message(0, 6, 2, data=b"\x13\x88"), 0.0)
    assert delixi.sim["frequency"] == 0
    delixi.sim.answer(Message(0, 6, 0x2000, data=b"\x00\x12"), 0.0)
    assert delixi.motor.energised


# ---- Delixi's own protocol ----


@pytest.fixture
def native() -> Bench:
    return Bench(DelixiNative(1))


@pytest.mark.parametrize("frame", [":010200020000000005", ":0104000100001388A1", ":0106000200001388A4"])
def test_native_confirms_with_a_copy(native: Bench, frame: str) -> None:
    assert native.say(frame) == frame


def test_native_shows_its_frequency_and_state(native: Bench) -> None:
    assert native.say(":010300000000000004")[:9] == ":01030001"  # built; stopped
    native.say(":0104000100001388A1")
    native.say(":010200020000000005")
    native.wait(60)
    assert native.say(":010701F400000000FD") == ":010701F40000138898"
    assert native.say(":010300000000000004")[:9] == ":01030002"
    native.say(":010200030000000006")  # reverse (built)
    native.wait(60)
    assert native.say(":010300000000000004")[:9] == ":01030003"


@pytest.mark.parametrize(
    ("fault", "shown", "state"),
    [(9, "00000009", 4), (10, "00000010", 4), (14, "00000014", 4), (7, "00000007", 5)],
)
def test_native_faults_are_shown_as_printed(native: Bench, fault: int, shown: str, state: int) -> None:
    native.sim.trip(fault)
    assert native.say(":01070213000000001D")[9:17] == shown
    assert native.say(":010300000000000004")[5:9] == f"{state:04X}"
    assert native.say(":010200040000000007") == ":010200040000000007"  # reset
    assert native.say(":010300000000000004")[5:9] == "0001"


@pytest.mark.parametrize(
    ("frame", "reply"),
    [
        (checksums.delixi("0102000900000000"), b":01F0000000000000F1\r\n"),  # no such command
        (checksums.delixi("0107270F00000000"), checksums.delixi("01FC000000000000")),  # no such parameter
        (b":010200020000000006\r\n", b":01FF00000000000000\r\n"),  # the sum is 05
        (b":0102000205\r\n", b""),  # of a wrong length
    ],
)
def test_native_error_replies(native: Bench, frame: bytes, reply: bytes) -> None:
    assert native.hear(frame) == reply


class MyNative(DelixiNative):
    ramp = setting(17, "s", step=0.1, span=(0.1, 600), table=PARAMETER, while_running=False)


def test_native_limits_and_locks() -> None:
    native = Bench(MyNative(1))
    assert native.hear(checksums.delixi("0106001100000064")) == checksums.delixi("0106001100000064")
    assert native.hear(checksums.delixi("0106001100001771")) == checksums.delixi(
        "01FD000000000000"
    )  # 600.1 s
    native.say(":010200020000000005")
    assert native.hear(checksums.delixi("0106001100000032")) == checksums.delixi("01FE000000000000")
    assert native.sim["ramp"] == 10


def test_native_start_in_a_fault_cannot_be_executed(native: Bench) -> None:
    native.sim.trip(1)
    assert native.say(":010200020000000005") == ":01F0000000000000F1"
    assert not native.motor.energised


@pytest.mark.parametrize("fault", [9, 10, 14])
def test_native_a_fault_and_its_record_agree(native: Bench, fault: int) -> None:
    native.sim.trip(fault)
    assert native.sim["fault"] == fault
    shown = native.say(":01070213000000001D")[9:17]
    for number, record in enumerate((shown, "00000000", "00000000", "00000000")):
        asked = checksums.delixi(f"0107{0x020D + number:04X}00000000")
        assert native.hear(asked)[9:17].decode() == record


def test_native_a_locked_parameter(native: Bench) -> None:
    assert isinstance(native.sim, SimulatedDelixiNative)
    native.sim.locked = True
    locked = checksums.delixi("01FE000000000000")
    assert native.say(":0106000200001388A4").encode() + b"\r\n" == locked
    assert native.hear(checksums.delixi("0105000200001388")) == locked
    assert native.say(":0104000100001388A1") == ":0104000100001388A1"  # no parameter
    assert native.say(":010200020000000005") == ":010200020000000005"
    native.sim.locked = False
    assert native.say(":0106000200001388A4") == ":0106000200001388A4"


def test_native_refuses_commands_without_line_control(native: Bench) -> None:
    native.sim["run_source"] = 0  # P00.00
    assert native.say(":010200020000000005") == ":01F0000000000000F1"
    assert not native.motor.energised


def test_native_stores_with_06_only(native: Bench) -> None:
    native.say(":0104000100001388A1")
    assert not native.sim.counters.eeprom_writes
    native.say(":0106000200001388A4")
    assert native.sim.counters.eeprom_writes == {"stored_frequency": 1}


def test_native_broadcast(native: Bench) -> None:
    native.say(":0104000100001388A1")
    native.say(":010200020000000005")
    native.wait(60)
    assert native.say(":000200010000000003") == ""  # stop (built)
    native.wait(60)
    assert not native.motor.energised


def test_native_does_not_answer_modbus_and_modbus_does_not_answer_native(native: Bench) -> None:
    assert native.say(":010301F4000106") == ""
    assert Bench(DelixiModbus(1, framing=Framing.ASCII)).say(":010701F400000000FD") == ""


# ---- YD1000 ----


@pytest.fixture
def yd() -> Bench:
    return Bench(YD1000(1))


FORWARD, STOP, RESET = 0xC400, 0xC000, 0xE000


@pytest.mark.parametrize(
    "frame",  # built
    [
        "01 06 10 00 C4 00 DF CA",
        "01 06 10 00 84 00 EE 0A",
        "01 06 10 00 C6 00 DE AA",
        "01 06 10 00 80 00 EC CA",
        "01 06 10 01 1F 40 D5 0A",
    ],
)
def test_yd_confirms_with_a_copy(yd: Bench, frame: str) -> None:
    assert yd.say(frame) == frame


def test_yd_says_who_it_is(yd: Bench) -> None:
    assert yd.say("01 03 08 02 00 01 27 AA")[:14] == "01 03 02 00 01"
    assert yd.say("01 03 00 11 00 01 D4 0F")[:14] == "01 03 02 1F 40"  # FH = 80 Hz


def test_yd_reads_one_register_at_a_time(yd: Bench) -> None:
    assert yd.sim.answer(Message(1, 3, 0x1100, 2), 0.0) == Message(1, 3, exception=3)


def test_yd_runs_at_the_line_s_frequency(yd: Bench) -> None:
    yd.write(0x1001, 5000)
    yd.write(0x1000, FORWARD)
    yd.wait(60)
    assert (yd.ask(3, 0x1100), yd.ask(3, 0x1201)) == ([5000], [1 << 10])
    yd.write(0x1000, FORWARD | 1 << 9)
    yd.wait(60)
    assert (yd.motor.frequency, yd.ask(3, 0x1201)) == (-50, [1 << 10 | 1 << 9])
    yd.write(0x1000, STOP)
    yd.wait(60)
    assert yd.ask(3, 0x1100) == [0]


def test_yd_shows_amperes_and_volts_as_percentages(yd: Bench) -> None:
    yd.write(0x1001, 5000)
    yd.write(0x1000, FORWARD)
    yd.wait(60)
    assert yd.ask(3, 0x1203) == [round(10_000 * yd.motor.current / yd.motor.rating.current)]
    assert yd.ask(3, 0x1205) == [10_000]  # 50 Hz are the rated frequency


def test_yd_without_bit_15_the_panel_is_in_command(yd: Bench) -> None:
    assert isinstance(yd.sim, SimulatedYD1000)
    yd.sim.panel_runs = True
    yd.write(0x1002, 3000)
    yd.write(0x1000, 0x0000)
    yd.wait(60)
    assert yd.motor.frequency == 30


def test_yd_freezes_its_monitors_in_a_trip(yd: Bench) -> None:
    yd.write(0x1001, 5000)
    yd.write(0x1000, FORWARD)
    yd.wait(60)
    yd.ask(3, 0x1200)
    yd.write(0x1000, STOP | 1 << 12)  # emergency stop
    yd.wait(1)
    assert yd.ask(3, 0x1100) == [0]
    assert yd.ask(3, 0x1200) == [5000]
    assert yd.ask(3, 0x1201) == [1 << 10]
    assert yd.ask(3, 0x1202) == [5000]
    assert (yd.ask(3, 0x1203), yd.ask(3, 0x1205)) == ([0], [0])  # only 1200H and 1201H are held
    assert yd.ask(3, 0x1210) != [0]


def test_yd_restarts_on_a_reset_and_is_deaf_meanwhile(yd: Bench) -> None:
    yd.write(0x1001, 5000)
    yd.sim.trip(3)
    assert yd.write(0x1000, RESET) == 0
    assert yd.write(0x1000, STOP) is None
    yd.wait(2.5)
    assert yd.ask(3, 0x1210) == [3]
    assert yd.ask(3, 0x1001) == [0]
    assert yd.ask(3, 0x1200) == [0]


@pytest.mark.parametrize("bit", [13, 12, 11, 10, 8, 7], ids=lambda bit: f"bit {bit}")
def test_yd_no_command_works_without_bit_15(yd: Bench, bit: int) -> None:
    """The panel that is in command then lets the motor run (8.1)."""
    assert isinstance(yd.sim, SimulatedYD1000)
    yd.sim.panel_runs = True
    yd.write(0x1001, 3000)
    yd.write(0x1000, FORWARD)
    yd.wait(60)
    assert yd.write(0x1000, 1 << 14 | 1 << bit) == 0
    yd.wait(60)
    assert (yd.motor.frequency, yd.motor.fault) == (30, 0)
    assert yd.ask(3, 0x1001) == [3000]


@pytest.mark.parametrize(
    ("word", "state"),
    [
        (0xC400, 1 << 10),
        (0xC600, 1 << 10 | 1 << 9),
        (0xC440, 1 << 10 | 1 << 6),
        (0xC100, 1 << 10 | 1 << 8),
        (0xC080, 1 << 10 | 1 << 7),  # "in DC braking this bit is run" (8.2, table 2)
        (0xC000, 0),
    ],
)
def test_yd_shows_the_motor_s_state(yd: Bench, word: int, state: int) -> None:
    yd.write(0x1001, 3000)
    yd.write(0x1000, word)
    yd.wait(60)
    assert yd.ask(3, 0x1201) == [state]
    yd.write(0x1000, STOP)
    yd.wait(60)
    assert not yd.motor.energised


def test_yd_brakes_by_direct_current_until_a_stop(yd: Bench) -> None:
    yd.write(0x1001, 3000)
    yd.write(0x1000, FORWARD)
    yd.wait(60)
    yd.write(0x1000, STOP | 1 << 7)
    yd.wait(10)
    assert (yd.ask(3, 0x1100), yd.motor.energised) == ([0], True)


@pytest.mark.parametrize(
    ("bits", "speed"), [(0x8, 1), (0x4, 2), (0xC, 3), (0x2, 4), (0xA, 5), (0x6, 6), (0xE, 7)]
)
def test_yd_preset_speeds(yd: Bench, bits: int, speed: int) -> None:
    yd.write(0x1001, 5000)
    for number, address in enumerate((0x18, 0x19, 0x20, 0x21, 0x22, 0x23, 0x24), start=1):
        assert yd.write(address, 1000 + number * 100) == 0
    yd.write(0x1000, FORWARD | bits)
    yd.wait(60)
    assert yd.ask(3, 0x1100) == yd.ask(3, 0x1202) == [1000 + speed * 100]


@pytest.mark.parametrize(
    ("address", "value"),
    [
        (0x0012, 8001),  # UL: 0.5 to FH
        (0x0012, 49),
        (0x0013, 8001),  # LL: 0.0 to UL
        (0x0018, 8001),  # Sr1: LL to UL
        (0x0100, 8001),  # F100: 0.0 to FH
        (0x1001, 8001),  # 0.0 to FH
        (0x1002, 8001),
        (0x0802, 64),
        (0x0803, 101),
    ],
    ids=lambda each: f"{each:04X}",
)
def test_yd_refuses_values_beyond_its_limits(yd: Bench, address: int, value: int) -> None:
    before = yd.ask(3, address)
    assert yd.write(address, value) == 3
    assert yd.ask(3, address) == before


def test_yd_its_limits_are_those_that_it_holds(yd: Bench) -> None:
    assert yd.write(0x0012, 6000) == 0  # UL
    assert (yd.write(0x0013, 6001), yd.write(0x0013, 2000)) == (3, 0)  # LL
    assert (yd.write(0x0018, 1999), yd.write(0x0018, 2000)) == (3, 0)  # Sr1
    assert (yd.write(0x0012, 1999), yd.write(0x0011, 5999)) == (3, 3)  # neither UL below LL nor FH below UL


@pytest.mark.parametrize("address", [0x0001, 0x0007, 0x0015])
def test_yd_does_not_store_the_panel_s_setpoint(yd: Bench, address: int) -> None:
    assert yd.write(address, 1) == 0
    assert yd.ask(3, address) == [0]
    assert not yd.sim.counters.eeprom_writes


def test_yd_its_watchdog_restarts_after_a_reset(yd: Bench) -> None:
    yd.write(0x0803, 1)
    yd.write(0x1000, RESET)
    yd.now += 5
    assert yd.ask(3, 0x1210) == [0]
    yd.now += 5
    assert yd.ask(3, 0x1210) != [0]


def test_yd_obeys_broadcasts_of_command_and_frequency_only(yd: Bench) -> None:
    yd.sim.answer(Message(0, 6, 0x1001, data=b"\x13\x88"), 0.0)
    yd.sim.answer(Message(0, 6, 0x0009, data=b"\x00\x32"), 0.0)
    assert (yd.sim["frequency"], yd.sim["acceleration_time"]) == (50, 10)


def test_yd_all_but_commands_wears_the_eeprom(yd: Bench) -> None:
    yd.write(0x0009, 50)
    yd.write(0x1001, 5000)
    assert yd.sim.counters.eeprom_writes == {"acceleration_time": 1}


def test_yd_locks_some_parameters_while_it_runs(yd: Bench) -> None:
    assert yd.write(0x0012, 6000) == 0  # UL, which FH is not below
    assert yd.write(0x0011, 6000) == 0
    yd.write(0x1001, 5000)
    yd.write(0x1000, FORWARD)
    assert yd.write(0x0011, 8000) == 4


def test_yd_watches_the_line_if_set_to(yd: Bench) -> None:
    yd.write(0x0803, 5)
    yd.write(0x1001, 5000)
    yd.write(0x1000, FORWARD)
    yd.now += 4
    assert yd.ask(3, 0x1100) != [0]
    yd.now += 6
    assert yd.ask(3, 0x1100) == [0]
    assert yd.motor.fault


# ---- all ----


@table("family", [ErmanERG220, InvtCHE, InnovertIBD, DelixiModbus, DelixiNative, YD1000])
def test_every_declared_register_can_be_read_or_written_as_declared(family: type[Drive]) -> None:
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
def test_every_family_can_be_encoded(family: type[Drive]) -> None:
    """A register reads as `encoded` says, or its document, through whole frames."""
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
