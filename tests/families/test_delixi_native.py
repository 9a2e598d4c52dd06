"""Delixi's own protocol: the register tables, and the frames of verbs, as part 3 of the document has them."""

from __future__ import annotations

from pathlib import Path

import pytest
from scripts import DELIXI_MONITORS, Wire, frame, rows, typed
from simulated_bus import one
from tables import table

from multidrop.control.eeprom_ledger import Ledger
from multidrop.drive import Condition, Direction, Framing, NotVerified, State, Unconfirmed, WriteForbidden
from multidrop.drive.register import Carrier, Kept, setting
from multidrop.errors import NoReply
from multidrop.families.delixi import (
    PARAMETER,
    PARAMETER_RAM,
    DelixiBaudrate,
    DelixiFault,
    DelixiNative,
    DelixiNativeStatus,
    DelixiRunSource,
    parameter,
)

FORWARD = ":010200020000000005"  # printed in the document
FIFTY = ":0104000100001388A1"  # printed in the document
FIFTY_STORED = ":0106000200001388A4"  # printed in the document
STOP = ":010200010000000004"
REVERSE = ":010200030000000006"
RESET = ":010200040000000007"

STANDING = {
    "status": DelixiNativeStatus.STOPPED,
    "output_frequency": 0.0,
    "fault": DelixiFault.NONE,
    "run_source": DelixiRunSource.LINE,
    "address_setting": 1,
    "baudrate_setting": DelixiBaudrate.B9600,
}
TURNS = {
    FORWARD: {"status": DelixiNativeStatus.FORWARD, "output_frequency": 9.0},
    REVERSE: {"status": DelixiNativeStatus.REVERSE, "output_frequency": 9.0},
    STOP: {"status": DelixiNativeStatus.STOPPED, "output_frequency": 0.0},
}

TABLE = """
00/02 0000 control             - DelixiNativeControl
03/00 0000 status              - DelixiNativeStatus
00/04 0001 frequency        0.01 Hz
00/04 0007 pi_setpoint       0.1
07/06 0002 stored_frequency 0.01 Hz
"""


def test_delixi_native_registers_equal_the_tables_of_the_document() -> None:
    own = DELIXI_MONITORS.replace("DelixiModbusFormat", "DelixiNativeFormat")
    shared = "\n".join(f"07/06 {line}" for line in own.strip().splitlines())
    assert rows(DelixiNative) == typed(TABLE + shared)


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
    wire = Wire(DelixiNative(1), STANDING, turns=TURNS)
    wire.drive.set_frequency(50)
    wire.drive.start()
    wire.drive.start(Direction.REVERSE)
    wire.drive.stop()
    wire.drive.reset_fault()
    assert wire.sent == [FIFTY, FORWARD, REVERSE, STOP, RESET]


def test_delixi_native_start_keeps_a_running_motors_direction_by_default() -> None:
    wire = Wire(DelixiNative(1), {**STANDING, **TURNS[REVERSE]}, turns=TURNS)
    wire.drive.set_frequency(50)
    wire.drive.start()
    wire.drive.start(Direction.FORWARD)
    assert wire.sent == [FIFTY, REVERSE, FORWARD]


def test_delixi_native_start_without_a_known_setpoint_is_refused() -> None:
    wire = Wire(DelixiNative(1), STANDING)
    with pytest.raises(WriteForbidden, match="set_frequency"):
        wire.drive.start()
    assert wire.sent == []


@table(
    ("status", "sentence"),
    [
        (DelixiNativeStatus.UNDERVOLTAGE, r"a fault, UNDERVOLTAGE: .*reset_fault\(\)"),
        (DelixiNativeStatus.FAULT, r"a fault, FAULT: .*reset_fault\(\)"),
        (9, "reports 0009H in reply to K = 03, a state that the manual does not explain"),
    ],
)
def test_delixi_native_start_is_refused_if_the_motor_could_start_later(status: int, sentence: str) -> None:
    """P05.31 shows no fault here. A run command without mains voltage may take effect later."""
    wire = Wire(DelixiNative(1), {**STANDING, "status": status})
    wire.drive.set_frequency(50)
    for direction in (None, *Direction):
        with pytest.raises(WriteForbidden, match=sentence):
            wire.drive.start(direction)
    assert wire.sent == [FIFTY]


