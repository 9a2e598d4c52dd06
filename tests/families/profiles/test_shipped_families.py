"""Families from files of this package: their register tables, typed from the manuals, and their use."""

from __future__ import annotations

import importlib.metadata
import re
import subprocess
import sys
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from typing import Any

import pytest
from profile_families import COMMANDED, EXTENDED, OF_PROFILE, READ_ONLY
from scripts import rows, typed
from simulated_bus import SimulatedBus, one
from tables import table

from multidrop import Plant
from multidrop.cli import main
from multidrop.drive import Drive
from multidrop.drive.register import Access, Register
from multidrop.errors import Unsupported, WriteForbidden
from multidrop.families import MODELS, YD1000
from multidrop.families.profiles import PROFILES, Profile
from multidrop.families.registry import GROUP, SHIPPED, find_model, shipped_family
from multidrop.sim import simulated

every_family = table("name", SHIPPED)
every_profile_family = table("name", OF_PROFILE)
every_commanded_family = table("name", COMMANDED)

# Short names of each family's manuals and public programs. The `place` of each register starts with one.
EDITIONS = {
    "abb-acs355": ("ACS355", "ACS550-02/U2", "ACS550-01", "ACS550 p. 209"),
    "danfoss-fc51": ("FC 51", "FC 101", "FC 202", "MG02A4", "MG02C6"),
    "delta-vfd-el": ("VFD-EL", "VFD-EL-W", "CP2000"),
    "delta-cp2000": ("CP2000", "C2000 Plus", "energy-management"),
    "erman-er-g-220-03": ("2026",),
    "erman-er-g-220-05": ("erman.py",),
    "erman-er-g-220-02": ("wb-community",),
    "innovert-idd-mini-plus": ("stand_drive.py",),
    "delta-ms300": ("MS300",),
    "optidrive-e3": ("ODE-3", "E3 advanced technical manual"),
    "invt-goodrive": ("Goodrive200A", "Goodrive10", "Goodrive350", "GD100-PV"),
    "invt-chf100a": ("CHF100A", "CHE100", "energy-management"),
    "fuling-dzb": ("modbus.c", "manual, sheet 5"),
    "delixi-e": ("DelixiProtocol.h", "DelixiCDIE100.cpp", "vfd_controller.c"),
    "powtran-pi130": ("PI130", "PI500", "MD500", "H300"),
    "yaskawa-a1000": ("A1000", "energy-management"),
    "yaskawa-v1000": ("A1000", "energy-management"),
    "schneider-atv320": ("ATV312.yaml",),
    "siemens-v20": ("V20", "S120"),
}
PAGE_OR_FILE = re.compile(
    r"\bp\. (A-)?\d|sheet \d|\.(py|h|c|cpp|yaml)\b|wb-community|energy-management|H300|GD100-PV"
)

# Columns: function codes, address on the wire, name, step, unit.
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
    "erman-er-g-220-03": """
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
    "delta-cp2000": """
03/06 2000 control              - DeltaControl
03/06 2001 reference            0.01 Hz
03/06 2002 reset                - DeltaReset
03/06 2100 fault                1
03/06 2101 status               - DeltaStatus
03/06 2102 reference_in_force   0.01 Hz
03/06 2103 output_frequency     0.01 Hz
03/06 210B output_torque        0.1 %
03/06 2200 output_current       0.01 A
03/06 2201 counter              1
03/06 2202 display_frequency    0.01 Hz
03/06 2203 dc_bus_voltage       0.1 V
03/06 2204 output_voltage       0.1 V
03/06 220E heatsink_temperature 0.1 °C
03/06 0900 station              1
""",
    "invt-goodrive": """
