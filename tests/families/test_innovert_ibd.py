"""INNOVERT IBD: the register table, and the frames that verbs send, as printed in appendix 2."""

from __future__ import annotations

import checksums
import pytest
from profile_families import shipped
from scripts import Wire, frame, rows, typed
from simulated_bus import one
from tables import table

from multidrop.drive import Condition, Direction, Framing
from multidrop.drive.declaration_check import DeclarationError
from multidrop.drive.register import HOLDING, reading
from multidrop.errors import DriveException, NoReply, Unconfirmed, WriteForbidden
from multidrop.families.innovert_ibd import (
    FrequencySource,
    IBDBaudrate,
    IBDControl,
    IBDRunSource,
    InnovertIBD,
    Output,
    Terminals,
    parameter,
)

RUN = {Framing.RTU: "01 06 20 00 00 02 03 CB", Framing.ASCII: ":010620000002D7"}
STOP = {Framing.RTU: "01 06 20 00 00 01 43 CA", Framing.ASCII: ":010620000001D8"}
FIFTY = {Framing.RTU: "01 06 20 01 13 88 DE 9C", Framing.ASCII: ":0106200113883D"}
RESET = "01 06 20 00 00 10 83 C6"
ZERO = "01 06 20 01 00 00 D3 CA"

BY_LINE = {"frequency_source": FrequencySource.LINE, "run_source": IBDRunSource.LINE}
STANDING = {"motor_speed": 0.0, "output_current": 0.0, "deceleration_time": 8.0, "output_m01": 0, **BY_LINE}
PROGRAMMED = {
    "output_m01": Output.RUNNING,
    "output_m02": Output.ACCELERATING,
    "output_yabc": Output.DECELERATING,
    "output_virtual": Output.FAULT,
}

TURNS = {each: {"output_current": 1.2} for each in RUN.values()} | {
    each: {"output_current": 0.0} for each in STOP.values()
}

TABLE = """
03/06 0003 output_current     0.1 A
03/06 0004 motor_speed          ?
03/06 0016 terminals            - Terminals
03/06 0064 stored_frequency     ? Hz
03/06 0065 frequency_source     - FrequencySource
03/06 0066 run_source           - IBDRunSource
03/06 006B acceleration_time  0.1 s
03/06 006C deceleration_time  0.1 s
03/06 0143 output_m01           - Output
03/06 0144 output_m02           - Output
03/06 0145 output_yabc          - Output
03/06 0148 output_virtual       - Output
03/06 0190 jog_frequency        ? Hz
03/06 02BC baudrate_setting     - IBDBaudrate
03/06 02BD format_setting       - IBDFormat
03/06 02BE address_setting      1
03/06 2000 control              - IBDControl
03/06 2001 frequency         0.01 Hz
"""


def test_innovert_ibd_registers_equal_the_table_of_appendix_2() -> None:
    assert rows(InnovertIBD) == typed(TABLE)


@table(
    ("name", "address"),
    [("PrA.03", 3), ("PrA.04", 4), ("Prb.00", 0x64), ("Prb.01", 0x65), ("Prb.07", 0x6B), ("Prb.08", 0x6C)],
)
def test_innovert_ibd_parameter_address_follows_from_its_letter_and_number(name: str, address: int) -> None:
    assert parameter(name) == address


def test_innovert_ibd_line_settings_and_limits_are_those_of_the_manual() -> None:
    assert str(InnovertIBD(240).settings) == "9600 8N1"
    assert sorted(InnovertIBD.baudrates) == [4800, 9600, 19200, 38400]
    assert InnovertIBD.formats == dict.fromkeys((Framing.RTU, Framing.ASCII), ("8N1", "8E1", "8O1"))
    assert InnovertIBD.most_registers == {HOLDING: 4}
    assert InnovertIBD(1).needed_silence() == 10e-3
    assert InnovertIBD(1, framing="ascii").needed_silence() == 0
    assert InnovertIBD(1).exception(2) == "a code that the document does not explain"


def test_innovert_ibd_control_words_never_have_toggle_or_reserved_bits() -> None:
    assert {each.value for each in IBDControl} == {0, 1, 2, 3, 6, 7, 0x0A, 0x0B, 0x10}


