"""ERMAN ER-G-220-01(02): the register table, and the frames that verbs send."""

from __future__ import annotations

import checksums
import pytest
from scripts import Wire, frame, rows, typed
from simulated_bus import one
from tables import table

from multidrop.core import NumberFormat
from multidrop.drive import Condition, Direction
from multidrop.drive.register import COIL, HOLDING, INPUT, Kept
from multidrop.errors import (
    BadReply,
    DriveException,
    NoReply,
    NotVerified,
    Unconfirmed,
    Unsupported,
    WriteForbidden,
)
from multidrop.families.erman_er_g_220 import Coil, ErmanERG220, ErmanFault, ErmanStatus, Modes

START_ON = "01 05 00 00 FF 00 8C 3A"  # printed in section 7 of the manual
START_OFF = "01 05 00 00 00 00 CD CA"
STOP_ON = "01 05 00 01 FF 00 DD FA"
STOP_OFF = "01 05 00 01 00 00 9C 0A"
EMERGENCY_ON = "01 05 00 02 FF 00 2D FA"
RESET_ON = "01 05 00 09 FF 00 5C 38"
RESET_OFF = "01 05 00 09 00 00 1D C8"
FREQUENCY_28_5 = "01 06 00 02 01 1D E9 93"  # the manual's example has the wrong address 0001H

STOPPED = {
    "frequency": 25.0,
    "status": ErmanStatus.STOPPED,
    "output_frequency": 0.0,
    "last_fault": ErmanFault(0),
    "deceleration_time": 10.0,
}

TURNS = {START_ON: {"status": ErmanStatus.ACCELERATING}, STOP_ON: {"status": ErmanStatus.STOPPED}}

TABLE = """
01/05 0000 start_coil                - Coil
01/05 0001 stop_coil                 - Coil
01/05 0002 emergency_stop_coil       - Coil
01/05 0009 fault_reset_coil          - Coil
04/00 0001 output_frequency        0.1 Hz
04/00 0003 output_current          0.1 A
04/00 0005 dc_bus_voltage            1 V
04/00 0006 heatsink_temperature      1 °C
04/00 000C output_voltage            1 V
04/00 0400 status                    - ErmanStatus
04/00 0402 last_fault                - ErmanFault
03/06 0001 control_register          - Modes
03/06 0002 frequency               0.1 Hz
03/06 0003 maximum_frequency       0.1 Hz
03/06 0004 minimum_frequency       0.1 Hz
03/06 000B carrier_frequency       0.1 kHz
03/06 000C acceleration_time       0.1 s
03/06 000D deceleration_time       0.1 s
03/06 0015 braking_threshold         1 V
01/05 0000 start_held                - Coil
01/05 0001 stop_held                 - Coil
01/05 0002 emergency_stop_held       - Coil
01/05 0009 fault_reset_held          - Coil
"""


def test_erman_registers_equal_the_table_of_section_10() -> None:
    assert rows(ErmanERG220) == typed(TABLE)


def test_erman_line_settings_and_limits_are_those_of_the_document() -> None:
    drive = ErmanERG220(1)
    assert str(drive.settings) == "38400 8N1"
    assert ErmanERG220.addresses == range(1, 32)
    assert ErmanERG220.most_registers == {HOLDING: 88, INPUT: 17, COIL: 12}
    assert ErmanERG220.readable_gaps == {HOLDING: range(0x59), INPUT: range(0x1000)}
    assert set(ErmanERG220.exceptions) == {1, 2, 3, 4}
    # The manual explains code 3 at its example of an exception reply, 01 86 03 02 61.
    assert "read or write" in ErmanERG220.exceptions[3]
    assert "write" in drive.exception(4)
    assert not ErmanERG220.broadcasts
    for wrong in ({"baudrate": 9600}, {"format": "8E1"}):
        with pytest.raises(ValueError, match=r"38400|8N1"):
            ErmanERG220(1, **wrong)
    with pytest.raises(ValueError, match="1 to 31"):
        ErmanERG220(32)


def test_erman_status_and_fault_bits_have_the_documented_names() -> None:
    assert [bit.value for bit in ErmanFault] == [1 << at for at in (0, 1, 2, 3, 4, 5, 6, 7, 10, 11)]
    assert [bit.value for bit in Modes] == [1 << 0, 1 << 4, 1 << 8]
    assert ErmanERG220.status.number_format is ErmanERG220.last_fault.number_format is NumberFormat.U32_EITHER
    assert ErmanERG220.status.decode(0x22) is ErmanStatus.ACCELERATING_OVERLOADED
    assert ErmanERG220.heatsink_temperature.number_format is NumberFormat.I16
    assert all(register.kept is Kept.UNKNOWN for register in ErmanERG220.registers.values())


