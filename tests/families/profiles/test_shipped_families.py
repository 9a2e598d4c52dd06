"""The families that ship as files: their tables, typed from the manuals, and their use."""

from __future__ import annotations

import importlib.metadata
import re
import subprocess
import sys
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from typing import Any

import pytest
from profile_families import SHIPPED_AS, shipped
from scripts import rows, typed
from simulated_bus import SimulatedBus, one

from multidrop import Bus, Plant
from multidrop.cli import main
from multidrop.drive import Condition, Drive, Unsupported, WriteForbidden
from multidrop.drive.register import Access
from multidrop.families import MODELS, YD1000
from multidrop.families.profiles import PROFILES, Profile
from multidrop.families.registry import GROUP, SHIPPED, find_model, shipped_family
from multidrop.sim import MotorDrive, Simulator, Wire, simulated

every_family = pytest.mark.parametrize("name", SHIPPED)
every_profile_family = pytest.mark.parametrize("name", SHIPPED_AS)
READ_ONLY = "erman-er-g-220-03"

# How the places name the editions that [family].manual lists.
EDITIONS = {
    "abb-acs355": ("ACS355", "ACS550-02/U2", "ACS550-01", "ACS550 p. 209"),
    "danfoss-fc51": ("FC 51", "FC 101", "FC 202", "MG02A4", "MG02C6"),
    "delta-vfd-el": ("VFD-EL", "VFD-EL-W", "CP2000"),
    READ_ONLY: ("2026",),
    "delta-ms300": ("MS300",),
    "optidrive-e3": ("ODE-3", "E3 advanced technical manual"),
}

# Function codes, address on the wire, name, step, unit.
TABLES = {
    "abb-acs355": """
03/06 0000 control           - ProfidriveControl
03/06 0001 reference         0.005 %
03/06 0003 status            - ProfidriveStatus
03/06 0066 output_frequency  0.1 Hz
03/06 0067 output_current    0.1 A
03/06 0068 output_torque     0.1 %
03/06 006A dc_bus_voltage    1 V
03/06 006C output_voltage    1 V
03/06 0190 fault             - Fault
03/06 14B5 station           1
03/06 14B8 signature         - Signature
""",
    "danfoss-fc51": """
03/06 C34F control           - DanfossControl
03/06 C359 reference         0.006103515625 %
03/06 C417 status            - DanfossStatus
03/06 C421 main_actual_value 0.006103515625 %
03/06 3F01 output_frequency  0.1 Hz
03/06 3FAB dc_bus_voltage    1 V
03/06 206B signature         - Signature
03/06 2075 station           1
""",
    "delta-vfd-el": """
03/06 2000 control              - DeltaControl
03/06 2001 reference            0.01 Hz
03/06 2002 reset                - DeltaReset
03/06 2100 fault                1
03/06 2101 status               - DeltaStatus
03/06 2102 reference_in_force   0.01 Hz
03/06 2103 output_frequency     0.01 Hz
03/06 2104 output_current       0.1 A
03/06 2108 dc_bus_voltage       0.1 V
03/06 2109 output_voltage       0.1 V
03/06 210A heatsink_temperature 1 °C
03/06 0900 station              1
""",
    READ_ONLY: """
03/06 0001 output_frequency   0.1 Hz
03/06 0002 output_current     0.1 A
03/06 0003 input_voltage      1 V
03/06 0004 temperature        1 °C
03/06 0005 pressure           0.01 bar
03/06 0006 fault              - Fault
03/06 0007 state_word         1
03/06 000B wake_difference    0.01 bar
03/06 000C dry_run_pressure   0.01 bar
03/06 000D dry_run_time       1 s
03/06 000E carrier_frequency  1
03/06 000F ramp_time          ?
03/06 0010 pressure_tolerance 0.01 bar
03/06 0011 minimum_frequency  0.1 Hz
03/06 0016 station            1
03/06 1000 pressure_setpoint  0.01 bar
""",
    "delta-ms300": """
03/06 2000 control              - DeltaControl
03/06 2001 reference            0.01 Hz
03/06 2002 reset                - DeltaReset
03/06 2100 fault                1
03/06 2101 status               - DeltaStatus
03/06 2102 reference_in_force   0.01 Hz
03/06 2103 output_frequency     0.01 Hz
03/06 2104 output_current       ? A
03/06 2105 dc_bus_voltage       0.1 V
03/06 2106 output_voltage       0.1 V
03/06 0900 station              1
""",
    "optidrive-e3": """
03/06 0000 control              - OptidriveControl
03/06 0001 reference            0.1 Hz
03/06 0005 status               - OptidriveStatus
03/06 0006 output_frequency     0.1 Hz
03/06 0007 output_current       0.1 A
03/06 000A inputs               1
03/06 0013 analog_input_1       0.1 %
03/06 0014 analog_input_2       0.1 %
03/06 0015 speed_reference      0.1 Hz
03/06 0016 dc_bus_voltage       1 V
03/06 0017 heatsink_temperature 1 °C
03/06 008B signature            - Signature
""",
}