def test_innovert_ibd_terminal_bits_have_the_documented_names() -> None:
    assert [bit.value for bit in Terminals] == [1 << at for at in (*range(11), 13)]
    # the value in the manual's example; bits 11 and 12 have no name
    printed = InnovertIBD.terminals.decode(0x1800)
    assert InnovertIBD.terminals.format(printed) == "bit 11, bit 12"


@table("framing", InnovertIBD.framings)
def test_each_innovert_ibd_command_sends_the_frame_in_the_manual(framing: Framing) -> None:
    wire = Wire(InnovertIBD(1, framing=framing), {**STANDING, "terminals": Terminals(0)}, turns=TURNS)
    wire.drive.set_frequency(50)
    wire.drive.start()
    wire.drive.stop()
    assert wire.sent == [FIFTY[framing], RUN[framing], STOP[framing]]


def test_innovert_ibd_reset_and_setpoint_0_send_the_documented_frames() -> None:
    wire = Wire(InnovertIBD(1), STANDING)
    wire.drive.reset_fault()
    wire.drive.set_frequency(0)
    assert wire.sent == [STOP[Framing.RTU], RESET, STOP[Framing.RTU], ZERO]


def test_innovert_ibd_reset_bit_is_cleared_although_the_reset_is_unconfirmed() -> None:
    """A reset bit that stays set could reset a later fault unseen."""
    wire = Wire(InnovertIBD(1), STANDING, {RESET: [Unconfirmed("drive", "reset", "no reply")]})
    with pytest.raises(Unconfirmed):
        wire.drive.reset_fault()
    assert wire.sent == [STOP[Framing.RTU], RESET, STOP[Framing.RTU]]


def test_innovert_ibd_start_fails_if_an_output_setting_is_unreadable() -> None:
    faulty = {**STANDING, **PROGRAMMED, "terminals": Terminals.VIRTUAL, "output_m02": NoReply("drive")}
    wire = Wire(InnovertIBD(1), faulty)
    wire.drive.set_frequency(50)
    with pytest.raises(NoReply):
        wire.drive.start()
    assert wire.sent == [FIFTY[Framing.RTU]]
    wire.drive.stop()  # confirmed by speed and current


def test_innovert_ibd_fault_reset_sends_a_stop_first() -> None:
    """By table 3, the reset word leaves the run command unchanged. So an earlier run may still be active."""
    stop = STOP[Framing.RTU]
    lost = [Unconfirmed("drive", "stop", "no reply")] * 3
    wire = Wire(InnovertIBD(1), STANDING, {stop: lost})
    with pytest.raises(Unconfirmed):
        wire.drive.reset_fault()
    assert wire.sent == [stop] * 3
    for turning in ({"motor_speed": 120.0}, {"output_current": 0.4}):
        wire = Wire(InnovertIBD(1), {**STANDING, **turning})
        with pytest.raises(WriteForbidden, match="turns: it has no fault to reset"):
            wire.drive.reset_fault()
        assert wire.sent == []


@table("direction", Direction)
def test_innovert_ibd_start_with_a_direction_needs_the_option_forward_bit(direction: Direction) -> None:
    wire = Wire(InnovertIBD(1))
    for verb in (wire.drive.start, wire.drive.jog):
        with pytest.raises(WriteForbidden, match="does not say whether bit 2 or 3"):
            verb(direction)
    assert wire.sent == []


@table(("forward_bit", "forward", "reverse"), [(2, "06", "0A"), (3, "0A", "06")])
def test_innovert_ibd_forward_bit_selects_direction(forward_bit: int, forward: str, reverse: str) -> None:
    says = {**STANDING, "terminals": Terminals(0)}
    drive = InnovertIBD(1, forward_bit=forward_bit)
    words = [frame(drive, drive.control, IBDControl(int(each, 16))) for each in (forward, reverse, "02")]
    wire = Wire(drive, says, turns=TURNS | {word: {"output_current": 0.4} for word in words})
    wire.drive.set_frequency(50)
    for direction in (Direction.FORWARD, Direction.REVERSE, None):
        wire.drive.start(direction)
        wire.drive.stop()
    assert [each for each in wire.sent[1:] if each != STOP[Framing.RTU]] == words


