"""YD1000: the register table, and the frames of verbs. The document prints only the control words."""

from __future__ import annotations

import checksums
import pytest
from scripts import Wire, frame, rows, typed
from simulated_bus import one
from tables import table

from multidrop.drive import Condition, Direction, State, write
from multidrop.drive.register import HOLDING, Kept
from multidrop.errors import (
    DriveException,
    Expired,
    NoReply,
    NotVerified,
    Unconfirmed,
    Unsupported,
    WriteForbidden,
)
from multidrop.families import DelixiModbus
from multidrop.families.yd1000 import YD1000, Inputs, Outputs, YD1000Control, YD1000Status, extended
from multidrop.sim.families import SimulatedYD1000

FORWARD = "01 06 10 00 C4 00 DF CA"
REVERSE = "01 06 10 00 C6 00 DE AA"
STOP = "01 06 10 00 C0 00 DD 0A"
EIGHTY = "01 06 10 01 1F 40 D5 0A"

STANDING = {
    "output_frequency": 0.0,
    "deceleration_time": 10.0,
    "held_frequency": 0.0,
    "fault_record_1": 0.0,
    "maximum_frequency": 80.0,
    "inputs": Inputs(0),
    "always_on_function": 0.0,
}
AT_30_HZ = {**STANDING, "frequency": 30.0}

TURNS = {
    FORWARD: {"output_frequency": 12.0, "status": YD1000Status.RUN},
    REVERSE: {"output_frequency": 12.0, "status": YD1000Status.RUN | YD1000Status.REVERSE},
    STOP: {"output_frequency": 0.0, "status": YD1000Status(0)},
}

# Columns: address, name, step and unit; factory value; changeable while running.
PARAMETERS = """
0000 automatic_ramp            1            0    Y
0001 automatic_torque_boost    1            0    N
0002 automatic_environment     1            0    N
0003 command_mode              1            1    Y
0004 frequency_mode            1            2    Y
0005 meter_selection           1            0    Y
0006 meter_adjustment          ?            X    Y
0007 initialisation            1            0    N
0008 panel_direction           1            0    Y
0009 acceleration_time       0.1 s         10.0  Y
0010 deceleration_time       0.1 s         10.0  Y
0011 maximum_frequency      0.01 Hz        80.0  N
0012 upper_limit_frequency  0.01 Hz        80.0  Y
0013 minimum_frequency      0.01 Hz         0.0  Y
0014 base_frequency         0.01 Hz        60.0  Y
0015 voltage_frequency_mode    1            0    N
0016 torque_boost              ?            X    Y
0017 thermal_protection        1            0    Y
0018 preset_speed_1         0.01 Hz         0.0  Y
0019 preset_speed_2         0.01 Hz         0.0  Y
0020 preset_speed_3         0.01 Hz         0.0  Y
0021 preset_speed_4         0.01 Hz         0.0  Y
0022 preset_speed_5         0.01 Hz         0.0  Y
0023 preset_speed_6         0.01 Hz         0.0  Y
0024 preset_speed_7         0.01 Hz         0.0  Y
0100 low_speed_frequency    0.01 Hz         0.0  Y
0101 speed_reach_frequency  0.01 Hz         0.0  Y
0102 speed_reach_band       0.01 Hz         2.5  Y
0103 st_selection              1            1    Y
0104 rst_selection             1            0    Y
0110 always_on_function        1            0    Y
0111 input_1_function          1            2    Y
0112 input_2_function          1            3    Y
0113 input_3_function          1           10    Y
0114 input_4_function          1            6    Y
0115 input_5_function          1            7    Y
0130 output_1_function         1            4    Y
0131 output_2_function         1            6    Y
"""