def test_the_families_by_name() -> None:
    assert list(SHIPPED) == sorted(TABLES)
    assert {*SHIPPED} == {*SHIPPED_AS, READ_ONLY}
    assert not set(SHIPPED) & set(MODELS)
    assert all(find_model(name).model == name for name in SHIPPED)
    with pytest.raises(ValueError, match=r"no model 'abb-acs35'; did you mean abb-acs355\?"):
        find_model("abb-acs35")


@every_family
def test_the_registers_are_those_of_the_manual(name: str) -> None:
    assert rows(shipped_family(name)) == typed(TABLES[name])


@every_family
def test_shipped_family_names_its_sources_and_is_marked_untested(name: str) -> None:
    family = shipped_family(name)
    assert issubclass(family, Profile) is (name != READ_ONLY)
    assert "not tried on hardware" in family.title
    assert "Not tried on hardware" in (family.__doc__ or "")
    assert family.line_parameters
    if name != READ_ONLY:
        assert family.watchdog != Drive.watchdog
        assert family.remote != Drive.remote


@every_family
def test_every_register_names_a_page_of_an_edition(name: str) -> None:
    family = shipped_family(name)
    assert all(edition.partition(" p. ")[0] in family.manual for edition in EDITIONS[name])
    for register in family.registers.values():
        assert re.search(r"\bp\. \d", register.place), (register.name, register.place)
        assert any(edition in register.place for edition in EDITIONS[name]), (register.name, register.place)


