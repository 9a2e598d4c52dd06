"""Families that use a profile: their declarations, their identification, and the words that verbs send."""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum, IntFlag
from pathlib import Path
from typing import Any

import checksums
import pytest
from profile_families import MAKE, Acs355, Atv320, Fc51, Goodrive, VfdEl
from scripts import Wire
from tables import table

from multidrop import Bus, load_family
from multidrop.core import NumberFormat
from multidrop.drive import Condition, Direction, Drive, State
from multidrop.drive.declaration_check import DeclarationError
from multidrop.drive.register import COIL, Register, command, reading, setting
from multidrop.drive.verbs import VERBS
from multidrop.errors import DriveException, NotVerified, Unconfirmed, Unsupported, WriteForbidden
from multidrop.families.profiles import PROFILES, Delta
from multidrop.sim import SimulatedDrive, Simulator, simulated
from multidrop.sim import Wire as SimulatedWire

every_profile = pytest.mark.parametrize("profile", PROFILES.values(), ids=PROFILES)


@every_profile
def test_every_profile_is_documented(profile: type[Drive]) -> None:
    assert profile.__doc__
    assert len(profile.__doc__) > 400
    assert profile.registers == {}
    assert all(getattr(profile, name).__doc__ for name in (*VERBS, "identify"))


@every_profile
def test_each_profile_declares_the_stop_word_harmless(profile: Any) -> None:
    harmless = profile.roles["control"].harmless
    assert profile.stop_word in harmless
    assert profile.coast_word is None or profile.coast_word in harmless
    assert profile.reset_role != "control" or profile.reset_word not in harmless


def test_profile_completes_the_register_declarations_of_a_family() -> None:
    control = Acs355.control
    assert control.name == "control"
    assert control is Acs355.registers["control"]
    assert control.harmless == (0x047E, 0x047C, 0x0476)
    assert control.place.startswith("ACS355 p. 313")
    assert control.commands
    assert not Acs355.reference.commands


def test_family_may_add_a_reverse_bit_to_the_control_word() -> None:
    assert Atv320.control.values(0x0800).name == "REVERSE"


WRONG: list[tuple[type[Drive], dict[str, Any], str]] = [
    (Acs355, {"status": reading(3, number_format=NumberFormat.U32)}, "status: it is one word"),
    (Acs355, {"status": reading(3, number_format=NumberFormat.I16)}, "status: it is one word of bits"),
    (Acs355, {"control": command(0, table=COIL)}, "control: "),
    (Acs355, {"reference": setting(1, "%", step=-0.005)}, "reference: a greater count must mean more"),
    (
        Acs355,
        {"reference": setting(1, "%", number_format=NumberFormat.I16)},
        "reference: a reference below 0",
    ),
    (VfdEl, {"fault": reading(9, step=0.1)}, "fault: it is a code"),
    (VfdEl, {"fault": reading(9, offset=-5)}, "fault: it is a code"),
    (Atv320, {"sleeve": command(9, harmless=(1,))}, "sleeve: remove harmless: only control has"),
    (Atv320, {"output_frequency": reading(9, "Hz", part=(0, 3))}, "output_frequency: it is 0 only at rest"),
    (Atv320, {"output_frequency": reading(9, "Hz", offset=-50)}, "output_frequency: it is 0 only at rest"),
    (VfdEl, {"reference_in_force": reading(9, "%", step=0.01)}, "reference_in_force: its unit is not"),
    (Atv320, {"control": command(1, IntFlag("Bits", {"reverse": 8}))}, "control: bit 3 is ENABLE_OPERATION"),
    (Atv320, {"control": command(1, IntFlag("Bits", {"jog": 256}))}, "control: bits may only add reverse"),
    (
        Atv320,
        {"control": command(1, IntEnum("Bits", {"reverse": 0x1800}))},
        "control: reverse is not one bit",
    ),
    (Acs355, {"status": reading(3, part=(0, 7))}, "status: it is a whole word, so it cannot have part"),
    (VfdEl, {"control": command(0x2000, broadcast=(0x12,))}, "control: broadcast has counts that are not"),
]