OTHERS = """
03/06 0800 baudrate_setting         - YD1000Baudrate
03/06 0801 parity_setting           - Parity
03/06 0802 address_setting          1
03/06 0803 communication_timeout    1 s
03/06 1000 control                  - YD1000Control
03/06 1001 frequency             0.01 Hz
03/06 1002 panel_frequency       0.01 Hz
03/06 1100 output_frequency      0.01 Hz
03/06 1200 held_frequency        0.01 Hz
03/06 1201 status                   - YD1000Status
03/06 1202 reference_frequency   0.01 Hz
03/06 1203 output_current        0.01 %
03/06 1204 dc_bus_voltage        0.01 %
03/06 1205 output_voltage        0.01 %
03/06 1206 inputs                   - Inputs
03/06 1207 outputs                  - Outputs
03/06 1208 cpu_version              ?
03/06 1209 eeprom_version           ?
03/06 1210 fault_record_1           1
03/06 1211 fault_record_2           1
03/06 1212 fault_record_3           1
03/06 1213 fault_record_4           1
03/06 1214 run_hours                1 h
"""


def parameters() -> list[tuple[str, ...]]:
    return [tuple(line.split()) for line in PARAMETERS.strip().splitlines()]


def test_yd1000_registers_equal_the_tables_of_sections_6_and_7() -> None:
    basic = "\n".join(f"03/06 {' '.join(row[:-2])}" for row in parameters())
    assert rows(YD1000) == typed(basic + OTHERS)


@table("row", parameters())
def test_yd1000_defaults_and_write_locks_equal_the_document(row: tuple[str, ...]) -> None:
    register = YD1000.registers[row[1]]
    assert register.default == (None if row[-2] == "X" else float(row[-2]))
    assert register.while_running == (row[-1] == "Y")
    assert register.kept is Kept.EEPROM


def test_yd1000_limits_are_those_of_the_document() -> None:
    spans = {name: each.span for name, each in YD1000.registers.items() if each.span}
    assert spans["acceleration_time"] == spans["deceleration_time"] == (0.1, 3600)
    assert spans["maximum_frequency"] == (30, 320)
    assert spans["base_frequency"] == (25, 320)
    assert spans["upper_limit_frequency"] == (0.5, 320)
    assert [spans[f"input_{number}_function"] for number in range(1, 6)] == [(0, 37)] * 5
    assert [spans[f"output_{number}_function"] for number in (1, 2)] == [(0, 9)] * 2
    assert (spans["thermal_protection"], spans["automatic_environment"]) == ((0, 7), (0, 2))


def test_yd1000_registers_are_declared_as_ram_or_eeprom() -> None:
    ram = {name for name, each in YD1000.registers.items() if each.kept is Kept.RAM}
    assert ram == {"control", "frequency", "panel_frequency"}


def test_yd1000_registers_never_written_have_documented_reasons() -> None:
    never: dict[str, set[int]] = {}
    for register in YD1000.registers.values():
        never.setdefault(register.never, set()).add(register.address)
    del never[""]
    assert never == {
        "it is effective from the panel only": {0x0001, 0x0007, 0x0015},
        "its scale is not stated": {0x0006, 0x0016},
        "it changes the drive's end of the line; set it on the panel": {0x0800, 0x0801, 0x0802},
        "what else it sets is not stated": {0x0002},
        "it decides what commands the motor; set it on the panel": {
            0x0003,  # CNOD
            0x0004,  # FNOD
            0x0008,  # FR
            0x0103,  # F103, ST
            0x0104,  # F104, RST
            0x0110,  # F110, a function that is always on
            *range(0x0111, 0x0116),  # F111 to F115, the functions of the inputs
        },
    }


def test_yd1000_line_parameters_are_read_only() -> None:
    """By section 7, 0800H and 0801H take effect after a reset or power-on, 0802H and 0803H immediately."""
    later = {register.address for register in YD1000.registers.values() if "after a reset" in register.note}
    at_once = {register.address for register in YD1000.registers.values() if "at once" in register.note}
    assert (later, at_once) == ({0x0800, 0x0801}, {0x0802, 0x0803})
    assert YD1000.address_setting.span == (0, 63)
    assert "Up to 31 before version V104" in YD1000.address_setting.note
    assert YD1000.communication_timeout.span == (0, 100)