03/06 2000 control             - InvtControl
03/06 2001 reference           0.01 Hz
03/06 2100 status              - InvtStatus
03/06 2101 status_2            1
03/06 2102 fault               - Fault
03/06 2103 device              1
03/06 3000 output_frequency    0.01 Hz
03/06 3001 reference_frequency 0.01 Hz
03/06 3002 dc_bus_voltage      0.1 V
03/06 3003 output_voltage      1 V
03/06 3004 output_current      0.1 A
03/06 3005 motor_speed         1 rpm
03/06 3006 output_power        0.1 %
03/06 3007 output_torque       0.1 %
03/06 300A inputs              1
03/06 300B outputs             1
03/06 300C analog_input_1      0.01 V
03/06 300D analog_input_2      0.01 V
03/06 0001 run_source          - RunSource
""",
    "invt-chf100a": """
03/06 1000 control             - InvtControl
03/06 1001 status              - InvtStatus
03/06 2000 reference           0.01 %
03/06 3000 output_frequency    0.01 Hz
03/06 3001 reference_frequency 0.01 Hz
03/06 3002 dc_bus_voltage      0.1 V
03/06 3003 output_voltage      1 V
03/06 3004 output_current      0.1 A
03/06 3005 motor_speed         1 rpm
03/06 3006 output_power        0.01 kW
03/06 3007 output_torque       0.1 %
03/06 3016 device              1
03/06 5000 fault               - Fault
""",
    "fuling-dzb": """
03/06 1000 control             - InvtControl
03/06 1001 status              - InvtStatus
03/06 2000 reference           0.01 %
03/06 3000 reference_frequency 0.1 Hz
03/06 3001 output_frequency    0.1 Hz
03/06 3002 output_current      ? A
03/06 3003 output_voltage      ? V
03/06 3004 motor_speed         ? rpm
03/06 3005 output_power        ?
03/06 3006 output_torque       ?
03/06 3007 dc_bus_voltage      ? V
03/06 300A inputs              1
03/06 300B outputs             1
03/06 5000 fault               1
03/06 5001 communication_fault 1
""",
    "delixi-e": """
03/06 A000 control             - control
03/06 A001 reference           0.01 %
03/06 B000 status              - InovanceStatus
03/06 B001 fault               - Fault
03/06 9000 output_frequency    0.01 Hz
03/06 9001 reference_frequency 0.01 Hz
03/06 9002 output_current      0.01 A
03/06 9003 output_voltage      1 V
03/06 9004 dc_bus_voltage      0.1 V
03/06 901B reference_by_line   0.01 %
03/06 0007 highest_frequency   0.01 Hz
03/06 000B acceleration_time   0.1 s
03/06 000C deceleration_time   0.1 s
03/06 4102 station             1
03/06 0003 run_source          - RunSource
""",
    "powtran-pi130": """
03/06 2000 control             - InovanceControl
03/06 1000 reference           0.01 %
03/06 3000 status              - InovanceStatus
03/06 8000 fault               - Fault
03/06 1001 output_frequency    0.01 Hz
03/06 1002 dc_bus_voltage      ? V
03/06 1003 output_voltage      ? V
03/06 1004 output_current      ? A
03/06 1005 output_power        ?
03/06 1006 output_torque       ?
03/06 1007 motor_speed         ? rpm
03/06 1008 inputs              1
03/06 1009 outputs             1
""",
    "yaskawa-a1000": """
03/10 0001 control            - YaskawaControl
03/10 0002 reference          0.01 Hz
03/10 0023 reference_in_force 0.01 Hz
03/10 0024 output_frequency   0.01 Hz
03/10 0025 output_voltage     0.1 V
03/10 0026 output_current     0.1 A
03/10 0027 output_power       0.01 kW
03/10 0034 signature          - Signature
03/10 0046 dc_bus_voltage     1 V
03/10 004B status             - YaskawaStatus
03/10 0080 fault              1
""",
    "schneider-atv320": """
03/06 2135 control             - CiA402Control
03/06 2136 reference           0.1 Hz
03/06 0C81 status              - CiA402Status
03/06 0C82 output_frequency    0.1 Hz
03/06 0C83 reference_frequency 0.1 Hz
03/06 0C84 output_current      0.1 A
03/06 0C85 output_torque       1 %
03/06 0C87 mains_voltage       0.1 V
03/06 0C89 thermal_state       1 %
03/06 0C8B output_power        1 %
03/06 1BD1 fault               - Fault
""",
    "siemens-v20": """
