"""Use families from files: simulate, find, poll, record, decode and command drives of such a family."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from commands import Run
from lines import ANY_PORT
from peers import require_module
from profile_families import Meter, write_meter
from simulated_bus import SimulatedBus
from tables import table

from multidrop import Bus, Drive, Plant, WriteForbidden, load_family
from multidrop.control.eeprom_ledger import Ledger
from multidrop.families.registry import find_model
from multidrop.planning.blocks import blocks
from multidrop.recording import open_recording
from multidrop.sim import Simulator, Wire, simulated

pytestmark = pytest.mark.usefixtures("_turns_awaited")

PUMP = """\
[family]
title = "Pump P-2"
manual = "P-2, section 4"
counts_from = 0
registers = ["pump.csv"]
[setting]
ramp = { at = 0x0021, unit = "s", kept = "eeprom", span = [0, 10] }
[command]
run = { at = 0x0030, values = { off = 0, on = 1 }, harmless = [0] }
light = { at = 0x0031, moves = false }
"""
PUMP_CSV = "name;at;unit;step\nspeed;0x0010;rpm;1\npressure;0x0011;bar;0.01\n"
PLANT = """\
[[line]]
name = "hall"
port = "hall"

[[line.drive]]
name = "meter-1"
model = "families/meter.toml"
address = 1
baudrate = 9600
format = "8N1"

[[line.drive]]
name = "pump-2"
model = "families/pump.toml"
address = 2
confirmed = 1
"""


@pytest.fixture
def plant(tmp_path: Path) -> Path:
    families = tmp_path / "families"
    families.mkdir()
    write_meter(families)
    (families / "pump.toml").write_text(PUMP)
    (families / "pump.csv").write_text(PUMP_CSV)
    path = tmp_path / "plant.toml"
    path.write_text(PLANT)
    return path


@pytest.fixture
def pump(plant: Path) -> type[Drive]:
    return load_family(plant.parent / "families" / "pump.toml")


def test_model_path_in_a_plant_file_is_relative_to_the_plant_file(plant: Path, pump: type[Drive]) -> None:
    drives = [polled.drive for polled in Plant.load(plant).lines[0].drives]
    assert type(drives[1]) is pump
    assert find_model("families/pump.toml", plant.parent) is pump
    assert [drive.model for drive in drives] == ["meter.toml", "pump.toml"]


def test_family_file_gives_the_same_poll_plan_as_the_equivalent_class(plant: Path) -> None:
    """A family from a file causes the same requests as the equivalent class."""
    loaded = load_family(plant.parent / "families" / "meter.toml")(3)
    written = Meter(3)

    def planned(drive: Drive) -> list[object]:
        return [
            (block.request, [(one.name, block.offset(one), one.number_format) for one in block.registers])
            for block in blocks(drive, drive.readings())
        ]

    assert planned(loaded) == planned(written)
    assert len(planned(loaded)) < len(written.readings())


def test_family_file_gives_the_same_values_as_the_equivalent_class(plant: Path) -> None:
    loaded, written = load_family(plant.parent / "families" / "meter.toml"), Meter
    found = []
    for family in (loaded, written):
        drive = simulated(family(1))
        for name, value in (("voltage", 230.5), ("power", -12.3), ("energy", 123456), ("alarms", 9)):
            drive[name] = value
        with Simulator([Wire([drive], port=ANY_PORT, unpaced=True)]) as line, Bus(line.wires[0].path) as bus:
            meter = bus.attach(family, address=1)
            found.append({each.name: float(meter.read(each)) for each in meter.readings()})
    assert found[0] == found[1]
    assert (found[0]["voltage"], found[0]["power"], found[0]["energy"]) == (230.5, -12.3, 123456)


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.usefixtures("_unpainted")
def test_drives_of_two_family_files_can_be_scanned_and_polled(
    run: Run, plant: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(plant.parent)
    lines = Plant.load(plant).lines
    drives = [simulated(polled.drive) for polled in lines[0].drives]
    drives[0]["voltage"], drives[1]["pressure"] = 230.5, 1.25
    with Simulator([Wire(drives, port=str(plant.parent / "hall"), unpaced=True)]):
        assert run("plan", plant)[0] == 0
        assert (
            run("poll", plant, "--seconds", "0.5", "--out", "run.arrows", "--capture", "run.pcapng")[0] == 0
        )
        found = json.loads(run("scan", "hall", "--model", "families/pump.toml", "--addresses", "1-2",
                               "--baudrates", "9600", "--formats", "8N1", "--json",
                               "--out", "found.toml")[1])  # fmt: skip
    assert [(each["address"], each["models"]) for each in found["drives"] if each["models"]] == [
        (2, ["pump.toml"])
    ]
    (scanned,) = Plant.load("found.toml").lines[0].drives
    assert type(scanned.drive) is find_model("families/pump.toml")
    reader = open_recording("run.arrows")
    assert reader.metadata["drives"]["meter-1"]["model"] == "meter.toml"
    values = {(row.drive, row.register): row.value for batch in reader for row in batch}
    assert values["meter-1", "voltage"] == 230.5
    assert values["pump-2", "pressure"] == 1.25
    assert run("convert", "run.arrows", "run.csv")[0] == 0
    assert run("decode", "run.pcapng", "--plant", plant, "--out", "decoded.arrows")[0] == 0
    decoded = {
        (row.drive, row.register): row.value for batch in open_recording("decoded.arrows") for row in batch
    }
    assert decoded["meter-1", "voltage"] == 230.5
    require_module("matplotlib")
    assert run("plot", "run.arrows", "--register", "voltage")[0] == 0
    assert run("report", "run.arrows")[0] == 0


@pytest.mark.parametrize(("name", "value"), [("light", "1"), ("ramp", "1"), ("run", "off")])
def test_an_unconfirmed_family_file_allows_no_writes(pump: type[Drive], name: str, value: str) -> None:
    """Without a stop verb, even the declared harmless raw counts are not sent, because they are untested."""
    wire = Wire([simulated(pump(2))], port=ANY_PORT, unpaced=True)
    with Simulator([wire]) as line, Bus(wire.path) as bus:
        drive = bus.attach(pump, address=2)
        with pytest.raises(WriteForbidden, match=r"`multidrop check pump\.toml`") as refused:
            drive.write(drive.register(name), drive.register(name).parse(value))
        assert refused.value.rule == "the drive is not confirmed"
        assert simulated_writes(line) == []


def test_no_broadcast_is_sent_for_an_unconfirmed_family_file(tmp_path: Path) -> None:
    """`stop_all` does not send the file's broadcasts, because they are untested."""
    path = tmp_path / "fan.toml"
    head = '[family]\ntitle = "Fan"\nmanual = "M"\ncounts_from = 0\n[reading]\nspeed = { at = 1 }\n'
    path.write_text(head + "[command]\ncontrol = { at = 0, broadcast = [0x047F] }\n")
    fan = load_family(path)
    line = SimulatedBus(simulated(fan(1)), simulated(fan(2)))
    first, second = line.attach(fan(1)), line.attach(fan(2))
    with pytest.raises(WriteForbidden, match="declare confirmed = 1"):
        line.bus.broadcast(first.control, 0x047F)
    for drive in (first, second):
        line.bus.check_identity(drive)
    line.bus.stop_all(seconds=1)
    assert line.written == []