def test_erman_register_0001h_is_read_and_never_written() -> None:
    assert ErmanERG220.control_register.readable
    assert not ErmanERG220.control_register.writable


def test_erman_start_clears_both_stop_coils_and_writes_no_setpoint() -> None:
    wire = Wire(ErmanERG220(1), STOPPED, turns=TURNS)
    wire.drive.start()
    assert wire.sent == [STOP_OFF, frame(wire.drive, ErmanERG220.emergency_stop_coil, Coil.OFF), START_ON]


def test_erman_start_in_reverse_is_unsupported() -> None:
    wire = Wire(ErmanERG220(1), STOPPED, turns=TURNS)
    with pytest.raises(Unsupported, match="reverse"):
        wire.drive.start(Direction.REVERSE)
    assert wire.sent == []
    wire.drive.start(Direction.FORWARD)
    assert wire.sent[-1] == START_ON


def test_erman_start_is_refused_until_the_last_fault_is_reset() -> None:
    wire = Wire(ErmanERG220(1), {**STOPPED, "last_fault": ErmanFault.OVERHEAT}, turns=TURNS)
    with pytest.raises(WriteForbidden, match=r"overheat.*reset_fault.*acknowledged_fault = 64"):
        wire.drive.start()
    assert wire.sent == []
    wire.drive.reset_fault()
    assert START_ON not in wire.sent
    wire.drive.start()
    assert wire.sent[-1] == START_ON
    wire.says["last_fault"] = [ErmanFault.LOW_DC_VOLTAGE]
    with pytest.raises(WriteForbidden, match="low DC voltage"):
        wire.drive.start()


@table("fault", ErmanFault)
def test_erman_start_is_refused_until_a_fault_is_acknowledged(fault: ErmanFault) -> None:
    wire = Wire(ErmanERG220(1), {**STOPPED, "last_fault": fault}, turns=TURNS)
    with pytest.raises(WriteForbidden, match=f"acknowledged_fault = {int(fault)}"):
        wire.drive.start()
    assert wire.sent == []


def test_erman_starts_after_a_fault_acknowledged_by_option() -> None:
    wire = Wire(
        ErmanERG220(1, acknowledged_fault=64), {**STOPPED, "last_fault": ErmanFault.OVERHEAT}, turns=TURNS
    )
    wire.drive.start()
    assert wire.sent[-1] == START_ON


def test_erman_stop_sets_the_stop_coil_and_clears_the_start_coil() -> None:
    wire = Wire(
        ErmanERG220(1),
        {
            **STOPPED,
            "status": [ErmanStatus.ACCELERATING, ErmanStatus.DECELERATING, ErmanStatus.STOPPED],
            "output_frequency": [0.4, 0.0],
        },
    )
    wire.drive.stop()
    assert wire.sent == [STOP_ON, START_OFF]
    # the third reading shows "stopped", but the frequency is still 0.4 Hz
    assert wire.reads.count("status") == 4


def test_erman_stop_without_effect_is_followed_by_an_emergency_stop() -> None:
    wire = Wire(ErmanERG220(1), {**STOPPED, "status": ErmanStatus.RUNNING})
    with pytest.raises(Unconfirmed, match="does not report a stop within"):
        wire.drive.stop()
    assert wire.sent == [STOP_ON, START_OFF, EMERGENCY_ON]
    assert 30 <= wire.seconds <= 31  # two waits, each of 10 s (deceleration time) and 5 s (STOP_MARGIN)


@table("failure", [NoReply("drive"), BadReply("drive", "odd", b"\1"), DriveException("drive", 2, "")])
def test_an_erman_is_stopped_without_a_readable_deceleration_time(failure: Exception) -> None:
    says = {**STOPPED, "deceleration_time": failure, "status": ErmanStatus.RUNNING}
    stops = {EMERGENCY_ON: {"status": ErmanStatus.STOPPED}}
    wire = Wire(ErmanERG220(1), says, turns=stops)
    wire.drive.stop()
    assert wire.sent == [STOP_ON, START_OFF, EMERGENCY_ON]
    assert 30 <= wire.seconds <= 31
    wire = Wire(ErmanERG220(1), says, turns=stops)
    wire.drive.emergency_stop()
    assert wire.sent == [EMERGENCY_ON, START_OFF]