03/06 0063 control           - ProfidriveControl
03/06 0064 reference         0.006103515625 %
03/06 006D status            - ProfidriveStatus
03/06 006E main_actual_value 0.006103515625 %
03/06 000F base_frequency    0.01 Hz
03/06 0017 output_frequency  0.01 Hz
03/06 0018 motor_speed       1 rpm
03/06 0019 output_current    0.01 A
03/06 001A motor_torque      0.01 Nm
03/06 001B output_power      0.01 kW
03/06 001C energy            1 kWh
03/06 001D dc_bus_voltage    1 V
""",
    "erman-er-g-220-05": """
04/00 07D0 output_frequency 0.1 Hz
04/00 07D1 output_current   0.1 A
04/00 07D2 input_voltage    1 V
04/00 07D3 temperature      1 °C
04/00 07D4 state_word       - StateWord
04/00 07D5 fault            - Fault
04/00 07D6 pressure         0.01 atm
04/00 07D7 software_version 1
04/00 07D8 analog_input_1   1 %
04/00 07D9 analog_input_2   1 %
03/06 044C operating_mode     - OperatingMode
03/06 045D start_method       - StartMethod
03/06 045E output_y1_function - OutputY1Function
03/06 0460 output_y2_function - OutputY2Function
03/06 0465 power_on_state     - PowerOnState
03/06 03E9 pressure_setpoint        0.01 kgf/cm²
03/06 03EA proportional_coefficient 0.01
03/06 03EB integration_time         0.01 s
03/06 03EE pressure_sensor_limit    0.01 kgf/cm²
03/06 044D manual_frequency         0.1 Hz
03/06 044E upper_frequency          0.1 Hz
03/06 044F lower_frequency          0.1 Hz
03/06 0459 dry_run_pressure         0.01 kgf/cm²
03/06 045A dry_run_time             1 s
03/06 045B start_pressure_difference 0.01 kgf/cm²
""",
    # Only the registers that the built-in family does not have.
    "erman-er-g-220-02": """
03/06 0062 pressure_setpoint 0.01 bar
04/00 001A water_pressure    0.01 bar
""",
    "innovert-idd-mini-plus": """
