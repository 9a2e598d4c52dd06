"""Delixi 9200 and 9100-SC: the register tables, and the frames that verbs send, as the document has them."""

from __future__ import annotations

from pathlib import Path

import pytest
from scripts import DELIXI_MONITORS, Wire, frame, rows, typed
from simulated_bus import one
from tables import table

from multidrop.control.eeprom_ledger import Ledger
from multidrop.drive import Condition, Direction, Framing, State
from multidrop.drive.register import HOLDING, Carrier, Kept, setting
from multidrop.errors import NoReply, NotVerified, Unconfirmed, WriteForbidden
from multidrop.families.delixi import (
    PARAMETER,
    PARAMETER_RAM,
    DelixiBaudrate,
    DelixiFault,
    DelixiModbus,
    DelixiModbusControl,
    DelixiNative,
    DelixiNativeStatus,
    DelixiRunSource,
    parameter,
)

# ---- standard Modbus ----


MODBUS_FORWARD = {
    Framing.RTU: "01 06 20 00 00 12 02 07",
    Framing.ASCII: ":010620000012C7",
}  # printed in its manual
MODBUS_FIFTY = {
    Framing.RTU: "01 06 00 02 13 88 25 5C",
    Framing.ASCII: ":0106000213885C",
}  # printed in its manual
MODBUS_STOP = {Framing.RTU: "01 06 20 00 00 01 43 CA", Framing.ASCII: ":010620000001D8"}
MODBUS_REVERSE = {Framing.RTU: "01 06 20 00 00 22 02 13", Framing.ASCII: ":010620000022B7"}

MODBUS_STANDING = {
    "output_frequency": 0.0,
    "fault": DelixiFault.NONE,
    "run_source": DelixiRunSource.LINE,
    "frequency_source": 1,
    "frequency": 50.0,
    "address_setting": 1,
    "baudrate_setting": DelixiBaudrate.B9600,
}
MODBUS_TURNING = {"output_frequency": 12.0}
MODBUS_TURNS = {
    each: MODBUS_TURNING for frames in (MODBUS_FORWARD, MODBUS_REVERSE) for each in frames.values()
} | {each: {"output_frequency": 0.0} for each in MODBUS_STOP.values()}

MODBUS_TABLE = """
03/06 2000 control           - DelixiModbusControl
03/06 0002 frequency      0.01 Hz
"""


def test_delixi_modbus_registers_equal_the_table_of_the_document() -> None:
    shared = "\n".join(f"03/06 {line}" for line in DELIXI_MONITORS.strip().splitlines())
    assert rows(DelixiModbus) == typed(MODBUS_TABLE + shared)


def test_delixi_line_settings_and_limits_are_those_of_the_document() -> None:
    assert str(DelixiModbus(31).settings) == "9600 8N2"
    assert str(DelixiModbus(1, framing="ascii").settings) == "9600 7N2"
    assert DelixiModbus.formats[Framing.RTU] == ("8N2", "8E1", "8O1")
    assert DelixiModbus.formats[Framing.ASCII] == ("7N2", "7E1", "7O1")
    assert sorted(DelixiModbus.baudrates) == [1200, 2400, 4800, 9600, 19200, 38400]
    assert DelixiModbus.addresses == range(1, 32)
    assert DelixiModbus.most_registers == {HOLDING: 1}
    with pytest.raises(ValueError, match="7N2"):
        DelixiModbus(1, framing="ascii", format="8N2")


def test_delixi_control_words_never_set_the_toggle_bit() -> None:
    assert {each.value for each in DelixiModbusControl} == {0x00, 0x01, 0x12, 0x22, 0x13, 0x23}


def test_delixi_character_formats_have_the_codes_of_the_manual() -> None:
    """P04.29: 0 to 2 are ASCII with 7 data bits, 3 to 5 RTU with 8."""
    names = ["ASCII_7N2", "ASCII_7E1", "ASCII_7O1", "RTU_8N2", "RTU_8E1", "RTU_8O1"]
    assert [DelixiModbus.format_setting.decode(raw).name for raw in range(6)] == names