@table(
    ("says", "sentence"),
    [
        ({"run_source": DelixiRunSource.KEYPAD}, "does not take its commands from the line"),
        ({"fault": DelixiFault.OC_OVERCURRENT}, "has a fault, overcurrent .OC.: remove its cause"),
    ],
)
def test_delixi_native_start_needs_line_control_and_no_fault(says: dict[str, object], sentence: str) -> None:
    wire = Wire(DelixiNative(1), STANDING | says, turns=TURNS)
    wire.drive.set_frequency(50)
    with pytest.raises(WriteForbidden, match=sentence):
        wire.drive.start()
    assert wire.sent == [FIFTY]


def test_delixi_native_start_is_unconfirmed_if_the_motor_is_not_seen_to_run() -> None:
    wire = Wire(DelixiNative(1), STANDING)
    wire.drive.set_frequency(50)
    with pytest.raises(Unconfirmed, match="it is not seen to run; stop it, or it may start later"):
        wire.drive.start()
    assert wire.sent == [FIFTY, FORWARD]


def test_delixi_setpoint_in_eeprom_is_written_with_function_06() -> None:
    drive = DelixiNative(1)
    assert frame(drive, DelixiNative.stored_frequency, 50) == FIFTY_STORED
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
        (STANDING, State(Condition.STOPPED)),
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


def test_delixi_native_identify_reads_address_and_baud_rate() -> None:
    wire = Wire(DelixiNative(1), STANDING)
    wire.drive.identify()
    assert (wire.reads, wire.sent) == (["address_setting", "baudrate_setting"], [])
    with pytest.raises(NoReply):
        Wire(DelixiNative(1), {"address_setting": NoReply("drive")}).drive.identify()
    with pytest.raises(WriteForbidden, match=r"P04\.30"):
        Wire(DelixiNative(2), STANDING).drive.identify()


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


def test_table_of_a_delixi_parameter_selects_ram_or_eeprom() -> None:
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


def test_delixi_writes_to_eeprom_are_limited_and_writes_to_ram_are_not(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "wear", budget=1000)
    line, drive, sim = one(Owned(1), ledger=ledger)
    for seconds in (1.0, 2.0, 3.0):
        drive.write(drive.ramp, seconds)
    assert ledger.wear(line.seconds) == []
    assert not sim.counters.eeprom_writes
    drive.write(drive.stored_ramp, 1.0)
    with pytest.raises(WriteForbidden, match="once in 60 s"):
        drive.write(drive.stored_ramp, 2.0)
    assert sim.counters.eeprom_writes == {"stored_ramp": 1}


@table("status", [DelixiNativeStatus.FAULT, DelixiNativeStatus.UNDERVOLTAGE])
def test_delixi_fault_that_remains_after_a_reset_is_reported(status: DelixiNativeStatus) -> None:
    wire = Wire(DelixiNative(1), {**STANDING, "status": status, "fault": DelixiFault.OC_OVERCURRENT})
    with pytest.raises(NotVerified, match=r"the fault reset.*the fault remains: overcurrent"):
        wire.drive.reset_fault()
    assert wire.sent == [RESET]  # sent once


@table(
    ("status", "hz"),
    [
        (DelixiNativeStatus.FORWARD, 12.0),
        (DelixiNativeStatus.REVERSE, 12.0),
        (DelixiNativeStatus.STOPPED, 0.01),
    ],
)
def test_delixi_reset_is_refused_while_the_motor_turns(status: DelixiNativeStatus, hz: float) -> None:
    wire = Wire(DelixiNative(1), {**STANDING, "status": status, "output_frequency": hz})
    with pytest.raises(WriteForbidden, match="runs: it has no fault to reset"):
        wire.drive.reset_fault()
    assert wire.sent == []