def test_yd1000_extended_parameter_address_follows_from_its_name() -> None:
    """The letter F of the name becomes the digit 0 of the address (section 6.2)."""

    class Mine(YD1000):
        """A user's family with a parameter from the drive's manual."""

        start_frequency = extended("F240", "Hz", step=0.01)

    assert (Mine.start_frequency.address, Mine.start_frequency.kept) == (0x0240, Kept.EEPROM)
    assert Mine.start_frequency.place == "6.2, F240"
    for register in YD1000.registers.values():
        if register.place.startswith("6.2, "):
            name = register.place.removeprefix("6.2, ")
            assert f"F{register.address:03X}" == name
            with pytest.raises(
                ValueError, match=f"^{name} is already declared for every YD1000, as {register.name}$"
            ):
                extended(name)  # must not make a register writable that is never written
    for wrong in ("F1000", "F24A", "f240", "240", "F24"):
        with pytest.raises(ValueError, match="F and three digits"):
            extended(wrong)


def test_yd1000_control_and_status_bits_have_the_documented_names() -> None:
    assert {bit.name: bit.value.bit_length() - 1 for bit in YD1000Control} == {
        "COMMAND_VALID": 15,
        "FREQUENCY_VALID": 14,
        "RESET": 13,
        "EMERGENCY_STOP": 12,
        "COAST": 11,
        "RUN": 10,
        "REVERSE": 9,
        "JOG": 8,
        "DC_BRAKE": 7,
        "SECOND_RAMP": 6,
        "PRESET_SPEED_1": 3,
        "PRESET_SPEED_2": 2,
        "PRESET_SPEED_3": 1,
        "PRESET_SPEED_4": 0,
    }
    assert {bit.value.bit_length() - 1 for bit in YD1000Status} == {10, 9, 8, 7, 6}
    assert [bit.name for bit in Inputs] == ["F", "R", "RST", "S1", "S2"]
    assert Inputs.S1 | Inputs.F == 9  # the example in section 8.2
    assert Outputs.OUT1 | Outputs.OUT2 == 3


def test_no_yd1000_control_word_has_both_reset_and_run() -> None:
    for turning in (YD1000Control.RUN, YD1000Control.JOG):
        with pytest.raises(ValueError, match=r"RESET.* are never written together"):
            YD1000.control.encode(YD1000Control.COMMAND_VALID | YD1000Control.RESET | turning)
    with pytest.raises(ValueError, match="reserved"):
        YD1000.control.encode(YD1000Control(0x8010))


def test_yd1000_line_settings_and_limits_are_those_of_the_document() -> None:
    drive = YD1000(63)
    assert str(drive.settings) == "9600 8E1"
    assert drive.needed_silence() == pytest.approx(24 * 11 / 9600)
    assert drive.response_delay == pytest.approx(27.5e-3)
    assert YD1000(1, baudrate=1200).response_delay == pytest.approx(0.22)
    assert YD1000(1, baudrate=1200).response_timeout > 0.22
    assert sorted(YD1000.baudrates) == [1200, 2400, 4800, 9600]
    assert set(YD1000.formats[drive.framing]) == {"8N1", "8E1", "8O1"}
    assert YD1000.most_registers == {HOLDING: 1}
    assert "F803" in YD1000.watchdog


@table(
    ("word", "printed"),
    [
        (YD1000Control.COMMAND_VALID | YD1000Control.RUN, "01 06 10 00 84 00 EE 0A"),
        (YD1000Control.COMMAND_VALID | YD1000Control.RUN | YD1000Control.REVERSE, "01 06 10 00 86 00 EF 6A"),
        (YD1000Control.COMMAND_VALID, "01 06 10 00 80 00 EC CA"),
        (YD1000Control.COMMAND_VALID | YD1000Control.EMERGENCY_STOP, "01 06 10 00 90 00 E1 0A"),
        (YD1000Control.COMMAND_VALID | YD1000Control.COAST, "01 06 10 00 88 00 EB 0A"),
        (YD1000Control.RESET, "01 06 10 00 20 00 94 CA"),
        (YD1000Control(0), "01 06 10 00 00 00 8D 0A"),
    ],
)
def test_yd1000_control_words_without_bit_14_are_sent_as_documented(
    word: YD1000Control, printed: str
) -> None:
    assert frame(YD1000(1), YD1000.control, word) == printed