def test_delixi_start_after_a_jog_requires_a_stop() -> None:
    jog = frame(DelixiModbus(1), DelixiModbus.control, DelixiModbusControl.JOG_FORWARD)
    wire = Wire(DelixiModbus(1), MODBUS_STANDING, turns={jog: MODBUS_TURNING} | MODBUS_TURNS)
    wire.drive.jog()
    with pytest.raises(WriteForbidden, match=r"may still be jogging.*call stop\(\) first"):
        wire.drive.start(Direction.FORWARD)
    wire.drive.stop()
    wire.drive.start(Direction.FORWARD)
    wire.drive.start(Direction.REVERSE)  # the motor already runs
    assert wire.sent == [
        jog,
        MODBUS_STOP[Framing.RTU],
        MODBUS_FORWARD[Framing.RTU],
        MODBUS_REVERSE[Framing.RTU],
    ]


def test_delixi_fault_codes_decode_to_the_documented_names() -> None:
    assert [each.value for each in DelixiFault] == list(range(15))
    assert DelixiModbus.fault.decode(14) is DelixiFault.FLT_MODULE


@table("framing", DelixiModbus.framings)
def test_each_delixi_verb_sends_the_documented_frame(framing: Framing) -> None:
    wire = Wire(DelixiModbus(1, framing=framing), MODBUS_STANDING, turns=MODBUS_TURNS)
    wire.drive.set_frequency(50)
    wire.drive.start()
    wire.drive.start(Direction.FORWARD)
    wire.drive.start(Direction.REVERSE)
    wire.drive.stop()
    forward = MODBUS_FORWARD[framing]
    assert wire.sent == [
        MODBUS_FIFTY[framing],
        forward,
        forward,
        MODBUS_REVERSE[framing],
        MODBUS_STOP[framing],
    ]


def test_delixi_jog_sends_the_control_word_of_its_direction() -> None:
    jogs = [
        frame(DelixiModbus(1), DelixiModbus.control, word)
        for word in (DelixiModbusControl.JOG_FORWARD, DelixiModbusControl.JOG_REVERSE)
    ]
    wire = Wire(DelixiModbus(1), MODBUS_STANDING, turns=dict.fromkeys(jogs, MODBUS_TURNING))
    wire.drive.jog()
    for direction in Direction:
        with pytest.raises(
            WriteForbidden, match=r"already turns, and a jog must start from rest: call stop\(\) first"
        ):
            wire.drive.jog(direction)
    wire.say(MODBUS_STANDING)
    wire.drive.jog(Direction.REVERSE)
    assert [each[:17] for each in wire.sent] == ["01 06 20 00 00 13", "01 06 20 00 00 23"]


@table("name", ["start", "jog"])
def test_delixi_start_is_unconfirmed_if_the_motor_does_not_run(name: str) -> None:
    wire = Wire(DelixiModbus(1), MODBUS_STANDING)
    with pytest.raises(
        Unconfirmed, match=r"reports no run within .* s\. Stop it, or its motor may start later"
    ):
        getattr(wire.drive, name)()
    assert len(wire.sent) == 1


def test_delixi_start_of_a_turning_motor_without_a_direction_is_refused() -> None:
    wire = Wire(DelixiModbus(1), {**MODBUS_STANDING, **MODBUS_TURNING})
    with pytest.raises(WriteForbidden, match="give a direction, forward or reverse"):
        wire.drive.start()
    assert wire.sent == []
    wire.drive.start(Direction.FORWARD)
    assert wire.sent == [MODBUS_FORWARD[Framing.RTU]]


def test_delixi_stop_waits_until_the_output_frequency_is_0() -> None:
    wire = Wire(DelixiModbus(1), {"output_frequency": [30.0, 10.0, 0.0]})
    wire.drive.stop()
    assert len(wire.reads) == 3
    wire = Wire(DelixiModbus(1, stop_time=30), {"output_frequency": 5.0})
    with pytest.raises(Unconfirmed, match="30 s"):
        wire.drive.stop()
    assert wire.sent == [MODBUS_STOP[Framing.RTU]]