@table(("family", "registers", "mistake"), WRONG)
def test_a_profile_refuses_unsuitable_register_declarations(
    family: type[Drive], registers: dict[str, Any], mistake: str
) -> None:
    with pytest.raises(DeclarationError) as wrong:
        type("Wrong", (family,), registers)
    (sentence,) = wrong.value.mistakes
    assert sentence.startswith(mistake)


def test_all_mistakes_in_a_family_with_a_profile_are_reported_together() -> None:
    class Words(IntEnum):
        RUN = 1

    with pytest.raises(DeclarationError) as wrong:

        class Bad(Delta):
            control = setting(0x2000, Words, harmless=(2,))
            status = reading(0x2101, step=0.1)
            reference = setting(0x2001, "rpm", span=(-10, 10))
            signature = reading(0x0000)
            stop_word = reading(0x0001)  # type: ignore[assignment]

    assert set(wrong.value.mistakes) == {
        "control: in this profile it is a command, not a setting",
        "control: harmless is set by the profile; leave it out",
        "control: values is set by the profile; leave it out",
        "status: it is one word of bits, so it cannot have a unit or a step",
        "reference: its unit is 'rpm'; this profile takes 'Hz' or '%'",
        "reference: a reference below 0 may turn the motor the other way: its span must begin at 0",
        "stop_word: reserved name: every profile has an attribute with this name; rename the register",
        "reset: this profile needs a register of this name, which is not declared",
        "output_frequency: this profile needs a register of this name, which is not declared",
        "fault: this profile needs a register of this name, which is not declared",
        "signature: it needs names for the values that identify the family",
    }


def test_setpoint_in_percent_requires_the_option_maximum_frequency() -> None:
    drive = Fc51(1, confirmed=1)
    wire = Wire(drive)
    with pytest.raises(WriteForbidden, match="maximum_frequency = HZ") as refusal:
        drive.set_frequency(20)
    assert "--option maximum_frequency=HZ" in refusal.value.for_command_line()
    assert wire.sent == []
    with pytest.raises(ValueError, match="above 50 Hz"):
        Fc51(1, maximum_frequency=50).set_frequency.script(51).send(None)


WELL = {
    "abb-acs355": {"status": 0x0231, "station": 1.0, "signature": 2},
    "danfoss-fc51": {"status": 0x0607, "station": 1.0, "signature": 2},
    "delta-vfd-el": {"status": 0x0500, "station": 1.0},
    "invt-goodrive": {"status": 3, "device": 0x0107},
    "powtran-pi130": {"status": 3, "fault": 0},
    "delixi-e": {"status": 3, "station": 1.0},
    "yaskawa-a1000": {"status": 0xC022, "signature": 0x4130},
    "optidrive-e3": {"status": 0x0040, "signature": 3},
    "schneider-atv320": {"status": 0x0250},
    "siemens-v20": {"status": 0x0231, "base_frequency": 5000},
}


def identify(model: str, **says: Any) -> Wire:
    drive = MAKE[model](1)
    said = {
        name: value if isinstance(value, Exception) else drive.registers[name].decode(int(value))
        for name, value in {**WELL[model], **says}.items()
    }
    wire = Wire(drive, said)
    drive.identify()
    return wire


@table("model", WELL)
def test_identity_check_accepts_a_drive_of_the_family(model: str) -> None:
    wire = identify(model)
    assert set(wire.reads) == set(WELL[model])
    assert wire.sent == []