03/06 0002 output_frequency 0.1 Hz
03/06 001B fault            1
03/06 001C run_state        - RunState
""",
}
TABLES["yaskawa-v1000"] = TABLES["yaskawa-a1000"].replace("03/10 0034 signature          - Signature\n", "")


def test_family_files_of_the_package_are_found_by_name() -> None:
    assert list(SHIPPED) == sorted(TABLES)
    assert {*SHIPPED} == {*COMMANDED, *READ_ONLY}
    assert not set(SHIPPED) & set(MODELS)
    assert all(find_model(name).model == name for name in SHIPPED)
    with pytest.raises(ValueError, match=r"no model 'abb-acs35'; did you mean abb-acs355\?"):
        find_model("abb-acs35")


@every_family
def test_registers_of_a_family_file_equal_the_table_of_the_manual(name: str) -> None:
    inherited = rows(MODELS[EXTENDED[name]]) if name in EXTENDED else set()
    assert rows(shipped_family(name)) - inherited == typed(TABLES[name])


def own_registers(name: str) -> list[Register[Any]]:
    family = shipped_family(name)
    inherited = MODELS[EXTENDED[name]].registers if name in EXTENDED else {}
    return [one for one in family.registers.values() if one.name not in inherited]


@every_family
def test_every_shipped_family_is_marked_as_not_tried_on_hardware(name: str) -> None:
    family = shipped_family(name)
    assert issubclass(family, Profile) is (name in OF_PROFILE)
    assert "not tried on hardware" in family.title
    assert "Not tried on hardware" in (family.__doc__ or "")
    assert family.line_parameters
    if name in OF_PROFILE:
        assert family.watchdog != Drive.watchdog
        assert family.remote != Drive.remote


@every_family
def test_every_shipped_register_names_a_page_of_a_manual(name: str) -> None:
    family = shipped_family(name)
    words = [edition.partition(" p. ")[0].partition(", sheet")[0] for edition in EDITIONS[name]]
    assert all(word in family.manual or word in "Schneider_ATV312.yaml" for word in words)
    for register in own_registers(name):
        assert PAGE_OR_FILE.search(register.place), (register.name, register.place)
        assert any(edition in register.place for edition in EDITIONS[name]), (register.name, register.place)


def test_the_family_erman_er_g_220_03_has_no_commands() -> None:
    family = shipped_family("erman-er-g-220-03")
    assert {register.access for register in family.registers.values()} == {Access.READING}
    assert "confirmed" not in family.options
    bus, drive, sim = (SimulatedBus(sim := simulated(family(63))), family(63), sim)
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


@every_commanded_family
def test_an_untested_family_sends_only_stops_before_confirmation(name: str) -> None:
    family = shipped_family(name)
    bus, drive, _ = one(family(1))
    for call in (lambda: drive.set_frequency(20), drive.start, drive.reset_fault):
        with pytest.raises(WriteForbidden, match=rf"multidrop check {name}` .*confirmed = 1"):
            call()
    assert bus.frames == []
    drive.stop()  # a stop is sent even without confirmation
    assert bus.written


@every_profile_family
def test_identity_registers_are_not_polled(name: str) -> None:
    polled = {register.name for register in shipped_family(name).readings()}
    assert "status" in polled
    assert not polled & {"station", "signature"}


def test_a_plant_file_can_use_families_of_the_package_by_name(tmp_path: Path) -> None:
    plant = tmp_path / "plant.toml"
    names = [name for name in SHIPPED if 9600 in shipped_family(name).baudrates]
    assert len(names) > len(SHIPPED) - 3
    plant.write_text(
        '[[line]]\nname = "hall"\nport = "hall"\n'
        + "".join(
            f'[[line.drive]]\nname = "d{address}"\nmodel = "{name}"\naddress = {address}\nbaudrate = 9600\n'
            f'format = "{"8N1" if "8N1" in next(iter(shipped_family(name).formats.values())) else "8N2"}"\n'
            f"{'confirmed = 1' if name in COMMANDED else ''}\n"
            for address, name in enumerate(names, 1)
        )
    )
    (line,) = Plant.load(plant).lines
    assert [type(polled.drive).model for polled in line.drives] == names


def test_command_line_lists_and_checks_families_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["models"]) == 0
    listed = capsys.readouterr().out
    assert all(f"\n{name} " in listed for name in (*MODELS, *SHIPPED)[1:])
    for name in SHIPPED:
        assert main(["check", name]) == 0
        assert ("is untested" in capsys.readouterr().out) is (name in COMMANDED)


@pytest.mark.long
def test_family_files_of_the_package_are_loaded_on_demand() -> None:
    code = (
        "import sys, multidrop.families.registry as registry; "
        "from multidrop.families.files import loader; "
        "print(len(registry.SHIPPED), loader._loaded, 'multidrop.families.profiles' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == [str(len(SHIPPED)), "{}", "False"]


def load(tmp_path: Path, text: str) -> type[Drive]:
    file = tmp_path / "own.toml"
    file.write_text(text)
    return find_model(str(file))


HEAD = '[family]\ntitle = "Own"\nmanual = "Own manual"\ncounts_from = 0\n'


def test_family_file_can_use_every_profile(tmp_path: Path) -> None:
    roles = (
        "[command]\ncontrol = { at = 1 }\nreset = { at = 2 }\n[setting]\nreference = { at = 3, unit = "
        '"Hz", step = 0.1, span = [0, 50] }\n[reading]\nstatus = { at = 4 }\nfault = { at = 5 }\n'
        'output_frequency = { at = 6, unit = "Hz", step = 0.1 }\n'
    )
    for name, profile in PROFILES.items():
        assert issubclass(load(tmp_path, f'{HEAD}profile = "{name}"\n{roles}'), profile)


def test_all_mistakes_of_a_family_file_with_a_profile_are_reported_together(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"own\.toml") as wrong:
        load(
            tmp_path,
            f'{HEAD}profile = "delta"\nformats = ["7N1"]\n'
            "[command]\ncontrol = { at = 1, harmless = [2] }\n"
            "[reading]\nstatus = { at = 4, step = 0.5 }\n"
            "[verb.stop]\nsteps = []\n",
        )
    message = str(wrong.value)
    for sentence in (
        'formats has "7N1", but an RTU frame needs 8 data bits',
        "[verb] is not supported; add profile to",
        "[command] control: harmless is set by the profile",
        "[reading] status: it is one word of bits",
        "reference: this profile needs a register of this name",
        "reset: this profile needs",
    ):
        assert sentence in message


def test_unknown_profile_in_a_family_file_is_reported(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"profile = 'profdrive' is not known; did you mean profidrive"):
        load(tmp_path, f'{HEAD}profile = "profdrive"\n[reading]\nspeed = {{ at = 1 }}\n')


def test_delta_vfd_el_limits_the_number_of_registers_per_read() -> None:
    assert shipped_family("delta-vfd-el").most_registers


def test_the_polled_registers_of_an_acs355_are_all_readings() -> None:
    assert {register.access for register in shipped_family("abb-acs355").readings()} == {Access.READING}


def installed(monkeypatch: pytest.MonkeyPatch, **values: str) -> None:
    """Fake installed entry points `name="module:attribute"`; `acme__` is a second `acme`."""
    points = [EntryPoint(name.rstrip("_"), value, GROUP) for name, value in values.items()]
    monkeypatch.setattr(
        importlib.metadata, "entry_points", lambda **wanted: EntryPoints(points).select(**wanted)
    )


def test_family_of_an_installed_package_is_found_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    installed(monkeypatch, toy="toy:Toy", broken="no_such_module:Drive")
    assert find_model("toy").__name__ == "Toy"


def test_built_in_family_takes_precedence_over_an_installed_one(monkeypatch: pytest.MonkeyPatch) -> None:
    installed(monkeypatch, yd1000="toy:Toy")
    assert find_model("yd1000") is YD1000


def test_models_command_lists_installed_families_and_warns_of_broken_ones(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    installed(monkeypatch, toy="toy:Toy", broken="no_such_module:Drive", yd1000="toy:Toy")
    assert main(["models"]) == 0
    out, err = capsys.readouterr()
    assert [line.partition(" ")[0] for line in out.splitlines()].count("toy") == 1
    assert err.count("\n") == 1
    assert "model 'broken' of package" in err


@table(
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
            r"model 'acme' of package .* has model = 'toy': rename its entry point to 'toy'",
        ),
        ({"acmes": "toy:Toy"}, r"there is no model 'acme'; did you mean acmes"),
    ],
)
def test_unusable_family_package_raises_a_one_sentence_error(
    monkeypatch: pytest.MonkeyPatch, values: dict[str, str], sentence: str
) -> None:
    installed(monkeypatch, **values)
    with pytest.raises(ValueError, match=sentence):
        find_model("acme")


# A row of the log gateway/vfd_log.csv in pjbardolia/energy-management, with the values on the drive's keypad.
CHF100A_LOG = {
    "output_frequency": (3137, 31.37),
    "dc_bus_voltage": (5564, 556.4),
    "output_voltage": (293, 293),
    "output_current": (70, 7.0),
    "motor_speed": (1882, 1882),
    "output_power": (262, 2.62),
    "output_torque": (198, 19.8),
}


def test_chf100a_registers_decode_to_the_values_on_the_keypad() -> None:
    family = shipped_family("invt-chf100a")
    registers = family.registers
    assert {name: registers[name].decode(raw) for name, (raw, _) in CHF100A_LOG.items()} == {
        name: value for name, (_, value) in CHF100A_LOG.items()
    }
    assert [registers[name].address for name in CHF100A_LOG] == [0x3000, *range(0x3002, 0x3008)]
    assert pytest.approx(1882, abs=0.5) == 60 * 31.37
