"""Files with verbs from the plant file to the simulated motor: loaded, checked, started, stopped."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from commands import Run
from declared_families import FAMILIES, NAMES, class_of, document_of
from lines import ANY_PORT
from simulated_bus import is_write, one
from tables import table

from multidrop import Bus, Condition, Direction, FamilyError, Refused, load_family, load_plant
from multidrop.errors import NotDone, Unconfirmed
from multidrop.sim import Simulator, Wire, simulated
from multidrop.sim.declared import SimulatedDeclared

PLANT = """\
[[line]]
name = "hall"
port = "hall"

[[line.drive]]
name = "pump-1"
model = "abb.toml"
address = 3
baudrate = 38400
reference_maximum = 50
confirmed = 1

[[line.drive]]
name = "pump-2"
model = "abb.toml"
address = 4
baudrate = 38400
reference_maximum = 50
"""
TARGET = ("abb.toml", 3, "--baudrate", 38400, "--option", "reference_maximum=50")
CONFIRMED = (*TARGET, "--option", "confirmed=1", "--yes")


@pytest.fixture
def plant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    shutil.copy(FAMILIES / "abb.toml", tmp_path)
    path = tmp_path / "plant.toml"
    path.write_text(PLANT)
    monkeypatch.chdir(tmp_path)
    return path


def sims_of(plant: Path) -> list[Any]:
    sims = [simulated(polled.drive) for polled in load_plant(plant).lines[0].drives]
    for sim in sims:
        assert isinstance(sim, SimulatedDeclared)
        sim.motor.acceleration_time = sim.motor.deceleration_time = 0.5
    return sims


@table("name", NAMES)
def test_a_file_is_the_class_that_these_tests_make(name: str) -> None:
    """So what is tested of the one holds for the other."""
    loaded, made = load_family(FAMILIES / f"{name}.toml"), class_of(document_of(name))
    assert vars(loaded)["declared_verbs"] == vars(made)["declared_verbs"]
    for register in made.registers.values():
        same = loaded.register(register.name)
        for fact in ("address", "access", "harmless", "broadcast", "table", "number_format", "span", "step"):
            assert getattr(same, fact) == getattr(register, fact), (register.name, fact)


@pytest.mark.slow
def test_a_plant_s_motor_is_started_and_stopped(plant: Path) -> None:
    lines, sims = load_plant(plant).lines, sims_of(plant)
    wire = Wire(sims, port=ANY_PORT, unpaced=True)
    with Simulator([wire]), Bus(wire.path, expiry=30) as bus:
        first, second = (bus.attach(polled.drive) for polled in lines[0].drives)
        first.set_frequency(20)
        first.start()
        assert sims[0].motor.energised
        assert first.state().condition is Condition.RUNNING
        with pytest.raises(Refused, match="confirmed = 1"):
            second.set_frequency(20)
        assert not sims[1].motor.energised
        sims[0].trip(1)
        with pytest.raises((Refused, NotDone), match="overcurrent"):
            first.start()
        first.reset_fault()
        first.start()
        first.stop()
        assert not sims[0].motor.energised
        assert {stopped.seen.value for stopped in bus.stop_all().values()} == {"stopped"}


@pytest.mark.slow
@pytest.mark.usefixtures("_patient")
def test_a_motor_is_commanded_from_the_command_line(run: Run, plant: Path) -> None:
    sims = sims_of(plant)
    with Simulator([Wire(sims, port=str(plant.parent / "hall"), unpaced=True)]):
        code, _, said = run("start", "hall", *TARGET, "--frequency", 20, "--yes")
        assert code != 0
        assert "confirmed=1" in said
        assert not sims[0].motor.energised
        code, said, _ = run("start", "hall", *CONFIRMED, "--frequency", 20, "--json")
        assert code == 0, said
        assert json.loads(said)["state"]["condition"] == "running"
        assert sims[0].motor.energised
        code, said, _ = run("stop", "hall", *TARGET, "--json")
        assert code == 0
        assert json.loads(said)["state"]["condition"] == "stopped"
        assert not sims[0].motor.energised


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("harmless = [0x0476, 0x0474]", "harmless = [0x0476, 0x0474, 0x047F]", "047FH"),
        (
            '{ insist = "control", value = 0x0474 }',
            '{ write = "control", value = 0x0474 }',
            "keep a stop back",
        ),
        ("[identify]", "[unidentified]", "identify"),
        (
            "reference_maximum = {",
            'confirmed = { unit = "", span = [1, 1], meaning = "" }\nx = {',
            "confirmed",
        ),
        ('limit = "60 s"', 'limit = "60 d"', "is not a duration"),
    ],
)
def test_a_dangerous_file_is_not_loaded(tmp_path: Path, old: str, new: str, said: str) -> None:
    text = (FAMILIES / "abb.toml").read_text()
    assert old in text
    path = tmp_path / "abb.toml"
    path.write_text(text.replace(old, new))
    with pytest.raises(FamilyError) as wrong:
        load_family(path)
    assert [mistake for mistake in wrong.value.mistakes if said in mistake], wrong.value.mistakes


def test_looks_are_at_parts_of_a_word(monkeypatch: pytest.MonkeyPatch) -> None:
    """A status word in parts, a swapped control word that is written by 10H, a frequency with an offset."""
    family = load_family(FAMILIES / "parts.toml")
    line, drive, sim = one(monkeypatch, family(1, confirmed=1))
    sim.motor.acceleration_time = sim.motor.deceleration_time = 1.0
    drive.set_frequency(20)
    drive.start(Direction.REVERSE)
    line.sleep(3)
    assert drive.state().condition is Condition.RUNNING
    assert line.bus.read(drive, drive.output_frequency) == 20
    with pytest.raises(Refused, match="it runs"):
        drive.reset_fault()
    drive.stop()
    assert not sim.motor.energised
    sim.trip(1)
    with pytest.raises(Refused, match="fault"):
        drive.start()
    drive.reset_fault()
    assert drive.state().condition is Condition.STOPPED
    assert [frame[9:11] + frame[20:26] for frame in line.written] == [
        *("21 07 D0", "20 07 00"),
        *("20 01 00", "20 09 00", "20 01 00"),
    ]


def test_a_frequency_that_says_nothing_is_no_standstill(monkeypatch: pytest.MonkeyPatch) -> None:
    family = load_family(FAMILIES / "parts.toml")
    line, drive, sim = one(monkeypatch, family(1, confirmed=1))
    sim["output_frequency"] = None
    with pytest.raises(Unconfirmed):
        drive.stop(seconds=5)
    assert len(line.written) > 1  # it was repeated


STEPS = """[verb.stop]
steps = [
    { insist = "control", value = "stop" },
    { insist = "control", value = "jog_stop" },
    { insist = "control", value = "coast", when = "turns" },
    { insist = "control", value = "coast" },
    { await = "stands", limit = "60 s" },
]
"""


@pytest.mark.parametrize("lost", ["stop", "all"])
def test_what_follows_a_stop_at_once_is_sent_though_nobody_confirms_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, lost: str
) -> None:
    """The drive may hear, and heed another word alone; what hangs on a look is not sent unseen."""
    text = (FAMILIES / "enum.toml").read_text(encoding="utf-8")
    begin, end = text.index("[verb.stop]"), text.index("[verb.coast]")
    (tmp_path / "own.toml").write_text(text[:begin] + STEPS + "\n" + text[end:], encoding="utf-8")
    family = load_family(tmp_path / "own.toml")
    line, drive, _ = one(monkeypatch, family(1, confirmed=1))
    line.bus.check_identity(drive)
    begun = len(line.written)
    line.loses = lambda request: lost == "all" or request.data[-1:] == b"\5"
    with pytest.raises(Unconfirmed, match="control = stop took effect"):
        drive.stop(seconds=5)
    words = [request.data[-1] for request, _ in line.frames if is_write(request)][begun:]
    assert words[:8] == [5, 5, 5, 8, 5, 5, 5, 8]