def test_yd1000_start_without_a_direction_keeps_a_running_motors_direction() -> None:
    wire = Wire(YD1000(1), {**AT_30_HZ, **TURNS[REVERSE]})
    wire.drive.start()
    assert wire.sent == [REVERSE]


def yd_word(word: int) -> str:
    """Return the frame that writes this control word (section 5.2)."""
    return checksums.rtu(f"01 06 10 00 {word:04X}").hex(" ").upper()


@table(
    ("options", "forward", "reverse"),
    [
        ({"setpoint_by_fnod": 1}, 0x8400, 0x8600),  # both words are printed in section 8.1
        ({"second_ramp": 1}, 0xC440, 0xC640),
        ({"second_ramp": 1, "setpoint_by_fnod": 1}, 0x8440, 0x8640),
        ({"second_ramp": 0, "setpoint_by_fnod": 0}, 0xC400, 0xC600),
        ({}, 0xC400, 0xC600),
    ],
)
def test_yd1000_options_select_the_control_bits_of_a_start(
    options: dict[str, float], forward: int, reverse: int
) -> None:
    words = [yd_word(forward), yd_word(reverse)]
    turns = dict(zip(words, (TURNS[FORWARD], TURNS[REVERSE]), strict=True))
    wire = Wire(YD1000(1, **options), AT_30_HZ, turns=turns)
    wire.drive.start()
    wire.drive.start(Direction.FORWARD)
    wire.drive.start(Direction.REVERSE)
    assert wire.sent == [words[0], *words]


def test_yd1000_start_without_a_setpoint_is_refused() -> None:
    wire = Wire(YD1000(1), STANDING | {"frequency": 0.0}, turns=TURNS)
    with pytest.raises(WriteForbidden, match=r"the setpoint of .* is 0: call set_frequency before start"):
        wire.drive.start()
    assert wire.sent == []


def test_yd1000_start_sends_no_setpoint_with_option_setpoint_by_fnod() -> None:
    wire = Wire(YD1000(1, setpoint_by_fnod=1), STANDING, turns={yd_word(0x8400): TURNS[FORWARD]})
    wire.drive.start()
    assert wire.sent == [yd_word(0x8400)]
    for option in ("setpoint_by_fnod", "preset_speed"):
        with pytest.raises(WriteForbidden, match=option):
            Wire(YD1000(1, **{option: 1})).drive.set_frequency(20)


AT_PRESET = {
    **STANDING,
    "reference_frequency": 0.0,
    **{f"preset_speed_{each}": 5.0 * each for each in range(1, 8)},
}


@table(("number", "bits"), [(1, 0x8), (2, 0x4), (3, 0xC), (4, 0x2), (5, 0xA), (6, 0x6), (7, 0xE)])
def test_yd1000_start_waits_until_1202h_shows_the_preset_speed(number: int, bits: int) -> None:
    select, run = yd_word(0xC000 | bits), yd_word(0xC600 | bits)
    wire = Wire(
        YD1000(1, preset_speed=number),
        AT_PRESET,
        turns={select: {"reference_frequency": 5.0 * number}, run: TURNS[REVERSE]},
    )
    wire.drive.start(Direction.REVERSE)
    assert wire.sent == [STOP, select, run]