JOG = checksums.rtu("01 06 20 00 00 03").hex(" ").upper()  # the value 3 in bits 1 and 0 means jog (table 3)


def test_innovert_ibd_jog_sends_the_control_word_of_table_3() -> None:
    wire = Wire(InnovertIBD(1), {**STANDING, "terminals": Terminals(0)}, turns={JOG: {"output_current": 0.4}})
    wire.drive.jog()
    assert wire.sent == [JOG]


@table(
    "turning",
    [{"motor_speed": 120.0}, {"output_current": 0.4}, {**PROGRAMMED, "terminals": Terminals.M01}],
    ids=["speed", "current", "outputs"],
)
def test_innovert_ibd_start_and_jog_of_a_turning_motor_are_refused(turning: dict[str, object]) -> None:
    """A jog ends only with a stop. After the stop, the drive can be started (table 3)."""
    wire = Wire(InnovertIBD(1), {**STANDING, "terminals": Terminals(0), **turning})
    wire.drive.set_frequency(50)
    for verb in (wire.drive.start, wire.drive.jog):
        with pytest.raises(
            WriteForbidden,
            match=r"turns, and no register shows if this is a jog: call stop\(\) first",
        ):
            verb()
    assert wire.sent == [FIFTY[Framing.RTU]]


def test_innovert_ibd_start_after_jog_and_stop_runs_at_the_setpoint() -> None:
    line, drive, sim = one(InnovertIBD(1))
    drive.jog()
    drive.set_frequency(50)
    with pytest.raises(WriteForbidden, match=r"stop\(\) first"):
        drive.start()
    drive.stop()
    drive.start()
    sim.pass_time(line.seconds + 60)
    assert sim.motor.frequency == 50


@table(
    ("says", "sentence"),
    [
        ({"frequency_source": FrequencySource.PARAMETER}, r"Prb\.01 to 5"),
        ({"run_source": 1}, r"Prb\.02 to 2"),
        ({**PROGRAMMED, "terminals": Terminals.VIRTUAL}, "fault"),
        ({}, "set_frequency"),
    ],
)
def test_innovert_ibd_start_is_refused_with_a_fault_or_wrong_settings(
    says: dict[str, object], sentence: str
) -> None:
    wire = Wire(InnovertIBD(1), {**STANDING, "terminals": Terminals(0), **says})
    with pytest.raises(WriteForbidden, match=sentence):
        wire.drive.start()
    assert wire.sent == []


def test_start_of_a_sibling_with_a_fault_register_names_the_fault() -> None:
    line, drive, sim = one(shipped("innovert-idd-mini-plus", 1))
    drive.set_frequency(20)
    sim.motor.fault = 4
    with pytest.raises(WriteForbidden, match=r"has a fault, 4: .*reset_fault\(\)"):
        drive.start()
    assert not [request for request, _ in line.frames if request.function == 6 and request.start == 0x2000]


def test_innovert_ibd_identity_check_compares_address_and_baud_rate() -> None:
    says = {"baudrate_setting": IBDBaudrate.B9600, "address_setting": 1}
    Wire(InnovertIBD(1), says).drive.identify()
    for other in (
        {"address_setting": 0},
        {"baudrate_setting": 3},
        {"address_setting": DriveException("it", 2, "")},
    ):
        with pytest.raises(WriteForbidden, match="confirmed = 1"):
            Wire(InnovertIBD(1), {**says, **other}).drive.identify()
        Wire(InnovertIBD(1, confirmed=1), {**says, **other}).drive.identify()


def test_innovert_ibd_start_is_unconfirmed_if_current_and_speed_stay_0() -> None:
    wire = Wire(InnovertIBD(1), STANDING | {"terminals": Terminals(0)})
    wire.drive.set_frequency(50)
    with pytest.raises(
        Unconfirmed, match=r"reports no run within .* s\. Stop it, or its motor may start later"
    ):
        wire.drive.start()
    assert wire.sent == [FIFTY[Framing.RTU], RUN[Framing.RTU]]