def test_delixi_setpoint_write_raises_if_the_drive_keeps_another_value() -> None:
    assert DelixiModbus.frequency.kept is Kept.EEPROM
    assert "EEPROM" in DelixiModbus.frequency.note
    wire = Wire(DelixiModbus(1), {"frequency": 40.0})
    with pytest.raises(NotVerified, match=r"holds 40\.00 Hz"):
        wire.drive.set_frequency(50)


@table(
    ("says", "state"),
    [
        ({"fault": DelixiFault.NONE, "output_frequency": 12.0}, State(Condition.RUNNING)),
        ({"fault": DelixiFault.OH_OVERHEAT}, State(Condition.FAULT, fault="overheat (OH)")),
        ({"fault": 99}, State(Condition.FAULT, fault="99")),
    ],
)
def test_delixi_state_shows_a_fault_or_a_turning_motor(says: dict[str, object], state: State) -> None:
    assert Wire(DelixiModbus(1), says).drive.state() == state


def test_delixi_state_at_0_hz_is_unknown() -> None:
    assert Wire(DelixiModbus(1), MODBUS_STANDING).drive.state().condition is Condition.UNKNOWN


def test_delixi_identity_check_compares_address_and_baud_rate() -> None:
    Wire(DelixiModbus(1), MODBUS_STANDING).drive.identify()
    for name, other, sentence in (
        ("fault", 99, "0063H"),
        ("address_setting", 2, r"P04\.30"),
        ("baudrate_setting", DelixiBaudrate.B1200, r"P04\.28"),
    ):
        with pytest.raises(WriteForbidden, match=sentence):
            Wire(DelixiModbus(1), {**MODBUS_STANDING, name: other}).drive.identify()


@table(
    ("name", "held", "sentence"),
    [
        ("run_source", DelixiRunSource.KEYPAD, r"P00\.00 must be 2"),
        ("frequency_source", 0, r"P00\.01"),
        ("fault", DelixiFault.OH_OVERHEAT, "overheat"),
        ("frequency", 0.0, "set_frequency"),
    ],
)
def test_delixi_start_is_refused_with_a_fault_or_wrong_settings(
    name: str, held: float, sentence: str
) -> None:
    wire = Wire(DelixiModbus(1), {**MODBUS_STANDING, name: held})
    with pytest.raises(WriteForbidden, match=sentence):
        wire.drive.start()
    assert wire.sent == []


# ---- Delixi's own protocol ----


NATIVE_FORWARD = ":010200020000000005"  # printed in the document
NATIVE_FIFTY = ":0104000100001388A1"  # printed in the document
NATIVE_FIFTY_STORED = ":0106000200001388A4"  # printed in the document
NATIVE_STOP = ":010200010000000004"
NATIVE_REVERSE = ":010200030000000006"
NATIVE_RESET = ":010200040000000007"

NATIVE_STANDING = {
    "status": DelixiNativeStatus.STOPPED,
    "output_frequency": 0.0,
    "fault": DelixiFault.NONE,
    "run_source": DelixiRunSource.LINE,
    "address_setting": 1,
    "baudrate_setting": DelixiBaudrate.B9600,
}
NATIVE_TURNS = {
    NATIVE_FORWARD: {"status": DelixiNativeStatus.FORWARD, "output_frequency": 9.0},
    NATIVE_REVERSE: {"status": DelixiNativeStatus.REVERSE, "output_frequency": 9.0},
    NATIVE_STOP: {"status": DelixiNativeStatus.STOPPED, "output_frequency": 0.0},
}

NATIVE_TABLE = """
00/02 0000 control             - DelixiNativeControl
03/00 0000 status              - DelixiNativeStatus
00/04 0001 frequency        0.01 Hz
00/04 0007 pi_setpoint       0.1
07/06 0002 stored_frequency 0.01 Hz
"""


def test_delixi_native_registers_equal_the_tables_of_the_document() -> None:
    own = DELIXI_MONITORS.replace("DelixiModbusFormat", "DelixiNativeFormat")
    shared = "\n".join(f"07/06 {line}" for line in own.strip().splitlines())
    assert rows(DelixiNative) == typed(NATIVE_TABLE + shared)