def test_pump_controller_is_only_read(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    family = shipped_family(READ_ONLY)
    assert {register.access for register in family.registers.values()} == {Access.READING}
    assert "confirmed" not in family.options
    bus, drive, sim = (SimulatedBus(monkeypatch, sim := simulated(family(63))), family(63), sim)
    bus.attach(drive)
    for call in (drive.start, drive.stop, drive.reset_fault, lambda: drive.set_frequency(20), drive.state):
        with pytest.raises(Unsupported):
            call()
    assert bus.written == []
    sim["pressure"] = 2.5
    assert drive.read(drive.register("pressure")) == 2.5
    drive.perform(drive.identify.script())
    sim["minimum_frequency"] = 0
    with pytest.raises(WriteForbidden):
        drive.perform(drive.identify.script())


@every_profile_family
def test_no_command_is_sent_before_confirmation(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    family = shipped_family(name)
    bus, drive, _ = one(monkeypatch, family(1))
    for call in (lambda: drive.set_frequency(20), drive.start, drive.reset_fault):
        with pytest.raises(WriteForbidden, match=rf"multidrop check {name}` .*confirmed = 1"):
            call()
    assert bus.frames == []
    drive.stop()  # which is sent all the same
    assert bus.written


@every_profile_family
def test_identification_registers_are_not_polled(name: str) -> None:
    polled = {register.name for register in shipped_family(name).readings()}
    assert "status" in polled
    assert not polled & {"station", "signature"}


@pytest.mark.slow
@every_profile_family
def test_a_motor_is_commanded_through_the_engine(name: str) -> None:
    drive: Any = shipped(name, 1)
    sim = simulated(shipped(name, 1))
    assert isinstance(sim, MotorDrive)
    sim.motor.acceleration_time = sim.motor.deceleration_time = 0.2
    with Simulator([Wire([sim], unpaced=True)]) as line, Bus(line.wires[0].path) as bus:
        bus.attach(drive)
        assert drive.state().condition is Condition.STOPPED
        drive.set_frequency(25)
        drive.start()
        assert sim.motor.energised
        values = drive.read_many(drive.readings())
        assert set(values) == {register.name for register in drive.readings()}
        drive.stop()
        assert drive.state().condition is Condition.STOPPED
    assert not sim.motor.energised


def test_a_plant_file_names_them(tmp_path: Path) -> None:
    plant = tmp_path / "plant.toml"
    plant.write_text(
        '[[line]]\nname = "hall"\nport = "hall"\n'
        + "".join(
            f'[[line.drive]]\nname = "d{address}"\nmodel = "{name}"\naddress = {address}\nbaudrate = 9600\n'
            f'format = "{"8N1" if "8N1" in next(iter(shipped_family(name).formats.values())) else "8N2"}"\n'
            f"{'confirmed = 1' if name in SHIPPED_AS else ''}\n"
            for address, name in enumerate(SHIPPED, 1)
        )
    )
    (line,) = Plant.load(plant).lines
    assert [type(polled.drive).model for polled in line.drives] == list(SHIPPED)


def test_the_command_line_lists_and_checks_them(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["models"]) == 0
    listed = capsys.readouterr().out
    assert all(f"\n{name} " in listed for name in (*MODELS, *SHIPPED)[1:])
    for name in SHIPPED:
        assert main(["check", name]) == 0
        assert ("is untested" in capsys.readouterr().out) is (name in SHIPPED_AS)


@pytest.mark.long
def test_shipped_files_are_loaded_on_demand() -> None:
    code = (
        "import sys, multidrop.families.registry as registry; "
        "from multidrop.families.files import loader; "
        "print(len(registry.SHIPPED), loader._loaded, 'multidrop.families.profiles' in sys.modules)"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.split() == [str(len(SHIPPED)), "{}", "False"]


# ---- profiles in files of one's own ----


def load(tmp_path: Path, text: str) -> type[Drive]:
    file = tmp_path / "own.toml"
    file.write_text(text)
    return find_model(str(file))


HEAD = '[family]\ntitle = "Own"\nmanual = "Own manual"\ncounts_from = 0\n'


def test_a_file_may_name_any_profile(tmp_path: Path) -> None:
    roles = (
        "[command]\ncontrol = { at = 1 }\nreset = { at = 2 }\n[setting]\nreference = { at = 3, unit = "
        '"Hz", step = 0.1, span = [0, 50] }\n[reading]\nstatus = { at = 4 }\nfault = { at = 5 }\n'
        'output_frequency = { at = 6, unit = "Hz", step = 0.1 }\n'
    )
    for name, profile in PROFILES.items():
        assert issubclass(load(tmp_path, f'{HEAD}profile = "{name}"\n{roles}'), profile)


def test_all_mistakes_of_a_file_with_a_profile_are_reported_at_once(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"own\.toml") as wrong:
        load(
            tmp_path,
            f'{HEAD}profile = "delta"\nformats = ["7N1"]\n'
            "[command]\ncontrol = { at = 1, harmless = [2] }\n"
            "[reading]\nstatus = { at = 4, step = 0.5 }\n"
            "[verb.stop]\nsteps = []\n",
        )
    told = str(wrong.value)
    for sentence in (
        "formats",
        "[verb] says what the profile says already",
        "control: harmless is what the profile itself says",
        "status: it is one word of bits",
        "reference: this profile needs a register of this name",
        "reset: this profile needs",
    ):
        assert sentence in told or sentence.partition(": ")[2] in told, sentence


def test_a_profile_that_is_not_known(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"profile = 'profdrive' is not known; did you mean profidrive\?"):
        load(tmp_path, f'{HEAD}profile = "profdrive"\n[reading]\nspeed = {{ at = 1 }}\n')


def test_registers_are_read_in_blocks_if_the_manual_allows_it() -> None:
    assert shipped_family("delta-vfd-el").most_registers
    assert {register.access for register in shipped_family("abb-acs355").readings()} == {Access.READING}


# ---- families of other packages ----


def installed(monkeypatch: pytest.MonkeyPatch, **values: str) -> None:
    """Pretend that these entry points are installed, as name="module:attribute"; "name__" repeats a name."""
    points = [EntryPoint(name.rstrip("_"), value, GROUP) for name, value in values.items()]
    monkeypatch.setattr(
        importlib.metadata, "entry_points", lambda **wanted: EntryPoints(points).select(**wanted)
    )


def test_a_family_of_a_package_is_found_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    installed(monkeypatch, toy="toy:Toy", broken="no_such_module:Drive")
    assert find_model("toy").__name__ == "Toy"


def test_a_built_in_family_goes_before_an_installed_one(monkeypatch: pytest.MonkeyPatch) -> None:
    installed(monkeypatch, yd1000="toy:Toy")
    assert find_model("yd1000") is YD1000


def test_models_lists_installed_families_and_warns_of_broken_ones(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    installed(monkeypatch, toy="toy:Toy", broken="no_such_module:Drive", yd1000="toy:Toy")
    assert main(["models"]) == 0
    out, err = capsys.readouterr()
    assert [line.partition(" ")[0] for line in out.splitlines()].count("toy") == 1
    assert err.count("\n") == 1
    assert "model 'broken' of package" in err


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        (
            {"acme": "toy:Toy", "acme__": "toy:Quick"},
            r"model 'acme' is in several packages, toy:Toy and toy:Quick: uninstall all but one",
        ),
        (
            {"acme": "no_such_module:Drive"},
            r"model 'acme' of package .* cannot be loaded: ModuleNotFoundError: No module named",
        ),
        ({"acme": "toy:missing"}, r"model 'acme' of package .* cannot be loaded: AttributeError"),
        ({"acme": "toy:__doc__"}, r"model 'acme' of package .* is not a subclass of multidrop.Drive"),
        (
            {"acme": "toy:Toy"},
            r"model 'acme' of package .* has model = 'toy': name its entry point so",
        ),
        ({"acmes": "toy:Toy"}, r"there is no model 'acme'; did you mean acmes"),
    ],
)
def test_a_package_that_cannot_be_used_is_one_sentence(
    monkeypatch: pytest.MonkeyPatch, values: dict[str, str], sentence: str
) -> None:
    installed(monkeypatch, **values)
    with pytest.raises(ValueError, match=sentence):
        find_model("acme")