@table(
    ("says", "sent", "sentence"),
    [
        ({}, [STOP, yd_word(0xC00C), STOP], "speed 3 was selected, its frequency command did not become 15"),
        ({"reference_frequency": 15.0}, [STOP], "preset speed 3 cannot be verified"),
        ({"preset_speed_3": 0.0}, [], "is 0: write preset_speed_3 first"),
        ({**TURNS[FORWARD]}, [], r"turns, and a preset speed .*: call stop\(\) first"),
        ({"held_frequency": 30.0}, [], r"has a fault.*reset_fault\(\)"),
    ],
)
def test_yd1000_start_is_refused_if_1202h_does_not_show_the_preset_speed(
    says: dict[str, object], sent: list[str], sentence: str
) -> None:
    wire = Wire(YD1000(1, preset_speed=3), {**AT_PRESET, **says})
    with pytest.raises(WriteForbidden, match=sentence):
        wire.drive.start()
    assert wire.sent == sent


def test_yd1000_jog_leaves_the_run_bit_off() -> None:
    jogs = [frame(YD1000(1), YD1000.control, YD1000Control(word)) for word in (0xC100, 0xC300)]
    turns = dict(zip(jogs, (TURNS[FORWARD], TURNS[REVERSE]), strict=True))
    wire = Wire(YD1000(1), STANDING, turns=turns)
    wire.drive.jog()
    wire.drive.jog(Direction.REVERSE)
    assert [each[:17] for each in wire.sent] == ["01 06 10 00 C1 00", "01 06 10 00 C3 00"]


def test_yd1000_stop_waits_for_two_readings_of_0_hz() -> None:
    wire = Wire(YD1000(1), {**STANDING, "output_frequency": [20.0, 0.0, 3.0, 0.0, 0.0]})
    wire.drive.stop()
    assert wire.sent == [STOP]
    assert wire.reads.count("output_frequency") == 5
    wire = Wire(YD1000(1), {**STANDING, "output_frequency": [20.0, 0.01, 0.0, 0.0]})
    wire.drive.stop()
    assert wire.reads.count("output_frequency") == 4
    wire = Wire(YD1000(1), {**STANDING, "output_frequency": 3.0})
    with pytest.raises(Unconfirmed, match="15 s"):
        wire.drive.stop()
    assert wire.sent == [STOP]


def test_yd1000_motor_verbs_keep_control_bits_15_and_14_set() -> None:
    wire = Wire(YD1000(1), AT_30_HZ, turns=TURNS)
    for verb in (
        wire.drive.start,
        wire.drive.stop,
        wire.drive.coast,
        wire.drive.emergency_stop,
        wire.drive.reset_fault,
    ):
        verb()
    words = [int(text[12:17].replace(" ", ""), 16) for text in wire.sent]
    assert all(word & 0xC000 == 0xC000 for word in words)


def test_the_yd1000_emergency_stop_bit_is_always_cleared() -> None:
    wire = Wire(YD1000(1), STANDING)
    wire.drive.emergency_stop()
    assert [wire.sent[0][:17], *wire.sent[1:]] == ["01 06 10 00 D0 00", STOP]
    wire = Wire(YD1000(1), {**STANDING, "output_frequency": 3.0})
    with pytest.raises(Unconfirmed):
        wire.drive.emergency_stop()
    assert wire.sent[-1] == STOP


@table("failure", [Unconfirmed("drive", "stop", "no reply"), DriveException("drive", 4, "")])
def test_yd1000_emergency_stop_is_sent_only_once(failure: Exception) -> None:
    pulse = frame(YD1000(1), YD1000.control, YD1000Control(0xD000))
    wire = Wire(YD1000(1), STANDING, {pulse: [failure]})
    wire.drive.emergency_stop()
    assert wire.sent == [pulse, STOP]


def test_yd1000_coast_waits_for_two_readings_of_0_hz() -> None:
    wire = Wire(YD1000(1), STANDING)
    wire.drive.coast()
    assert [each[:17] for each in wire.sent] == ["01 06 10 00 C8 00"]
    assert wire.seconds == 0.1  # the pause between the two readings of 0 Hz
    wire = Wire(YD1000(1), {**STANDING, "output_frequency": 3.0})
    with pytest.raises(Unconfirmed, match="5 s"):
        wire.drive.coast()