def test_delixi_registers_of_each_function_code_have_the_documented_size() -> None:
    carriers = {
        register.table.write or register.table.read: register.table.carrier
        for register in DelixiNative.registers.values()
    }
    assert carriers == {2: Carrier.NUMBER, 3: Carrier.NUMBER, 4: Carrier.LONG, 6: Carrier.LONG}
    assert (PARAMETER_RAM.read, PARAMETER_RAM.write) == (7, 5)


def test_delixi_native_line_settings_and_limits_are_those_of_the_document() -> None:
    assert DelixiNative(31).framing is Framing.DELIXI
    assert DelixiNative.formats == {Framing.DELIXI: ("8N1", "8E1", "8O1")}
    assert set(DelixiNative.exceptions) == {0xF0, 0xFC, 0xFD, 0xFE, 0xFF}
    assert DelixiNative(1).needed_silence() == 0


def test_delixi_native_character_formats_have_the_codes_of_the_manual() -> None:
    """The codes of P04.29 differ from those in firmware for standard Modbus."""
    assert [DelixiNative.format_setting.decode(raw).name for raw in range(3)] == ["N81", "E81", "O81"]


def test_delixi_native_broadcasts_only_a_stop_command() -> None:
    broadcast = {name: each.broadcast for name, each in DelixiNative.registers.items() if each.broadcast}
    assert broadcast == {"control": (1,)}


def test_each_delixi_native_verb_sends_the_printed_frame() -> None:
    wire = Wire(DelixiNative(1), NATIVE_STANDING, turns=NATIVE_TURNS)
    wire.drive.set_frequency(50)
    wire.drive.start()
    wire.drive.start(Direction.REVERSE)
    wire.drive.stop()
    wire.drive.reset_fault()
    assert wire.sent == [NATIVE_FIFTY, NATIVE_FORWARD, NATIVE_REVERSE, NATIVE_STOP, NATIVE_RESET]


def test_delixi_native_start_keeps_a_running_motors_direction_by_default() -> None:
    wire = Wire(DelixiNative(1), {**NATIVE_STANDING, **NATIVE_TURNS[NATIVE_REVERSE]}, turns=NATIVE_TURNS)
    wire.drive.set_frequency(50)
    wire.drive.start()
    wire.drive.start(Direction.FORWARD)
    assert wire.sent == [NATIVE_FIFTY, NATIVE_REVERSE, NATIVE_FORWARD]


def test_delixi_native_start_without_a_known_setpoint_is_refused() -> None:
    wire = Wire(DelixiNative(1), NATIVE_STANDING)
    with pytest.raises(WriteForbidden, match="set_frequency"):
        wire.drive.start()
    assert wire.sent == []


@table(
    ("status", "sentence"),
    [
        (DelixiNativeStatus.UNDERVOLTAGE, r"a fault, UNDERVOLTAGE: .*reset_fault\(\)"),
        (DelixiNativeStatus.FAULT, r"a fault, FAULT: .*reset_fault\(\)"),
        (9, "reports state 0009H in its reply to K = 03, which the manual does not explain"),
    ],
)
def test_delixi_native_start_is_refused_if_the_motor_could_start_later(status: int, sentence: str) -> None:
    """P05.31 shows no fault here. A run command without mains voltage may take effect later."""
    wire = Wire(DelixiNative(1), {**NATIVE_STANDING, "status": status})
    wire.drive.set_frequency(50)
    for direction in (None, *Direction):
        with pytest.raises(WriteForbidden, match=sentence):
            wire.drive.start(direction)
    assert wire.sent == [NATIVE_FIFTY]


