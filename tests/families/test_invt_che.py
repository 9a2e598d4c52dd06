"""INVT CHE: the register table (CHE100 manual v1.4), and the frames that verbs send."""

from __future__ import annotations

from pathlib import Path

import checksums
import pytest
from scripts import Wire, frame, rows, typed
from simulated_bus import one
from tables import table

from multidrop.control.eeprom_ledger import Ledger
from multidrop.core import NumberFormat
from multidrop.drive import Condition, Direction, State
from multidrop.drive.register import HOLDING, Kept
from multidrop.errors import (
    BadReply,
    BusError,
    DriveException,
    NoReply,
    NotVerified,
    Unconfirmed,
    WriteForbidden,
)
from multidrop.families.invt_che import (
    CHEControl,
    CHEFault,
    CHEStatus,
    CommunicationFault,
    InvtCHE,
    parameter,
    stored_parameter,
)

FORWARD = "01 06 10 00 00 01 4C CA"
STOP = "01 06 10 00 00 05 4D 09"
STOP_JOG = checksums.rtu("01 06 10 00 00 08").hex(" ").upper()
COAST = "01 06 10 00 00 06 0D 08"
RESET = "01 06 10 00 00 07 CC C8"
HALF = "01 06 20 00 13 88 8F 5C"
ZERO = "01 06 20 00 00 00 82 0A"

STANDBY = {"status": CHEStatus.STANDBY, "fault": CHEFault.NONE, "setpoint": 40.0}

TURNS = {
    FORWARD: {"status": CHEStatus.FORWARD},
    "01 06 10 00 00 02 0C CB": {"status": CHEStatus.REVERSE},
    RESET: {"status": CHEStatus.STANDBY},
}

TABLE = """
03/06 1000 control                - CHEControl
03/06 1001 status                 - CHEStatus
03/06 2000 setpoint            0.01 %
03/06 3000 output_frequency    0.01 Hz
03/06 3001 reference_frequency 0.01 Hz
03/06 3002 dc_bus_voltage         ? V
03/06 3003 output_voltage         1 V
03/06 3004 output_current       0.1 A
03/06 3005 motor_speed            1 rpm
03/06 3006 output_power           ?
03/06 3007 output_torque        0.1 %
03/06 3008 pid_setpoint         0.1 %
03/06 3009 pid_feedback         0.1 %
03/06 300A inputs                 1
03/06 300B outputs                1
03/06 300C analog_input_1      0.01 V
03/06 300D analog_input_2      0.01 V
03/06 3010 pulse_frequency        ? kHz
03/06 3012 stage                  1
03/06 3013 length                 ?
03/06 3014 counter                1
03/06 3016 device                 - Device
03/06 5000 fault                  - CHEFault
03/06 5001 communication_fault    - CommunicationFault
"""


def test_invt_che_registers_equal_the_table_of_the_che100_manual() -> None:
    assert rows(InvtCHE) == typed(TABLE)
    assert all(register.outside for register in InvtCHE.registers.values())
    signed = {name for name, each in InvtCHE.registers.items() if each.number_format is NumberFormat.I16}
    assert signed == {"setpoint", "output_power", "output_torque"}


def test_invt_che_values_of_disputed_scale_are_raw_counts() -> None:
    """By an owner's log of a CHF100A, 3006H is in 0.01 kW. By the Goodrive300L manual, it is in 0.1 %."""
    for register, raw in ((InvtCHE.output_power, 262), (InvtCHE.dc_bus_voltage, 5370)):
        assert register.value_unit == "raw count"
        assert register.decode(raw) == raw
        assert "CHF100A" in register.note


def test_invt_che_control_and_status_numbers_have_the_documented_names() -> None:
    assert [(each.value, each.name) for each in CHEControl] == [
        (1, "FORWARD"),
        (2, "REVERSE"),
        (3, "JOG_FORWARD"),
        (4, "JOG_REVERSE"),
        (5, "STOP"),
        (6, "COAST"),
        (7, "RESET_FAULT"),
        (8, "STOP_JOG"),
    ]
    assert [each.value for each in CHEFault] == list(range(24))
    assert [each.value for each in CommunicationFault] == list(range(9))
    assert CHEFault(18) is CHEFault.CE_COMMUNICATION
    assert CHEFault(10) is CHEFault.UV_UNDERVOLTAGE


def test_invt_che_line_settings_and_limits_are_those_of_the_manual() -> None:
    assert str(InvtCHE(247).settings) == "9600 8N1"
    assert InvtCHE.most_registers == {HOLDING: 16}
    assert set(InvtCHE.exceptions) == {1, 2, 3, 6, 0x10, 0x11, 0x12, 0x13}
    assert "PC.04" in InvtCHE.watchdog
    assert "PC.05" in InvtCHE.watchdog