STRANGERS: list[tuple[str, dict[str, Any], str]] = [
    ("abb-acs355", {"status": 0x0241}, "both ready to switch on and inhibited"),
    ("abb-acs355", {"status": 0x0202}, "ready to operate but not to switch on"),
    ("abb-acs355", {"station": 7}, "reports address 7"),
    ("abb-acs355", {"signature": 1}, "signature is 1, not one of drv_lim, drv_full"),
    ("danfoss-fc51", {"status": 0x0E08}, "both running and tripped"),
    ("danfoss-fc51", {"signature": 0}, "signature"),
    ("delta-vfd-el", {"status": 0xA000}, "bits 15 to 13 are none of its modes"),
    ("delta-vfd-el", {"station": 12}, "reports address 12"),
    ("invt-goodrive", {"status": 0}, "no such number"),
    ("invt-goodrive", {"device": 0}, "device is 0"),
    ("powtran-pi130", {"status": 0}, "no such number"),
    ("powtran-pi130", {"fault": 100}, "fault is 100"),
    ("delixi-e", {"station": 4}, "reports address 4"),
    ("siemens-v20", {"base_frequency": 0}, "base_frequency is 0"),
    ("yaskawa-a1000", {"status": 0}, "no bit is set"),
    ("yaskawa-a1000", {"status": 0xC083}, "both running and in a fault"),
    ("yaskawa-a1000", {"signature": 0x5630}, "not one of a1000"),
    ("optidrive-e3", {"status": 0x0080}, "reserved bits"),
    ("optidrive-e3", {"signature": 0}, "not one of modbus, modbus_and_ramp"),
    ("schneider-atv320", {"status": 0x0202}, "not a state of CiA 402"),
]