@table(
    ("says", "sentence"),
    [
        ({"run_source": DelixiRunSource.KEYPAD}, "does not take commands from the line"),
        ({"fault": DelixiFault.OC_OVERCURRENT}, "has a fault, overcurrent .OC.: remove the cause"),
    ],
)
def test_delixi_native_start_is_refused_under_panel_control_or_with_a_fault(
    says: dict[str, object], sentence: str
) -> None:
    wire = Wire(DelixiNative(1), NATIVE_STANDING | says, turns=NATIVE_TURNS)
    wire.drive.set_frequency(50)
    with pytest.raises(WriteForbidden, match=sentence):
        wire.drive.start()
    assert wire.sent == [NATIVE_FIFTY]


def test_delixi_native_start_is_unconfirmed_if_the_motor_is_not_seen_to_run() -> None:
    wire = Wire(DelixiNative(1), NATIVE_STANDING)
    wire.drive.set_frequency(50)
    with pytest.raises(
        Unconfirmed, match=r"reports no run within .* s\. Stop it, or its motor may start later"
    ):
        wire.drive.start()
    assert wire.sent == [NATIVE_FIFTY, NATIVE_FORWARD]


def test_delixi_setpoint_in_eeprom_is_written_with_function_06() -> None:
    drive = DelixiNative(1)
    assert frame(drive, DelixiNative.stored_frequency, 50) == NATIVE_FIFTY_STORED
    assert DelixiNative.stored_frequency.kept is Kept.EEPROM
    assert DelixiNative.frequency.kept is Kept.RAM


def test_delixi_native_stop_waits_for_run_state_and_frequency() -> None:
    wire = Wire(
        DelixiNative(1),
        {"status": [DelixiNativeStatus.REVERSE, DelixiNativeStatus.STOPPED], "output_frequency": [3.0, 0.0]},
    )
    wire.drive.stop()
    assert wire.reads == ["status", "status", "output_frequency", "status", "output_frequency"]
    wire = Wire(DelixiNative(1), {"status": DelixiNativeStatus.FORWARD})
    with pytest.raises(Unconfirmed, match="60 s"):
        wire.drive.stop()


@table(
    ("raw", "fault"),
    [
        (0x00, DelixiFault.NONE),
        (0x09, DelixiFault.OL_OVERLOAD),
        (0x0A, DelixiFault.EF_EXTERNAL),
        (0x0E, DelixiFault.FLT_MODULE),
        (0x10, DelixiFault.EF_EXTERNAL),
        (0x11, DelixiFault.PARAMETER_WRITE),
        (0x12, DelixiFault.VFOP_VF1_CHANNEL_BROKEN),
        (0x13, DelixiFault.IFOP_VF2_CHANNEL_BROKEN),
        (0x14, DelixiFault.FLT_MODULE),
        (0x0F, 0x0F),
        (0x15, 0x15),
    ],
)
def test_delixi_fault_codes_may_be_decimal_or_hex_digits(raw: int, fault: int) -> None:
    decoded = DelixiNative.fault.decode(raw)
    assert decoded == fault
    assert isinstance(decoded, DelixiFault) == isinstance(fault, DelixiFault)


@table(
    ("says", "state"),
    [
        (NATIVE_STANDING, State(Condition.STOPPED)),
        (
            {"status": DelixiNativeStatus.FORWARD, "output_frequency": 9.0},
            State(Condition.RUNNING, Direction.FORWARD),
        ),
        (
            {"status": DelixiNativeStatus.REVERSE, "output_frequency": 9.0},
            State(Condition.RUNNING, Direction.REVERSE),
        ),
        (
            # the motor runs at 0 Hz, so it is not stopped
            {"status": DelixiNativeStatus.FORWARD, "output_frequency": 0.0},
            State(Condition.RUNNING, Direction.FORWARD, note="output frequency 0"),
        ),
        (
            {"status": DelixiNativeStatus.FAULT, "fault": DelixiFault.OC_OVERCURRENT},
            State(Condition.FAULT, fault="overcurrent (OC)"),
        ),
        (
            {"status": DelixiNativeStatus.UNDERVOLTAGE, "fault": DelixiFault.NONE},
            State(Condition.FAULT, fault="undervoltage"),
        ),
        ({"status": 9}, State(Condition.UNKNOWN, note="K = 03 says 0009H, which is not explained")),
    ],
)
def test_delixi_native_state_shows_run_direction_and_fault(says: dict[str, object], state: State) -> None:
    assert Wire(DelixiNative(1), says).drive.state() == state