def test_invt_che_start_sends_the_control_word_of_its_direction() -> None:
    wire = Wire(InvtCHE(1), STANDBY, turns=TURNS)
    wire.drive.start(Direction.FORWARD)
    wire.drive.start()
    assert wire.sent == [FORWARD, FORWARD]
    wire.drive.start(Direction.REVERSE)
    assert wire.sent[2].startswith("01 06 10 00 00 02")


def test_invt_che_start_without_a_direction_keeps_a_running_motors_direction() -> None:
    wire = Wire(InvtCHE(1), {"status": CHEStatus.REVERSE, "setpoint": 40.0})
    wire.drive.start()
    assert [each[:17] for each in wire.sent] == ["01 06 10 00 00 02"]


TURNS_ALREADY = r"already turns, and a jog must start from rest: call stop\(\) first"
UNDOCUMENTED = "shows state 0005H in 1001H, which the manual does not explain"


@table(
    ("verb", "status", "sentence"),
    [
        ("jog", CHEStatus.FORWARD, TURNS_ALREADY),
        ("jog", CHEStatus.REVERSE, TURNS_ALREADY),
        ("jog", 5, UNDOCUMENTED),
        ("start", 5, UNDOCUMENTED),  # the motor may already turn in the opposite direction
    ],
)
@table("direction", [None, *Direction])
def test_invt_che_start_and_jog_are_refused_if_the_motor_may_turn(
    verb: str, status: int, sentence: str, direction: Direction | None
) -> None:
    wire = Wire(InvtCHE(1), {**STANDBY, "status": status})
    with pytest.raises(WriteForbidden, match=sentence):
        getattr(wire.drive, verb)(direction)
    assert wire.sent == []


def test_invt_che_stop_waits_for_the_state_standby() -> None:
    wire = Wire(InvtCHE(1), {"status": [CHEStatus.FORWARD, CHEStatus.FORWARD, CHEStatus.STANDBY]})
    wire.drive.stop()
    assert wire.sent == [STOP, STOP_JOG]
    assert wire.reads == ["status"] * 3


def test_the_command_stop_jog_is_sent_if_a_jog_continues() -> None:
    """STOP_JOG is not delayed until `stop_time` has passed."""
    wire = Wire(InvtCHE(1), {"status": CHEStatus.FORWARD}, turns={STOP_JOG: {"status": CHEStatus.STANDBY}})
    wire.drive.stop()
    assert wire.sent == [STOP, STOP_JOG]
    assert wire.seconds < 1
    wire = Wire(InvtCHE(1, stop_time=20), {"status": CHEStatus.FORWARD})
    with pytest.raises(Unconfirmed, match="20 s"):
        wire.drive.stop()
    assert wire.sent == [STOP, STOP_JOG]


def test_invt_che_coast_is_unconfirmed_while_the_motor_turns() -> None:
    wire = Wire(InvtCHE(1, stop_time=20), {"status": CHEStatus.FORWARD})
    with pytest.raises(Unconfirmed, match="20 s"):
        wire.drive.coast()
    assert wire.sent == [frame(InvtCHE(1), InvtCHE.control, CHEControl.COAST)]


def test_invt_che_stop_jog_is_sent_after_a_refused_stop() -> None:
    refusal = DriveException("drive", 0x12, "")
    turns = {STOP_JOG: {"status": CHEStatus.STANDBY}}
    wire = Wire(InvtCHE(1), {"status": CHEStatus.FORWARD}, {STOP: [refusal] * 3}, turns)
    wire.drive.stop()
    assert wire.sent == [STOP] * 3 + [STOP_JOG]


def test_the_command_stop_jog_follows_an_unconfirmed_stop() -> None:
    """A drive whose replies are lost may still receive the stop. The stop may not end a jog."""
    lost = Unconfirmed("drive", "control = STOP", "no reply")
    # STOP_JOG is sent once, even if it is unconfirmed too: the caller then repeats STOP and STOP_JOG.
    for of_a_jog in ([], [lost] * 3):
        wire = Wire(InvtCHE(1), {"status": CHEStatus.FORWARD}, {STOP: [lost] * 3, STOP_JOG: of_a_jog})
        with pytest.raises(Unconfirmed, match="control = STOP"):
            wire.drive.stop()
        assert wire.sent == [STOP] * 3 + [STOP_JOG]


@pytest.mark.parametrize(
    "unseen",
    [NoReply("drive"), BadReply("drive", "checksum", b""), DriveException("drive", 6, "busy")],
    ids=lambda unseen: type(unseen).__name__,
)
def test_the_command_stop_jog_is_sent_if_the_state_is_unknown(unseen: BusError) -> None:
    wire = Wire(InvtCHE(1), {"status": unseen})
    with pytest.raises(type(unseen)):
        wire.drive.stop()
    assert wire.sent == [STOP, STOP_JOG]