def test_erman_start_coil_is_cleared_after_an_unconfirmed_stop() -> None:
    lost = [Unconfirmed("drive", "stop", "no reply")] * 3
    for stop in (STOP_ON, EMERGENCY_ON):
        wire = Wire(ErmanERG220(1), STOPPED, {stop: lost})
        with pytest.raises(Unconfirmed, match="no reply"):  # the caller then repeats the whole stop
            (wire.drive.stop if stop == STOP_ON else wire.drive.emergency_stop)()
        assert wire.sent == [*[stop] * 3, START_OFF]
        wire = Wire(ErmanERG220(1), STOPPED, {stop: lost, START_OFF: lost})
        # START_OFF is sent once, even if it is unconfirmed: the caller then repeats the whole stop.
        with pytest.raises(Unconfirmed, match="no reply"):
            (wire.drive.stop if stop == STOP_ON else wire.drive.emergency_stop)()
        assert wire.sent == [*[stop] * 3, START_OFF]


def test_refused_erman_stop_is_followed_by_the_emergency_stop() -> None:
    refusal = DriveException("drive", 3, "")
    for refused, begun in ((STOP_ON, [STOP_ON] * 3), (START_OFF, [STOP_ON, *[START_OFF] * 3])):
        wire = Wire(ErmanERG220(1), STOPPED, {refused: [refusal] * 3})
        wire.drive.stop()
        assert wire.sent == [*begun, EMERGENCY_ON, START_OFF]
        assert wire.reads == ["deceleration_time", "status", "output_frequency"]  # watched once


def test_erman_stop_is_sent_again_if_its_reply_is_lost() -> None:
    lost = Unconfirmed("drive", "stop", "no reply")
    wire = Wire(ErmanERG220(1), STOPPED, {STOP_ON: [lost, DriveException("drive", 3, "")]})
    wire.drive.stop()
    assert wire.sent == [STOP_ON] * 3 + [START_OFF]
    wire = Wire(ErmanERG220(1), STOPPED, {STOP_ON: [lost] * 3})
    with pytest.raises(Unconfirmed, match="no reply"):
        wire.drive.stop()


def test_erman_start_is_sent_only_once_if_its_reply_is_lost() -> None:
    wire = Wire(ErmanERG220(1), STOPPED, {START_ON: [Unconfirmed("drive", "start", "no reply")]})
    with pytest.raises(Unconfirmed):
        wire.drive.start()
    assert wire.sent.count(START_ON) == 1


def test_erman_start_is_refused_if_the_setpoint_is_0_or_was_changed() -> None:
    wire = Wire(
        ErmanERG220(1), {**STOPPED, "frequency": 0.0, "maximum_frequency": 50.0, "minimum_frequency": 0.0}
    )
    with pytest.raises(WriteForbidden, match="set_frequency"):
        wire.drive.start()
    del wire.says["frequency"]
    wire.drive.set_frequency(20)
    wire.held["frequency"] = 30.0
    sent = list(wire.sent)
    with pytest.raises(WriteForbidden, match=r"holds the setpoint 30\.0 Hz, not the written 20\.0 Hz"):
        wire.drive.start()
    assert wire.sent == sent


def test_the_error_names_the_keypad_setting_if_an_erman_does_not_start() -> None:
    wire = Wire(ErmanERG220(1), STOPPED)
    with pytest.raises(
        Unconfirmed, match=r"no run within .* s\..* or its motor may start later; b\.001 must be 2"
    ):
        wire.drive.start()
    assert wire.sent.count(START_ON) == 1


def test_erman_emergency_stop_sets_its_coil_and_clears_the_start_coil() -> None:
    wire = Wire(ErmanERG220(1), STOPPED)
    wire.drive.emergency_stop()
    assert wire.sent == [EMERGENCY_ON, START_OFF]
    wire = Wire(ErmanERG220(1), {**STOPPED, "status": ErmanStatus.RUNNING})
    with pytest.raises(Unconfirmed):
        wire.drive.emergency_stop()


def test_erman_fault_reset_pulses_the_reset_coil_after_clearing_start() -> None:
    wire = Wire(ErmanERG220(1), STOPPED)
    wire.drive.reset_fault()
    assert wire.sent == [START_OFF, RESET_ON, RESET_OFF]
    wire = Wire(ErmanERG220(1), STOPPED, {RESET_ON: [Unconfirmed("drive", "reset", "no reply")]})
    with pytest.raises(Unconfirmed):
        wire.drive.reset_fault()
    assert wire.sent == [START_OFF, RESET_ON, RESET_OFF]
    wire = Wire(ErmanERG220(1), {**STOPPED, "status": ErmanStatus.RUNNING_OVERLOADED})
    with pytest.raises(WriteForbidden, match="runs"):
        wire.drive.reset_fault()
    assert wire.sent == []


