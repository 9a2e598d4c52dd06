"""Families that use a profile: required and forbidden declarations, and identification of drives."""

from __future__ import annotations

from enum import IntEnum, IntFlag
from typing import Any

import pytest
from profile_families import MAKE, Acs355, Atv320, Fc51, Goodrive, VfdEl
from scripts import Wire
from tables import table

from multidrop.core import NumberFormat
from multidrop.drive import Drive, DriveException, WriteForbidden
from multidrop.drive.declaration_check import DeclarationError
from multidrop.drive.register import COIL, command, reading, setting
from multidrop.drive.verbs import VERBS
from multidrop.families.profiles import PROFILES, Delta

every_profile = pytest.mark.parametrize("profile", PROFILES.values(), ids=PROFILES)


@every_profile
def test_every_profile_is_documented(profile: type[Drive]) -> None:
    assert profile.__doc__
    assert len(profile.__doc__) > 400
    assert profile.registers == {}
    assert all(getattr(profile, name).__doc__ for name in (*VERBS, "identify"))


@every_profile
def test_no_raw_count_declared_harmless_is_a_start_or_reset_word(profile: Any) -> None:
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
    (Atv320, {"sleeve": command(9, harmless=(1,))}, "sleeve: only control has harmless counts"),
    (Atv320, {"output_frequency": reading(9, "Hz", part=(0, 3))}, "output_frequency: it is 0 only at rest"),
    (Atv320, {"output_frequency": reading(9, "Hz", offset=-50)}, "output_frequency: it is 0 only at rest"),
    (VfdEl, {"reference_in_force": reading(9, "%", step=0.01)}, "reference_in_force: its unit is not"),
    (Atv320, {"control": command(1, IntFlag("Bits", {"reverse": 8}))}, "control: bit 3 is ENABLE_OPERATION"),
    (Atv320, {"control": command(1, IntFlag("Bits", {"jog": 256}))}, "control: bits may only add reverse"),
]


@table(("family", "registers", "mistake"), WRONG)
def test_register_that_does_not_fit_its_role_in_the_profile_is_refused(
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
        "status: it is one word of bits, without a unit and a step",
        "reference: its unit is 'rpm'; this profile takes 'Hz' or '%'",
        "reference: a reference below 0 may turn the motor the other way; its span begins at 0",
        "stop_word: reserved name; every profile has it for something else; rename the register",
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
def test_identify_accepts_a_drive_of_the_family(model: str) -> None:
    wire = identify(model)
    assert set(wire.reads) == set(WELL[model])
    assert wire.sent == []


STRANGERS: list[tuple[str, dict[str, Any], str]] = [
    ("abb-acs355", {"status": 0x0241}, "switched on and inhibited"),
    ("abb-acs355", {"status": 0x0202}, "ready to operate and not to be switched on"),
    ("abb-acs355", {"station": 7}, "says that its address is 7"),
    ("abb-acs355", {"signature": 1}, "signature is 1, and none of drv_lim, drv_full"),
    ("danfoss-fc51", {"status": 0x0E08}, "run and be tripped"),
    ("danfoss-fc51", {"signature": 0}, "signature"),
    ("delta-vfd-el", {"status": 0xA000}, "bits 15 to 13 are none of its modes"),
    ("delta-vfd-el", {"station": 12}, "address is 12"),
    ("invt-goodrive", {"status": 0}, "no such number"),
    ("invt-goodrive", {"device": 0}, "device is 0"),
    ("powtran-pi130", {"status": 0}, "no such number"),
    ("powtran-pi130", {"fault": 100}, "fault is 100"),
    ("delixi-e", {"station": 4}, "address is 4"),
    ("siemens-v20", {"base_frequency": 0}, "base_frequency is 0"),
    ("yaskawa-a1000", {"status": 0}, "no bit is set"),
    ("yaskawa-a1000", {"status": 0xC083}, "run and have a fault"),
    ("yaskawa-a1000", {"signature": 0x5630}, "none of a1000"),
    ("optidrive-e3", {"status": 0x0080}, "reserved bits"),
    ("optidrive-e3", {"signature": 0}, "none of modbus, modbus_and_ramp"),
    ("schneider-atv320", {"status": 0x0202}, "none of the states"),
]


@table(("model", "says", "sentence"), STRANGERS)
def test_identify_refuses_values_of_another_family(model: str, says: dict[str, Any], sentence: str) -> None:
    with pytest.raises(WriteForbidden, match=sentence):
        identify(model, **says)


def test_drive_that_refuses_to_read_a_profile_register_is_not_identified() -> None:
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