def test_invt_che_stop_jog_is_not_sent_to_another_family() -> None:
    wire = Wire(
        InvtCHE(1), {"status": CHEStatus.FORWARD}, {STOP: [WriteForbidden("another family is there")]}
    )
    with pytest.raises(WriteForbidden, match="another family"):
        wire.drive.stop()
    assert wire.sent == [STOP]


def test_invt_che_state_is_read_even_after_a_refused_stop_jog() -> None:
    refusal = DriveException("drive", 0x12, "")
    says = {"status": [CHEStatus.FORWARD] * 4 + [CHEStatus.STANDBY]}
    wire = Wire(InvtCHE(1), says, {STOP_JOG: [refusal] * 3})
    wire.drive.stop()
    assert wire.sent == [STOP] + [STOP_JOG] * 3


def test_invt_che_stop_counts_as_done_if_refused_at_rest() -> None:
    refusal = DriveException("drive", 1, "")
    wire = Wire(InvtCHE(1), {"status": CHEStatus.FAULT}, {STOP: [refusal] * 3})
    wire.drive.stop()
    loses = {STOP: [refusal] * 3, STOP_JOG: [DriveException("drive", 0x12, "")] * 3}
    wire = Wire(InvtCHE(1), {"status": CHEStatus.FORWARD}, loses)
    with pytest.raises(DriveException) as raised:
        wire.drive.stop()
    assert raised.value is refusal
    wire = Wire(InvtCHE(1), {"status": [CHEStatus.FORWARD, CHEStatus.STANDBY]}, loses)
    wire.drive.stop()  # both stop words are refused, but the motor is at rest
    assert wire.sent == [STOP] * 3 + [STOP_JOG] * 3
    assert wire.reads == ["status"] * 2


def test_invt_che_coast_and_reset_send_the_documented_words() -> None:
    wire = Wire(InvtCHE(1), STANDBY)
    wire.drive.coast()
    wire.drive.reset_fault()
    assert wire.sent == [COAST, RESET]
    wire = Wire(InvtCHE(1), STANDBY, {RESET: [Unconfirmed("drive", "reset", "no reply")]})
    with pytest.raises(Unconfirmed):
        wire.drive.reset_fault()
    assert wire.sent == [RESET]


def test_invt_che_start_in_a_fault_is_refused_until_a_reset() -> None:
    says = {**STANDBY, "status": CHEStatus.FAULT, "fault": CHEFault.OC1_OVERCURRENT_ACCELERATING}
    wire = Wire(InvtCHE(1), says, turns=TURNS)
    for verb in (wire.drive.start, wire.drive.jog):
        with pytest.raises(WriteForbidden, match=r"overcurrent while accelerating.*reset_fault"):
            verb()
    assert wire.sent == []
    wire.drive.reset_fault()
    assert wire.sent == [RESET]
    stubborn = Wire(InvtCHE(1), says)
    with pytest.raises(NotVerified, match="overcurrent while accelerating"):
        stubborn.drive.reset_fault()
    assert stubborn.sent == [RESET]
    with pytest.raises(WriteForbidden, match="runs"):
        Wire(InvtCHE(1), {"status": CHEStatus.FORWARD}).drive.reset_fault()


@table(("name", "word"), [("start", CHEControl.FORWARD), ("jog", CHEControl.JOG_FORWARD)])
def test_invt_che_trip_during_a_start_is_reported(name: str, word: CHEControl) -> None:
    tripped = {"status": CHEStatus.FAULT, "fault": CHEFault.OC1_OVERCURRENT_ACCELERATING}
    sent = frame(InvtCHE(1), InvtCHE.control, word)
    wire = Wire(InvtCHE(1), STANDBY, turns={sent: tripped})
    with pytest.raises(NotVerified, match="tripped: overcurrent while accelerating"):
        getattr(wire.drive, name)()
    assert wire.sent == [sent]


def test_invt_che_setpoint_is_written_in_percent_of_the_maximum_frequency() -> None:
    wire = Wire(InvtCHE(1, maximum_frequency=80))
    wire.drive.set_frequency(40)
    wire.drive.set_frequency(0)
    assert wire.sent == [HALF, ZERO]
    for wrong in (-0.1, 80.1, float("nan")):
        with pytest.raises(ValueError, match="0 to 80 Hz"):
            wire.drive.set_frequency(wrong)
    wire.held.clear()
    wire.says["setpoint"] = [30.0]
    with pytest.raises(NotVerified, match=r"30\.00 %"):
        wire.drive.set_frequency(40)
    with pytest.raises(WriteForbidden, match="maximum_frequency"):
        Wire(InvtCHE(1)).drive.set_frequency(40)