def test_delixi_native_identity_check_compares_address_and_baud_rate() -> None:
    wire = Wire(DelixiNative(1), NATIVE_STANDING)
    wire.drive.identify()
    assert (wire.reads, wire.sent) == (["address_setting", "baudrate_setting"], [])
    with pytest.raises(NoReply):
        Wire(DelixiNative(1), {"address_setting": NoReply("drive")}).drive.identify()
    with pytest.raises(WriteForbidden, match=r"P04\.30"):
        Wire(DelixiNative(2), NATIVE_STANDING).drive.identify()


def test_delixi_subclass_keeps_the_registers_and_adds_its_own() -> None:
    class Mine(DelixiNative):
        """A user's family with a parameter from the drive's list."""

        acceleration_time = setting(parameter(0, 17), "s", step=0.1, table=PARAMETER_RAM)

    assert Mine.output_current.table is DelixiNative.output_current.table
    assert frame(Mine(1), Mine.acceleration_time, 20).startswith(":01050011000000C8")
    assert set(Mine.registers) - set(DelixiNative.registers) == {"acceleration_time"}


class Owned(DelixiNative):
    """A user's family with a parameter in RAM, written by K = 05, and one in EEPROM, by K = 06."""

    ramp = setting(parameter(0, 17), "s", step=0.1, table=PARAMETER_RAM)
    stored_ramp = setting(parameter(0, 18), "s", step=0.1, table=PARAMETER)


def test_register_table_of_a_delixi_parameter_selects_ram_or_eeprom() -> None:
    assert (Owned.ramp.kept, Owned.stored_ramp.kept) == (Kept.RAM, Kept.EEPROM)
    kept = {name: each.kept for name, each in DelixiNative.registers.items() if each.writable}
    assert kept == {
        "control": Kept.RAM,
        "frequency": Kept.RAM,
        "pi_setpoint": Kept.RAM,
        "stored_frequency": Kept.EEPROM,
    }
    with pytest.raises(ValueError, match="cannot be kept in RAM: all registers of its table 'parameter'"):
        setting(parameter(0, 17), "s", table=PARAMETER, kept=Kept.RAM)


def test_delixi_write_limit_applies_to_eeprom_but_not_ram(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "wear", budget=1000)
    line, drive, sim = one(Owned(1), ledger=ledger)
    for seconds in (1.0, 2.0, 3.0):
        drive.write(drive.ramp, seconds)
    assert ledger.wear(line.seconds) == []
    assert not sim.counters.eeprom_writes
    drive.write(drive.stored_ramp, 1.0)
    with pytest.raises(WriteForbidden, match="only one write in 60 s"):
        drive.write(drive.stored_ramp, 2.0)
    assert sim.counters.eeprom_writes == {"stored_ramp": 1}


@table("status", [DelixiNativeStatus.FAULT, DelixiNativeStatus.UNDERVOLTAGE])
def test_delixi_reset_raises_if_the_fault_remains(status: DelixiNativeStatus) -> None:
    wire = Wire(DelixiNative(1), {**NATIVE_STANDING, "status": status, "fault": DelixiFault.OC_OVERCURRENT})
    with pytest.raises(NotVerified, match=r"the fault reset.*the fault remains: overcurrent"):
        wire.drive.reset_fault()
    assert wire.sent == [NATIVE_RESET]  # sent once


@table(
    ("status", "hz"),
    [
        (DelixiNativeStatus.FORWARD, 12.0),
        (DelixiNativeStatus.REVERSE, 12.0),
        (DelixiNativeStatus.STOPPED, 0.01),
    ],
)
def test_delixi_reset_is_refused_while_the_motor_turns(status: DelixiNativeStatus, hz: float) -> None:
    wire = Wire(DelixiNative(1), {**NATIVE_STANDING, "status": status, "output_frequency": hz})
    with pytest.raises(WriteForbidden, match="runs: it has no fault to reset"):
        wire.drive.reset_fault()
    assert wire.sent == []
