"""Delixi 9200 and 9100-SC in standard Modbus: the register table, and the frames that verbs send."""

from __future__ import annotations

import pytest
from scripts import DELIXI_MONITORS, Wire, frame, rows, typed
from tables import table

from multidrop.drive import Condition, Direction, Framing, NotVerified, State, Unconfirmed, WriteForbidden
from multidrop.drive.register import HOLDING, Kept
from multidrop.families.delixi import (
    DelixiBaudrate,
    DelixiFault,
    DelixiModbus,
    DelixiModbusControl,
    DelixiRunSource,
)

FORWARD = {Framing.RTU: "01 06 20 00 00 12 02 07", Framing.ASCII: ":010620000012C7"}  # printed in its manual
FIFTY = {Framing.RTU: "01 06 00 02 13 88 25 5C", Framing.ASCII: ":0106000213885C"}  # printed in its manual
STOP = {Framing.RTU: "01 06 20 00 00 01 43 CA", Framing.ASCII: ":010620000001D8"}
REVERSE = {Framing.RTU: "01 06 20 00 00 22 02 13", Framing.ASCII: ":010620000022B7"}

STANDING = {
    "output_frequency": 0.0,
    "fault": DelixiFault.NONE,
    "run_source": DelixiRunSource.LINE,
    "frequency_source": 1,
    "frequency": 50.0,
    "address_setting": 1,
    "baudrate_setting": DelixiBaudrate.B9600,
}
TURNING = {"output_frequency": 12.0}
TURNS = {each: TURNING for frames in (FORWARD, REVERSE) for each in frames.values()} | {
    each: {"output_frequency": 0.0} for each in STOP.values()
}

TABLE = """
03/06 2000 control           - DelixiModbusControl
03/06 0002 frequency      0.01 Hz
"""


def test_delixi_registers_equal_the_table_typed_from_part_2() -> None:
    shared = "\n".join(f"03/06 {line}" for line in DELIXI_MONITORS.strip().splitlines())
    assert rows(DelixiModbus) == typed(TABLE + shared)


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


def test_delixi_run_words_have_a_direction_and_never_the_toggle_bit() -> None:
    assert {each.value for each in DelixiModbusControl} == {0x00, 0x01, 0x12, 0x22, 0x13, 0x23}


def test_delixi_character_formats_have_the_codes_of_the_manual() -> None:
    """P04.29: 0 to 2 are ASCII with 7 data bits, 3 to 5 RTU with 8."""
    names = ["ASCII_7N2", "ASCII_7E1", "ASCII_7O1", "RTU_8N2", "RTU_8E1", "RTU_8O1"]
    assert [DelixiModbus.format_setting.decode(raw).name for raw in range(6)] == names


def test_delixi_start_after_a_jog_requires_a_stop() -> None:
    jog = frame(DelixiModbus(1), DelixiModbus.control, DelixiModbusControl.JOG_FORWARD)
    wire = Wire(DelixiModbus(1), STANDING, turns={jog: TURNING} | TURNS)
    wire.drive.jog()
    with pytest.raises(WriteForbidden, match=r"may still jog.*call stop\(\) first"):
        wire.drive.start(Direction.FORWARD)
    wire.drive.stop()
    wire.drive.start(Direction.FORWARD)
    wire.drive.start(Direction.REVERSE)  # the motor already runs
    assert wire.sent == [jog, STOP[Framing.RTU], FORWARD[Framing.RTU], REVERSE[Framing.RTU]]


def test_delixi_fault_codes_decode_to_the_documented_names() -> None:
    assert [each.value for each in DelixiFault] == list(range(15))
    assert DelixiModbus.fault.decode(14) is DelixiFault.FLT_MODULE


@table("framing", DelixiModbus.framings)
def test_each_delixi_verb_sends_the_documented_frame(framing: Framing) -> None:
    wire = Wire(DelixiModbus(1, framing=framing), STANDING, turns=TURNS)
    wire.drive.set_frequency(50)
    wire.drive.start()
    wire.drive.start(Direction.FORWARD)
    wire.drive.start(Direction.REVERSE)
    wire.drive.stop()
    forward = FORWARD[framing]
    assert wire.sent == [FIFTY[framing], forward, forward, REVERSE[framing], STOP[framing]]