@table(("most", "hz", "count"), [(50, 20.03, 4006), (30, 10, 3333), (60, 40, 6667), (60, 60, 10000)])
def test_invt_che_setpoint_is_rounded_to_a_hundredth_of_a_percent(most: float, hz: float, count: int) -> None:
    line, drive, _ = one(InvtCHE(1, maximum_frequency=most))
    drive.set_frequency(hz)
    (written,) = line.written
    assert int(written[12:17].replace(" ", ""), 16) == count


@table(
    ("says", "state"),
    [
        (STANDBY, State(Condition.STOPPED)),
        ({"status": CHEStatus.FORWARD}, State(Condition.RUNNING, Direction.FORWARD)),
        ({"status": CHEStatus.REVERSE}, State(Condition.RUNNING, Direction.REVERSE)),
        (
            {"status": CHEStatus.FAULT, "fault": CHEFault.OL1_MOTOR_OVERLOAD},
            State(Condition.FAULT, fault="motor overload (OL1)"),
        ),
        ({"status": CHEStatus.FAULT, "fault": CHEFault.NONE}, State(Condition.FAULT)),  # read before
        ({"status": CHEStatus.FAULT, "fault": 99}, State(Condition.FAULT, fault="99")),
        ({"status": 9}, State(Condition.UNKNOWN, note="1001H = 9 is not explained")),
    ],
)
def test_invt_che_status_word_decodes_to_the_state(says: dict[str, object], state: State) -> None:
    assert Wire(InvtCHE(1), says).drive.state() == state


def test_invt_che_identity_check_refuses_other_device_codes() -> None:
    for device in (0x0101, 0x0102):
        Wire(InvtCHE(1), {"device": InvtCHE.device.decode(device)}).drive.identify()
    with pytest.raises(WriteForbidden, match="010AH"):
        Wire(InvtCHE(1), {"device": InvtCHE.device.decode(0x010A)}).drive.identify()


def test_user_declared_invt_che_parameter_is_written_to_the_ram_address() -> None:
    class Mine(InvtCHE):
        """A user's family with parameters from the drive's manual."""

        acceleration_time = parameter(12, "s", step=0.1, place="P0.07")
        way = parameter(13, CHEStatus)

    assert Mine.acceleration_time.ram_address == 0x800C  # the RAM address printed in section 11.6.4
    assert Mine.acceleration_time.kept is Kept.EEPROM
    assert Mine.acceleration_time.readable
    assert parameter(58).address == 0x003A
    assert Mine.way.decode(3) is CHEStatus.STANDBY
    for wrong in (-1, 512):
        with pytest.raises(ValueError, match="0 to 511"):
            parameter(wrong)


def test_invt_che_stored_parameter_is_written_to_eeprom_and_counted(tmp_path: Path) -> None:
    """The frame is the example of section 11.6.2, which does not explain its value."""

    class Mine(InvtCHE):
        """A user's family with parameters from the drive's manual."""

        jump = stored_parameter(8, place="P0.08")
        ramp = parameter(11, "s", step=0.1)

    assert (Mine.jump.kept, Mine.jump.ram_address) == (Kept.EEPROM, None)
    with pytest.raises(ValueError, match="0 to 511"):
        stored_parameter(512)
    ledger = Ledger(tmp_path / "wear", budget=100)
    line, drive, sim = one(Mine(2), ledger=ledger)
    drive.write(drive.ramp, 3.0)
    assert ledger.wear(line.seconds) == []
    drive.write(drive.jump, 0x1388)
    # the frame of section 11.6.2, with a checksum computed manually
    assert line.written[-1] == "02 06 00 08 13 88 05 6D"
    with pytest.raises(WriteForbidden, match="only one write in 60 s"):
        drive.write(drive.jump, 0x1389)
    assert sim.counters.eeprom_writes == {"jump": 1}


def test_invt_che_start_after_a_jog_requires_a_stop() -> None:
    jog = checksums.rtu("01 06 10 00 00 03").hex(" ").upper()
    wire = Wire(
        InvtCHE(1),
        STANDBY,
        turns={**TURNS, jog: {"status": CHEStatus.FORWARD}, STOP: {"status": CHEStatus.STANDBY}},
    )
    wire.drive.jog()
    with pytest.raises(WriteForbidden, match=r"may still be jogging.*call stop\(\) first"):
        wire.drive.start()
    wire.drive.stop()
    wire.drive.start()
    wire.drive.start()  # the motor already runs
    assert wire.sent == [jog, STOP, FORWARD, FORWARD]