@table(("model", "says", "sentence"), STRANGERS)
def test_identity_check_refuses_values_of_another_family(
    model: str, says: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(WriteForbidden, match=sentence):
        identify(model, **says)


def test_the_identity_check_fails_if_the_drive_refuses_a_register() -> None:
    with pytest.raises(DriveException):
        identify("abb-acs355", signature=DriveException("abb", 2, "illegal address"))


def test_class_with_a_profile_can_be_extended_by_a_subclass() -> None:
    class Longer(Acs355):
        """A family with more registers than its base class."""

        output_current = reading(103, "A", step=0.1)

    assert Longer.control is Acs355.control
    assert set(Longer.registers) == {*Acs355.registers, "output_current"}


def test_unknown_status_is_never_reported_as_stopped() -> None:
    drive = Goodrive(1)
    Wire(drive, {"status": 9, "output_frequency": 0.0})
    assert drive.state().condition.value == "unknown"


# ---- control words ----


# The first bytes of frames to drive 1, as printed in the manuals.
ABB = "01 06 00 00 "  # register 40001 is address 0 (ACS355 manual p. 313)
FC = "01 06 C3 4F "  # register 50000, counted from 1 (FC 202 design guide p. 175)
DELTA = "01 06 20 00 "
E3 = "01 06 00 00 "
ATV = "01 06 21 35 "  # 8501
DELIXI = "01 06 A0 00 "
A1000 = "01 10 00 01 00 01 02 "  # register 0001H by function 10H (A1000 manual p. 559)

ABB_OFF, ABB_READY, ABB_ON, ABB_RUNS = 0x0270, 0x0231, 0x0233, 0x0237  # status words (ACS355 manual p. 319)
ABB_FAULT = 0x0238
FC_READY, FC_RUNS, FC_LOCK = 0x0607, 0x0E07, 0x0604 | 0x48
DELTA_STOP, DELTA_RUNS, DELTA_REVERSE = 0x0500, 0x0503, 0x051B
DELTA_TO_REVERSE = 0x0513  # status while the motor still turns forward although reverse was commanded
GD_STANDBY, GD_RUNS = 3, 1
MD_STOPPED, MD_RUNS = 3, 1  # values of register 3000H (PI130 manual p. 116)
# status words (A1000 manual 27C p. 494)
YK_OFF, YK_REVERSE, YK_FAULT = 0xC022, 0xC035, 0xC082
E3_READY, E3_RUNS, E3_TRIP = 0x0040, 0x0041, 0x0302
ATV_OFF, ATV_READY, ATV_ON, ATV_RUNS, ATV_FAULT = 0x0250, 0x0231, 0x0233, 0x0237, 0x0218

FREE = {"reference": 40.0, "output_frequency": 0.0, "fault": 0, "reference_in_force": 40.0}


def wire(model: str, status: Any, **says: Any) -> Wire:
    """Return a test wire with the drive. Its status does not change when it is commanded."""
    drive: Any = MAKE[model](1)
    drive.commanded = 40.0
    decode = drive.status.decode
    said = [decode(one) for one in status] if isinstance(status, list) else decode(status)
    return Wire(drive, {**FREE, "status": said, **says})


def sent(found: Wire) -> list[str]:
    """Return the sent frames without checksums, after checking the checksums."""
    assert all(checksums.rtu(frame[:-6]).hex(" ").upper() == frame for frame in found.sent)
    return [frame[:-6] for frame in found.sent]


def test_abb_start_waits_100_ms_between_its_control_words() -> None:
    found = wire("abb-acs355", [ABB_OFF, ABB_READY, ABB_ON, ABB_RUNS])
    found.drive.start()
    assert found.seconds >= 0.1


@pytest.mark.parametrize("model", ["abb-acs355", "siemens-v20"])
def test_a_start_of_a_running_profidrive_drive_sends_no_off_word(model: str) -> None:
    found = wire(model, ABB_RUNS)
    found.drive.start()
    assert [frame[-5:] for frame in sent(found)] == ["04 7F"]


COASTS = {
    "abb-acs355": (ABB_READY, ABB + "04 7C"),
    "siemens-v20": (ABB_READY, "01 06 00 63 04 7C"),
    "schneider-atv320": (ATV_ON, ATV + "00 00"),
    "danfoss-fc51": (FC_READY, FC + "04 34"),
    "invt-goodrive": (GD_STANDBY, DELTA + "00 06"),
    "optidrive-e3": (E3_READY, E3 + "00 08"),
    "powtran-pi130": (MD_STOPPED, DELTA + "00 05"),
    "delixi-e": (MD_STOPPED, DELIXI + "00 05"),
}


@table("model", COASTS)
def test_a_coast_sends_the_control_word_printed_in_the_manual(model: str) -> None:
    status, coast = COASTS[model]
    found = wire(model, status, output_frequency=[12.0, 0.0])
    found.drive.coast()
    assert sent(found) == [coast]
    assert found.reads.count("output_frequency") == 2  # the state is read until it shows 0 Hz


@table(("model", "status"), [("delta-vfd-el", DELTA_STOP), ("yaskawa-a1000", YK_OFF)])
def test_a_coast_without_a_coast_word_is_unsupported(model: str, status: int) -> None:
    with pytest.raises(Unsupported, match="no coast"):
        wire(model, status).drive.coast()


REVERSES = {
    "danfoss-fc51": ([FC_READY, FC_RUNS], FC + "84 7C"),
    "delta-vfd-el": ([DELTA_STOP, DELTA_REVERSE], DELTA + "00 22"),
    "invt-goodrive": ([GD_STANDBY, 2], DELTA + "00 02"),
    "schneider-atv320": ([ATV_OFF, ATV_READY, ATV_ON, ATV_RUNS], ATV + "08 0F"),
    "powtran-pi130": ([MD_STOPPED, 2], DELTA + "00 02"),
    "delixi-e": ([MD_STOPPED, 2], DELIXI + "00 02"),
    "yaskawa-a1000": ([YK_OFF, YK_REVERSE], A1000 + "00 02"),
}


@table("model", REVERSES)
def test_a_reverse_start_sends_the_control_word_of_the_manual(model: str) -> None:
    status, word = REVERSES[model]
    found = wire(model, status)
    found.drive.start(Direction.REVERSE)
    assert sent(found)[-1] == word


def test_a_jog_sends_the_control_word_of_its_direction() -> None:
    found = wire("delta-vfd-el", [DELTA_STOP, DELTA_RUNS])
    found.drive.jog()
    assert sent(found) == [DELTA + "00 13"]
    found = wire("delta-vfd-el", [DELTA_STOP, DELTA_TO_REVERSE, DELTA_REVERSE])
    found.drive.jog(Direction.REVERSE)
    assert sent(found) == [DELTA + "00 23"]
    found = wire("invt-goodrive", [GD_STANDBY, GD_RUNS, GD_RUNS, 2])
    found.drive.jog(Direction.REVERSE)
    assert sent(found) == [DELTA + "00 04"]


@table(
    ("model", "status"),
    [
        ("abb-acs355", 0x0241),
        ("delta-vfd-el", 0xA000),
        ("invt-goodrive", 0),
        ("invt-goodrive", 9),
        ("powtran-pi130", 0),
        ("delixi-e", 4),
        ("optidrive-e3", 0x0080),
        ("schneider-atv320", 0x0202),
        ("yaskawa-a1000", 0),
    ],
)
def test_a_start_is_refused_while_the_status_is_impossible(model: str, status: int) -> None:
    found = wire(model, [status])
    with pytest.raises(WriteForbidden, match=f"cannot be started: its status is {status:04X}H, and"):
        found.drive.start()
    assert sent(found) == []


@pytest.mark.parametrize("model", ["delta-vfd-el", "invt-goodrive"])
def test_a_jog_is_refused_while_the_status_is_impossible(model: str) -> None:
    found = wire(model, [0xA000])
    with pytest.raises(WriteForbidden, match="cannot be started: its status is A000H, and"):
        found.drive.jog()
    assert sent(found) == []


@pytest.mark.parametrize(
    ("model", "status"),
    [("delta-vfd-el", DELTA_RUNS), ("delta-vfd-el", DELTA_REVERSE), ("invt-goodrive", GD_RUNS)],
)
def test_a_jog_of_a_turning_motor_is_refused(model: str, status: Any) -> None:
    found = wire(model, [status])
    for direction in (None, *Direction):
        with pytest.raises(
            WriteForbidden, match=r"already turns, and a jog must start from rest: call stop\(\) first"
        ):
            found.drive.jog(direction)
    assert sent(found) == []


HINDRANCES = [
    ("abb-acs355", 0x0060 | 0x0200, "another source holds OFF2 \\(coast\\) active"),
    ("abb-acs355", 0x0050 | 0x0200, "another source holds OFF3 \\(quick stop\\) active"),
    ("abb-acs355", 0x0070 | 0x0200, "switching on is inhibited"),
    ("abb-acs355", 0x0030 | 0x0200, "not ready to be switched on"),
    ("danfoss-fc51", 0x0600, "is not ready"),
    ("danfoss-fc51", 0x0403, "hand mode"),
    ("optidrive-e3", 0x0000, "is not ready to run"),
    ("optidrive-e3", 0x0100, "is not ready to run"),  # status of a running motor, with swapped bytes
    ("invt-goodrive", 5, "has no mains"),
    ("yaskawa-a1000", 0x4022, "does not take commands from the line"),
    ("yaskawa-a1000", 0x8002, "is not ready"),
]


@table(("model", "status", "sentence"), HINDRANCES)
def test_the_error_of_a_refused_start_names_the_reason(model: str, status: int, sentence: str) -> None:
    found = wire(model, status)
    with pytest.raises(WriteForbidden, match=sentence):
        found.drive.start()
    assert all(frame[-5:] == "04 76" for frame in sent(found))


def test_a_running_optidrive_with_swapped_bytes_does_not_seem_stopped() -> None:
    # The guide's first edition prints the two bytes in the opposite order: there 0100H means running.
    found = wire("optidrive-e3", 0x0100, output_frequency=20.0)
    assert found.drive.state().condition is Condition.DECELERATING
    found = wire("optidrive-e3", 0x0000)
    assert found.drive.state() == State(Condition.STOPPED, note="is not ready to run")


STATES = [
    ("abb-acs355", ABB_RUNS, {}, Condition.RUNNING),
    ("abb-acs355", 0x0235, {}, Condition.DECELERATING),  # OFF1 is active: the motor stops along the ramp
    ("abb-acs355", ABB_READY, {"output_frequency": 3.0}, Condition.DECELERATING),
    ("abb-acs355", ABB_READY, {}, Condition.STOPPED),
    ("abb-acs355", ABB_FAULT, {"fault": 7}, Condition.FAULT),
    ("danfoss-fc51", FC_LOCK, {}, Condition.FAULT),
    ("delta-vfd-el", 0x0501, {}, Condition.DECELERATING),
    ("delta-vfd-el", 0x0502, {}, Condition.RUNNING),  # status "standby": the motor runs at 0 Hz
    # the high byte of the fault register is only a warning
    ("delta-vfd-el", DELTA_STOP, {"fault": 0x0500}, Condition.STOPPED),
    ("delta-vfd-el", DELTA_STOP, {"fault": 0x0031}, Condition.FAULT),
    ("invt-goodrive", 2, {}, Condition.RUNNING),
    ("invt-goodrive", 5, {}, Condition.STOPPED),
    ("optidrive-e3", E3_TRIP, {}, Condition.FAULT),
    ("powtran-pi130", 2, {}, Condition.RUNNING),
    ("powtran-pi130", MD_STOPPED, {"fault": 9}, Condition.FAULT),
    ("delixi-e", MD_STOPPED, {"output_frequency": 3.0}, Condition.DECELERATING),
    ("yaskawa-a1000", YK_REVERSE, {}, Condition.RUNNING),
    ("yaskawa-a1000", YK_FAULT, {}, Condition.FAULT),
    ("schneider-atv320", 0x0217, {}, Condition.DECELERATING),  # quick stop
    ("schneider-atv320", ATV_ON, {}, Condition.STOPPED),
]


@table(("model", "status", "says", "condition"), STATES)
def test_the_condition_is_decoded_from_the_status_word(
    model: str, status: int, says: dict[str, Any], condition: Condition
) -> None:
    assert wire(model, status, **says).drive.state().condition is condition


@table(
    ("model", "running"),
    [
        ("abb-acs355", ABB_RUNS),
        ("danfoss-fc51", FC_RUNS),
        ("delta-vfd-el", 0x0502),
        ("optidrive-e3", E3_RUNS),
    ],
)
def test_motor_that_runs_at_0_hz_is_not_reported_as_stopped(model: str, running: int) -> None:
    found = wire(model, running, output_frequency=0.0)
    found.drive.option["stop_time"] = 5.0
    with pytest.raises(Unconfirmed, match="does not report a stop within 5 s"):
        found.drive.stop()


@pytest.mark.parametrize(
    ("shown", "sentence"),
    [(0.0, "setpoint .* is 0"), (12.5, r"follows 12\.50 Hz instead of the written setpoint")],
)
def test_a_delta_start_is_refused_if_another_setpoint_is_shown(shown: float, sentence: str) -> None:
    found = wire("delta-vfd-el", DELTA_STOP, reference_in_force=shown)
    with pytest.raises(WriteForbidden, match=sentence):
        found.drive.start()
    assert found.sent == []


def test_the_command_stop_jog_is_sent_if_an_invt_drive_still_jogs() -> None:
    """STOP_JOG is not delayed until the stop's time limit."""
    found = wire("invt-goodrive", GD_RUNS)
    found.drive.option["stop_time"] = 5.0
    with pytest.raises(Unconfirmed, match="5 s"):
        found.drive.stop()
    assert sent(found) == [DELTA + "00 05", DELTA + "00 08"]
    assert found.seconds < 5.5


def test_a_start_of_an_invt_drive_after_a_jog_requires_a_stop() -> None:
    found = wire("invt-goodrive", [GD_STANDBY, GD_RUNS])
    found.drive.jog()
    found.sent.clear()
    with pytest.raises(WriteForbidden, match=r"may still be jogging.*stop\(\)"):
        found.drive.start()
    assert found.sent == []
    found.say({"status": found.drive.status.values(GD_STANDBY)})
    with pytest.raises(Unconfirmed):  # the start is sent, but the test drive never shows that it runs
        found.drive.start()
    assert sent(found) == [DELTA + "00 01"]


@pytest.mark.parametrize(
    ("status", "words", "sentence"),
    [
        ([ATV_OFF], ("00 06",), "not ready to be switched on"),
        ([ATV_OFF, ATV_READY], ("00 06", "00 07"), "not switched on"),
    ],
)
def test_cia402_start_waits_for_each_state(status: list[int], words: tuple[str, ...], sentence: str) -> None:
    found = wire("schneider-atv320", status)
    with pytest.raises(NotVerified, match=sentence):
        found.drive.start()
    assert sent(found) == [ATV + word for word in words]


def test_a_profidrive_drive_is_switched_off_if_a_start_fails() -> None:
    found = wire("abb-acs355", [ABB_OFF, ABB_READY])
    with pytest.raises(NotVerified, match="not ready to operate"):
        found.drive.start()
    assert sent(found) == [ABB + "04 76", ABB + "04 77", ABB + "04 7E"]


EXCHANGED = {"forward": 1, "reverse": 2, "stop": 6, "coast": 5, "reset_fault": 7}


def numbered(words: Mapping[str, int], **facts: Any) -> Register[Any]:
    make: Any = IntEnum
    return command(0x2000, make("Words", words), **facts)


class Clone(Goodrive):
    """A family with INVT's control words: 5 and 6 are exchanged, and it has no words for a jog."""

    control = numbered(EXCHANGED)


def test_a_family_may_renumber_the_control_words_of_a_profile() -> None:
    drive: Any = Clone(1, confirmed=1)
    drive.commanded = 40.0
    found = Wire(drive, {**FREE, "status": drive.status.values(GD_STANDBY)})
    drive.stop()
    drive.coast()
    assert sent(found) == [DELTA + "00 06", DELTA + "00 05"]
    assert Clone.control.harmless == (6, 5)
    assert Goodrive.control.harmless == (5, 6, 8)


def test_a_running_drive_gets_the_renumbered_stop_word() -> None:
    drive: Any = Clone(1, confirmed=1)
    found = Wire(drive, {**FREE, "status": [drive.status.values(GD_RUNS), drive.status.values(GD_STANDBY)]})
    drive.stop()
    assert sent(found) == [DELTA + "00 06"]


def test_a_verb_without_a_control_word_is_unsupported() -> None:
    control = numbered({"forward": 1, "stop": 0, "reset_fault": 9})
    drive: Any = type("Short", (Goodrive,), {"control": control})(1, confirmed=1)
    drive.commanded = 40.0
    found = Wire(drive, {**FREE, "status": drive.status.values(GD_STANDBY)})
    for call in (drive.coast, drive.jog, lambda: drive.start(Direction.REVERSE)):
        with pytest.raises(Unsupported):
            call()
    assert found.sent == []


@table(
    ("words", "mistake"),
    [
        ({"forward": 1, "stop": 6}, "control: the number of reset_fault is missing"),
        ({**EXCHANGED, "crawl": 9}, "control: crawl is not a word of this profile; it has forward, reverse"),
        ({**EXCHANGED, "stop": 5}, "control: two of its words have the same number"),
        ({**EXCHANGED, "jog_forward": 3}, "control: a jog needs a number for stop_jog"),
        ({**EXCHANGED, "stop": 0x10000}, "control: STOP = 65536 is not within 0 to 65535"),
    ],
)
def test_invalid_control_words_of_a_family_are_reported(words: Mapping[str, int], mistake: str) -> None:
    with pytest.raises(DeclarationError) as wrong:
        type("Wrong", (Goodrive,), {"control": numbered(words)})
    assert any(each.startswith(mistake) for each in wrong.value.mistakes)


def test_numbered_control_words_cannot_be_declared_as_bits() -> None:
    with pytest.raises(DeclarationError, match="its words are whole numbers"):
        type("Bits", (Goodrive,), {"control": command(0x2000, IntFlag("Bits", {"forward": 1, "stop": 2}))})


CLONE_FILE = """
[family]
title = "Clone"
manual = "Clone manual, section 8"
profile = "invt"
counts_from = 0

[command]
control = { at = 0x2000, values = { forward = 1, reverse = 2, stop = 6, coast = 5, reset_fault = 7 } }

[setting]
reference = { at = 0x2001, unit = "Hz", step = 0.01, span = [0, 400], kept = "ram" }

[reading]
status = { at = 0x2100 }
output_frequency = { at = 0x3000, unit = "Hz", step = 0.01 }
"""


def test_simulated_drive_of_a_family_file_runs_with_renumbered_control_words(tmp_path: Path) -> None:
    (tmp_path / "clone.toml").write_text(CLONE_FILE)
    family = load_family(tmp_path / "clone.toml")
    sim: SimulatedDrive = simulated(family(1))
    with Simulator([SimulatedWire([sim])]) as line, Bus(line.wires[0].path) as bus:
        drive: Any = bus.attach(family, address=1, confirmed=1)
        drive.set_frequency(20)
        drive.start()
        assert sim.motor.goal == 20
        drive.stop()
        assert sim.motor.frequency == 0
        assert drive.state().condition is Condition.STOPPED