def test_delixi_jog_sends_the_control_word_of_its_direction() -> None:
    jogs = [
        frame(DelixiModbus(1), DelixiModbus.control, word)
        for word in (DelixiModbusControl.JOG_FORWARD, DelixiModbusControl.JOG_REVERSE)
    ]
    wire = Wire(DelixiModbus(1), STANDING, turns=dict.fromkeys(jogs, TURNING))
    wire.drive.jog()
    for direction in Direction:
        with pytest.raises(
            WriteForbidden, match=r"turns, and may continue to turn during a jog: call stop\(\) first"
        ):
            wire.drive.jog(direction)
    wire.say(STANDING)
    wire.drive.jog(Direction.REVERSE)
    assert [each[:17] for each in wire.sent] == ["01 06 20 00 00 13", "01 06 20 00 00 23"]


@table("name", ["start", "jog"])
def test_delixi_start_is_unconfirmed_if_the_motor_does_not_run(name: str) -> None:
    wire = Wire(DelixiModbus(1), STANDING)
    with pytest.raises(Unconfirmed, match="it is not seen to run; stop it, or it may start later"):
        getattr(wire.drive, name)()
    assert len(wire.sent) == 1


def test_delixi_start_of_a_turning_motor_without_a_direction_is_refused() -> None:
    wire = Wire(DelixiModbus(1), {**STANDING, **TURNING})
    with pytest.raises(WriteForbidden, match="give the direction"):
        wire.drive.start()
    assert wire.sent == []
    wire.drive.start(Direction.FORWARD)
    assert wire.sent == [FORWARD[Framing.RTU]]


def test_delixi_stop_waits_for_0_hz_and_raises_if_it_does_not_come() -> None:
    wire = Wire(DelixiModbus(1), {"output_frequency": [30.0, 10.0, 0.0]})
    wire.drive.stop()
    assert len(wire.reads) == 3
    wire = Wire(DelixiModbus(1, stop_time=30), {"output_frequency": 5.0})
    with pytest.raises(Unconfirmed, match="30 s"):
        wire.drive.stop()
    assert wire.sent == [STOP[Framing.RTU]]


def test_delixi_setpoint_write_wears_eeprom_and_a_wrong_value_is_reported() -> None:
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
def test_delixi_state_shows_the_fault_or_that_the_motor_turns(says: dict[str, object], state: State) -> None:
    assert Wire(DelixiModbus(1), says).drive.state() == state


def test_delixi_state_at_0_hz_is_unknown() -> None:
    assert Wire(DelixiModbus(1), STANDING).drive.state().condition is Condition.UNKNOWN


def test_delixi_identify_checks_address_and_baud_rate() -> None:
    Wire(DelixiModbus(1), STANDING).drive.identify()
    for name, other, sentence in (
        ("fault", 99, "0063H"),
        ("address_setting", 2, r"P04\.30"),
        ("baudrate_setting", DelixiBaudrate.B1200, r"P04\.28"),
    ):
        with pytest.raises(WriteForbidden, match=sentence):
            Wire(DelixiModbus(1), {**STANDING, name: other}).drive.identify()


@table(
    ("name", "held", "sentence"),
    [
        ("run_source", DelixiRunSource.KEYPAD, r"P00\.00 must be 2"),
        ("frequency_source", 0, r"P00\.01"),
        ("fault", DelixiFault.OH_OVERHEAT, "overheat"),
        ("frequency", 0.0, "set_frequency"),
    ],
)
def test_delixi_start_needs_line_control_and_no_fault(name: str, held: float, sentence: str) -> None:
    wire = Wire(DelixiModbus(1), {**STANDING, name: held})
    with pytest.raises(WriteForbidden, match=sentence):
        wire.drive.start()
    assert wire.sent == []