SEEN = {
    "output_current": 0.0,
    "motor_speed": 0.0,
    "acceleration_time": 10.0,
    "run_source": IBDRunSource.LINE,
    "terminals": 0x1800,
}


@table("name", SEEN)
def test_a_drive_without_ibd_registers_is_not_taken_for_an_ibd(name: str) -> None:
    def resembles(says: dict[str, object]) -> bool:
        wire = Wire(InnovertIBD(1), says)
        found = wire.run(wire.drive.resembles())
        assert isinstance(found, bool)
        return found

    assert resembles(SEEN)
    assert not resembles({**SEEN, name: DriveException("it", 2, "")})


def test_innovert_ibd_stop_waits_until_speed_and_current_are_0() -> None:
    wire = Wire(
        InnovertIBD(1), {**STANDING, "motor_speed": [900.0, 300.0, 0.0], "output_current": [1.2, 0.0]}
    )
    wire.drive.stop()
    assert wire.reads.count("motor_speed") == 4
    wire = Wire(InnovertIBD(1), {**STANDING, "output_current": 0.1})
    with pytest.raises(Unconfirmed, match="13 s"):
        wire.drive.stop()


def test_innovert_ibd_stop_is_confirmed_by_programmed_outputs() -> None:
    shown = [Terminals.M01 | Terminals.YABC, Terminals.YABC, Terminals.M02, Terminals(0)]
    wire = Wire(InnovertIBD(1), {**STANDING, **PROGRAMMED, "terminals": shown})
    wire.drive.stop()
    assert wire.reads.count("terminals") == len(shown)
    assert "motor_speed" not in wire.reads


def test_innovert_ibd_setpoint_is_limited_by_the_option_maximum_frequency() -> None:
    wire = Wire(InnovertIBD(1, maximum_frequency=50))
    with pytest.raises(WriteForbidden, match=r"50\.50 Hz is above maximum_frequency, which is 50 Hz"):
        wire.drive.set_frequency(50.5)
    with pytest.raises(ValueError, match="0 to 400 Hz"):
        Wire(InnovertIBD(1)).drive.set_frequency(400.5)
    assert wire.sent == []


def test_innovert_ibd_state_is_unknown_unless_its_outputs_are_programmed() -> None:
    refusal = DriveException("drive", 2, "")
    for says in (
        {**PROGRAMMED, "output_m01": 0},
        {**PROGRAMMED, "output_virtual": Output.RUNNING},
        {"output_m01": refusal},
    ):
        state = Wire(InnovertIBD(1), {"terminals": Terminals(0), **says}).drive.state()
        assert state.condition is Condition.UNKNOWN
        assert "Prd.23" in state.note


@table(
    ("raw", "condition"),
    [
        (0x1800, Condition.STOPPED),  # the value in the manual's example, with unnamed bits set
        (0x1900, Condition.RUNNING),
        (0x1B00, Condition.ACCELERATING),
        (0x1D00, Condition.DECELERATING),
        (0x3800, Condition.FAULT),
        (0x3900, Condition.FAULT),
    ],
)
def test_the_innovert_ibd_state_is_read_from_its_outputs(raw: int, condition: Condition) -> None:
    says = {"terminals": InnovertIBD.terminals.decode(raw), **PROGRAMMED}
    assert Wire(InnovertIBD(1), says).drive.state().condition is condition


def test_innovert_ibd_registers_with_inferred_addresses_are_never_written() -> None:
    never = {name for name, each in InnovertIBD.registers.items() if each.never}
    inferred = {name for name, each in InnovertIBD.registers.items() if 200 <= each.address < 0x2000}
    assert inferred <= never
    assert never - inferred == {"frequency_source", "run_source", "stored_frequency"}


@table(
    ("register", "mistake"),
    [
        ({"run_state": reading(300, step=0.1)}, "it is 0 only at rest"),
        ({"fault": reading(300, part=(0, 0))}, "it is 0 only without a fault"),
    ],
)
def test_invalid_run_state_or_fault_of_an_ibd_subclass_is_refused(
    register: dict[str, object], mistake: str
) -> None:
    with pytest.raises(DeclarationError, match=mistake):
        type("Sibling", (InnovertIBD,), register)