def test_yd1000_reset_is_sent_once_and_followed_by_a_stop() -> None:
    reset = frame(YD1000(1), YD1000.control, YD1000Control(0xE000))
    wire = Wire(YD1000(1), STANDING, {reset: [Unconfirmed("drive", "reset", "no reply")]})
    wire.drive.reset_fault()
    assert wire.sent == [reset, STOP]
    assert wire.seconds >= 3
    wire = Wire(YD1000(1), STANDING, {reset: [DriveException("drive", 4, "")]})
    with pytest.raises(DriveException):
        wire.drive.reset_fault()
    with pytest.raises(WriteForbidden, match="runs"):
        Wire(YD1000(1), {"output_frequency": 5.0}).drive.reset_fault()
    turning = Wire(YD1000(1), {**STANDING, "output_frequency": 0.01})
    with pytest.raises(WriteForbidden, match="runs"):
        turning.drive.reset_fault()
    assert turning.sent == []


def test_yd1000_start_after_a_reset_requires_a_new_setpoint() -> None:
    """The restart loses the written setpoint. A start at the drive's own setpoint was not requested."""
    wire = Wire(YD1000(1), AT_30_HZ, turns=TURNS)
    wire.drive.set_frequency(30)
    wire.drive.reset_fault()
    wire.sent.clear()
    wire.say({"frequency": 20.0})
    with pytest.raises(
        WriteForbidden,
        match=r"setpoint 20\.00 Hz, not the written 30\.00 Hz.* call set_frequency before",
    ):
        wire.drive.start()
    assert wire.sent == []
    line, drive, sim = one(YD1000(1))
    drive.set_frequency(30)
    sim.trip(4)
    drive.reset_fault()
    with pytest.raises(WriteForbidden, match="call set_frequency before start"):
        drive.start()
    assert not sim.motor.energised
    line.sleep(1)
    drive.set_frequency(30)
    drive.start()
    assert sim.motor.energised


FUNCTIONS = {f"input_{at}_function": factory for at, factory in enumerate((2.0, 3.0, 10.0, 6.0, 7.0), 1)}


@table(
    ("says", "terminal"),
    [
        ({"inputs": Inputs.F}, "terminal F"),
        ({"inputs": Inputs.R}, "terminal R"),
        ({"inputs": Inputs.S2, "input_5_function": 2.0}, "terminal S2"),
        ({"always_on_function": 3.0}, "F110"),
    ],
)
@table(
    ("verb", "consequence"),
    [
        # A restart may clear bit 15 of the control word, as power-on does (8.1). Then terminals have control.
        ("reset_fault", " and may start the motor"),
        ("release_control", " .* when the line releases control"),
    ],
)
def test_a_closed_run_terminal_blocks_yd1000_reset_and_release_control(
    says: dict[str, object], terminal: str, verb: str, consequence: str
) -> None:
    wire = Wire(YD1000(1), {**STANDING, **FUNCTIONS, **says})
    with pytest.raises(WriteForbidden, match=f"^{terminal}.* has a run function{consequence}"):
        getattr(wire.drive, verb)()
    assert wire.sent == []


@table("closed", [Inputs.RST | Inputs.S1, Inputs(0)])
def test_yd1000_terminals_without_a_run_function_do_not_block_a_reset(closed: Inputs) -> None:
    wire = Wire(YD1000(1), {**STANDING, **FUNCTIONS, "inputs": closed})
    wire.drive.reset_fault()
    assert wire.sent == [frame(YD1000(1), YD1000.control, YD1000Control(0xE000)), STOP]


def test_yd1000_limit_error_names_the_section_of_the_manual() -> None:
    """The document limits the upper frequency limit by the maximum frequency; the reverse is inferred."""
    wire = Wire(YD1000(1), {**STANDING, "upper_limit_frequency": 60.0})
    with pytest.raises(
        WriteForbidden, match=r"50\.00 Hz is below upper_limit_frequency, which is 60 Hz"
    ) as refusal:
        wire.run(write(wire.drive.maximum_frequency, 50.0))
    assert str(refusal.value).endswith("(in the manual, maximum_frequency is 6.1, FH)")