def test_erman_setpoint_is_written_to_0002h_within_its_limits() -> None:
    wire = Wire(ErmanERG220(1), {"maximum_frequency": 50.0, "minimum_frequency": 5.0})
    wire.drive.set_frequency(28.5)
    assert wire.sent == [FREQUENCY_28_5]
    with pytest.raises(WriteForbidden, match=r"50\.1 Hz is above maximum_frequency, which is 50 Hz .*b\.007"):
        wire.drive.set_frequency(50.1)
    with pytest.raises(WriteForbidden, match=r"4\.9 Hz is below minimum_frequency, which is 5 Hz"):
        wire.drive.set_frequency(4.9)
    with pytest.raises(ValueError, match="frequency"):
        wire.drive.set_frequency(-1)
    assert wire.sent == [FREQUENCY_28_5]
    del wire.held["frequency"]
    wire.says["frequency"] = [20.0]
    with pytest.raises(NotVerified, match=r"the drive holds 20\.0 Hz"):
        wire.drive.set_frequency(28.5)


@table(
    ("status", "fault", "condition", "note"),
    [
        (0, 0, Condition.STOPPED, ""),
        (1, 0, Condition.RUNNING, ""),
        (2, 64, Condition.ACCELERATING, ""),
        (3, 0, Condition.DECELERATING, ""),
        (0x21, 0, Condition.RUNNING, "motor overloaded"),
        (0x8001, 0, Condition.RUNNING, ""),  # reserved bits have no effect
        (
            0,
            0x0402,
            Condition.STOPPED,
            "last fault low DC voltage, system error, which may still be in force",
        ),
    ],
)
def test_the_erman_state_mentions_the_last_fault(
    status: int, fault: int, condition: Condition, note: str
) -> None:
    says = {"status": ErmanERG220.status.decode(status), "last_fault": ErmanERG220.last_fault.decode(fault)}
    state = Wire(ErmanERG220(1), says).drive.state()
    assert (state.condition, state.note, state.fault) == (condition, note, None)


def test_reserved_erman_fault_bits_count_as_a_fault() -> None:
    """Bits 8, 9 and 12 to 31 of the last fault are reserved (section 10, state registers 1026-1027)."""
    wire = Wire(ErmanERG220(1), {**STOPPED, "last_fault": ErmanERG220.last_fault.decode(0x1100)}, turns=TURNS)
    assert "last fault bit 8, bit 12" in wire.drive.state().note
    with pytest.raises(WriteForbidden, match="may have a fault, bit 8, bit 12"):
        wire.drive.start()
    assert wire.sent == []


def test_an_erman_without_register_0400h_fails_the_identity_check() -> None:
    Wire(ErmanERG220(1), STOPPED).drive.identify()
    with pytest.raises(WriteForbidden, match="0400H"):
        Wire(ErmanERG220(1), {"status": DriveException("drive", 1, "")}).drive.identify()
    with pytest.raises(NoReply):
        Wire(ErmanERG220(1), {"status": NoReply("drive")}).drive.identify()


def test_one_read_of_erman_coils_never_spans_two_bytes() -> None:
    """The order of two bytes in a reply is doubtful (section 6). Coils are read only on request."""
    line, drive, _ = one(ErmanERG220(1))
    coils = [drive.start_held, drive.stop_held, drive.emergency_stop_held, drive.fault_reset_held]
    assert not set(coils) & set(drive.readings())
    held = drive.read_many(coils)
    assert held == dict.fromkeys((coil.name for coil in coils), Coil.OFF)
    asked = [frame for request, frame in line.frames if request.function == 1]
    assert asked == [
        checksums.rtu(name).hex(" ").upper() for name in ("01 01 00 00 00 03", "01 01 00 09 00 01")
    ]
    drive.set_frequency(20)
    drive.start()
    assert drive.read(drive.start_held) is Coil.ON
    drive.stop()
    assert drive.read(drive.start_held) is Coil.OFF
    assert drive.read(drive.stop_held) is Coil.ON
    for register in coils:
        with pytest.raises(WriteForbidden, match="it is a reading"):
            drive.write(register, Coil.ON)


def test_erman_diagnostics_request_can_be_sent_with_send_raw() -> None:
    """`send_raw` sends function 08 (section 8). The misprinted error reply counts as a refusal too."""
    line, drive, _ = one(ErmanERG220(1))
    assert drive.send_raw(0x08, 0x0000, b"\xa5\x37") == b"\xa5\x37"
    asked, read = (frame for _, frame in line.frames)
    assert asked == "01 08 00 00 A5 37 DA 8D"
    assert read.startswith("01 04")  # a reply that is a copy may be an echo, so the next request is a read
    for refusal in ("01 89 01 86 50", "01 88 01 87 C0"):
        line.answers = lambda request, refusal=refusal: bytes.fromhex(refusal)  # type: ignore[misc]
        with pytest.raises(DriveException, match="unknown command"):
            drive.send_raw(0x08, 0x0000, b"\xa5\x37")