def test_a_family_file_allows_writes_with_the_option_confirmed(pump: type[Drive]) -> None:
    wire = Wire([simulated(pump(2))], port=ANY_PORT, unpaced=True)
    with Simulator([wire]) as line, Bus(wire.path) as bus:
        drive = bus.attach(pump, address=2, confirmed=1)
        assert drive.write(drive.register("ramp"), 5.0) == 5.0
        with pytest.raises(WriteForbidden, match="on commands the motor"):
            drive.write(drive.register("run"), drive.register("run").parse("on"))
        drive.write(drive.register("run"), drive.register("run").parse("off"))
        assert simulated_writes(line) == ["ramp", "run"]


def test_family_file_without_commands_needs_no_confirmation(plant: Path) -> None:
    family = load_family(plant.parent / "families" / "meter.toml")
    assert "confirmed" not in family.options


@table(
    ("proof", "value", "is_one"),
    [
        ("is = [250, 300]", 300, True),
        ("is = [250, 300]", 301, False),
        ("above = 5", 6, True),
        ("above = 5", 5, False),
        ("above = 5\nbelow = 7", 7, False),
    ],
)
def test_the_section_identify_of_a_family_file_recognises_drives(
    tmp_path: Path, proof: str, value: int, is_one: bool
) -> None:
    path = tmp_path / "meter.toml"
    head = '[family]\ntitle = "Meter"\nmanual = "M"\ncounts_from = 0\n[reading]\ndevice = { at = 3 }\n'
    path.write_text(f'{head}[[identify]]\nregister = "device"\n{proof}\n')
    drive = load_family(path)(1)
    line = SimulatedBus(sim := simulated(drive))
    line.bus.attach(drive)
    sim["device"] = value
    if is_one:
        drive.perform(drive.identify.script())
        return
    with pytest.raises(WriteForbidden, match=f"shows device = {value}, so it is not a Meter"):
        drive.perform(drive.identify.script())


def test_eeprom_writes_of_two_family_files_with_one_name_are_counted_separately(plant: Path) -> None:
    """The ledger counts EEPROM writes separately for two devices whose family files have the same name."""
    other = plant.parent / "other"
    other.mkdir()
    for name, text in (("pump.toml", PUMP.replace("P-2", "P-9")), ("pump.csv", PUMP_CSV)):
        (other / name).write_text(text)
    ledger = Ledger(plant.parent / "wear.sqlite")
    both = [load_family(folder / "pump.toml") for folder in (plant.parent / "families", other)]
    for family in both:
        with (
            Simulator([Wire([simulated(family(2))], port=ANY_PORT, unpaced=True)]) as line,
            Bus(line.wires[0].path, ledger=ledger) as bus,
        ):
            drive = bus.attach(family, address=2, confirmed=1)
            drive.write(drive.register("ramp"), 5.0)
    assert sorted(wear.cell.model for wear in ledger.wear(0)) == [
        "pump.toml: Pump P-2",
        "pump.toml: Pump P-9",
    ]


def simulated_writes(line: Simulator) -> list[str]:
    return [written.name for drive in line.wires[0].drives for written in drive.counters.writes]