# The control word 0 clears bits 15 and 14, which returns control to the panel and terminals (section 8.1).
RELEASE = checksums.rtu("01 06 10 00 00 00").hex(" ").upper()


def test_yd1000_release_control_is_refused_unless_the_motor_is_at_rest() -> None:
    wire = Wire(YD1000(1), {**STANDING, **FUNCTIONS})
    wire.drive.release_control()
    assert wire.sent == [RELEASE]
    for frequencies in (12.0, [0.0, 12.0]):  # 1100H must be 0 in two successive readings
        wire = Wire(YD1000(1), {**STANDING, **FUNCTIONS, "output_frequency": frequencies})
        with pytest.raises(WriteForbidden, match=r"turns: call stop\(\) first"):
            wire.drive.release_control()
        assert wire.sent == []


def test_yd1000_stop_is_written_if_the_motor_turns_after_release_control() -> None:
    turns = {RELEASE: {"output_frequency": [0.0, 0.0, 1.5]}}
    wire = Wire(YD1000(1), {**STANDING, **FUNCTIONS}, turns=TURNS | turns)
    with pytest.raises(
        NotVerified, match="its panel or a terminal started the motor, so the stop was written"
    ):
        wire.drive.release_control()
    assert wire.sent == [RELEASE, STOP]


@table("is_sent", [True, False])
def test_yd1000_stop_is_written_again_if_release_control_is_unconfirmed(is_sent: bool) -> None:
    lost = Unconfirmed("drive", "control", "no reply") if is_sent else Expired("drive", "control", 1.0)
    wire = Wire(YD1000(1), {**STANDING, **FUNCTIONS}, loses={RELEASE: [lost]})
    with pytest.raises(type(lost)):
        wire.drive.release_control()
    assert wire.sent == [RELEASE, *([STOP] if is_sent else [])]
    wire = Wire(YD1000(1), {**STANDING, **FUNCTIONS}, turns={RELEASE: {"output_frequency": NoReply("drive")}})
    with pytest.raises(NoReply):
        wire.drive.release_control()
    assert wire.sent == [RELEASE, STOP]


def test_yd1000_panel_can_run_the_motor_after_release_control() -> None:
    _, drive, sim = one(YD1000(1))
    assert isinstance(sim, SimulatedYD1000)
    drive.write(drive.panel_frequency, 20.0)
    drive.stop()  # the stop takes control away from the panel
    sim.panel_runs = True
    assert not sim.motor.energised
    with pytest.raises(NotVerified, match="started the motor"):
        drive.release_control()
    assert drive.state().condition is not Condition.RUNNING
    sim.panel_runs = False
    drive.release_control()
    assert not sim.motor.energised
    sim.panel_runs = True
    assert sim.motor.energised
    with pytest.raises(Unsupported, match="no release_control command"):
        one(DelixiModbus(1))[1].release_control()


def test_yd1000_setpoint_is_written_to_1001h_and_limited() -> None:
    wire = Wire(YD1000(1), STANDING)
    wire.drive.set_frequency(80)
    assert wire.sent == [EIGHTY]
    with pytest.raises(WriteForbidden, match=r"80\.50 Hz is above maximum_frequency, which is 80 Hz"):
        wire.drive.set_frequency(80.5)
    wire.held.clear()
    wire.says["frequency"] = [60.0]
    with pytest.raises(NotVerified, match=r"60\.00 Hz"):
        wire.drive.set_frequency(80)


def test_yd1000_state_shows_a_turning_motor_or_a_fault() -> None:
    turning = {"output_frequency": 20.0, "status": YD1000Status.RUN}
    assert Wire(YD1000(1), turning).drive.state() == State(Condition.RUNNING, Direction.FORWARD)
    wire = Wire(YD1000(1), STANDING)
    assert wire.drive.state().condition is Condition.STOPPED
    wire.says["fault_record_1"] = [0x0A]
    assert wire.drive.state() == State(Condition.FAULT, fault="code 0AH")
    assert wire.drive.state().condition is Condition.FAULT
    wire.drive.reset_fault()
    assert wire.drive.state().condition is Condition.STOPPED


def test_yd1000_identity_check_compares_address_and_maximum_frequency() -> None:
    says = {"address_setting": 5.0, "maximum_frequency": 80.0}
    wire = Wire(YD1000(5), says)
    wire.drive.identify()
    assert wire.sent == []
    with pytest.raises(WriteForbidden, match="0802H"):
        Wire(YD1000(6), says).drive.identify()
    with pytest.raises(WriteForbidden, match="0011H"):
        Wire(YD1000(5), {**says, "maximum_frequency": 0.1}).drive.identify()


def test_yd1000_start_in_a_fault_is_refused() -> None:
    wire = Wire(YD1000(1), AT_30_HZ)
    wire.drive.state()
    wire.says["fault_record_1"] = [0x0A]  # a new entry in the fault record
    for verb in (wire.drive.start, wire.drive.jog):
        with pytest.raises(
            WriteForbidden, match=r"has a fault, code 0AH: remove its cause, then call reset_fault\(\)$"
        ):
            verb()
    assert wire.sent == []


def test_yd1000_trip_is_detected_by_the_frozen_register_1200h() -> None:
    """By section 8.2, 1200H keeps its value while the drive has tripped, and 1100H does not."""
    wire = Wire(YD1000(1), {**STANDING, "held_frequency": 30.0, "fault_record_1": 0x0A})
    assert wire.drive.state() == State(Condition.FAULT, fault="code 0AH")
    starting = {**STANDING, "held_frequency": 0.2, "output_frequency": [0.0, 0.0, 0.4]}
    assert Wire(YD1000(1), starting).drive.state().condition is Condition.STOPPED


def test_yd1000_start_after_an_emergency_stop_advises_reset_fault() -> None:
    """This also holds for a new drive object, as each call of the command line creates one."""
    line, drive, sim = one(YD1000(1))
    drive.set_frequency(30)
    drive.start()
    line.sleep(3)
    drive.emergency_stop()
    line.bus.detach(drive)
    drive = line.attach(YD1000(1))
    with pytest.raises(
        WriteForbidden, match=r"has a fault, code 11H: remove its cause, then call reset_fault\(\)$"
    ):
        drive.start()
    drive.reset_fault()
    drive.set_frequency(30)
    drive.start()
    assert sim.motor.energised


def test_yd1000_start_after_an_emergency_stop_at_rest_advises_reset_fault() -> None:
    """No register is frozen in this case, so a new drive object cannot see the trip."""
    _, drive, _ = one(YD1000(1))
    drive.emergency_stop()
    drive.set_frequency(30)
    with pytest.raises(Unconfirmed, match=r"no run within .*emergency stop the drive needs reset_fault"):
        drive.start()


def test_yd1000_watchdog_write_is_refused_while_the_motor_turns() -> None:
    _, drive, sim = one(YD1000(1))
    assert drive.write(drive.communication_timeout, 5) == 5
    assert sim["communication_timeout"] == 5
    for wrong in (-1, 101, 0.5):
        with pytest.raises(WriteForbidden, match="communication_timeout"):
            drive.write(drive.communication_timeout, wrong)
    drive.set_frequency(30)
    drive.start()
    with pytest.raises(WriteForbidden, match="only at standstill"):
        drive.write(drive.communication_timeout, 2)


@table("speed", range(1, 8))
def test_simulated_yd1000_runs_at_the_preset_speed(speed: int) -> None:
    line, drive, sim = one(YD1000(1, preset_speed=speed))
    sim[f"preset_speed_{speed}"] = 12.5
    drive.start()
    line.sleep(60)
    sim.pass_time(line.seconds)
    assert sim.motor.frequency == 12.5
    drive.stop()
