"""Commands that are given a plant file and a name instead of PORT, MODEL and ADDRESS."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from commands import TOY, Run
from own_drives import Fan
from tables import table
from toy import Status, Toy

from multidrop.bus import Bus
from multidrop.cli import monitor, verbs
from multidrop.drive import Drive
from multidrop.families import InvtCHE
from multidrop.families.registry import find_model
from multidrop.plant.model import Plant
from multidrop.sim import simulated
from multidrop.sim.drive import SimulatedDrive
from multidrop.sim.simulator import Simulator
from multidrop.sim.wire import Wire

pytestmark = pytest.mark.usefixtures("_turns_awaited")

FAN = f"{Path(__file__).parents[1]}/support/drives/own_drives.py:Fan"
find_model(FAN)  # load the file now, so that its log entry does not appear during a test
LINE = '[[line]]\nname = "{}"\nport = "{}"\n'
DRIVE = '[[line.drive]]\nname = "{}"\nmodel = "{}"\naddress = {}\n'
READINGS = ("output_current", "output_frequency")


@pytest.fixture
def toy() -> SimulatedDrive:
    return simulated(Toy(1))


@pytest.fixture
def port(toy: SimulatedDrive) -> Iterator[str]:
    toy["output_frequency"] = 49.9
    toy["output_current"] = 3.25
    with Simulator([Wire([toy, simulated(Fan(3)), simulated(Toy(4))], unpaced=True)]) as simulator:
        yield simulator.wires[0].path


@pytest.fixture
def plant(tmp_path: Path) -> Path:
    """Return a plant of two lines whose ports do not exist."""
    path = tmp_path / "plant.toml"
    drives = (("pump-1", TOY, 1), ("fan-1", FAN, 3), ("che-1", "invt-che", 4))
    line = LINE.format("hall-1", "/dev/none-1") + "".join(DRIVE.format(*drive) for drive in drives)
    path.write_text(line + LINE.format("roof", "/dev/none-2") + DRIVE.format("pump-2", TOY, 2))
    return path


@pytest.fixture
def at(port: str) -> str:
    return f"--port=hall-1={port}"


def one_line(directory: Path, port: str, name: str = "one.toml") -> Path:
    path = directory / name
    path.write_text(LINE.format("hall-1", port) + DRIVE.format("pump-1", TOY, 1))
    return path


def test_the_read_command_accepts_a_plant_file_and_a_drive_name(run: Run, port: str, tmp_path: Path) -> None:
    plant = one_line(tmp_path, port)
    shown = "output_current    3.25  A\noutput_frequency  49.9  Hz\n"
    assert run("read", plant, "pump-1", *READINGS) == (0, shown, "")
    assert run("read", plant, "pump-1")[1] == run("read", port, TOY, 1)[1]
    record = json.loads(run("read", plant, "pump-1", "output_current", "--json")[1])
    assert (record["drive"], record["values"]["output_current"]["value"]) == ("pump-1", 3.25)


def test_the_port_option_replaces_a_lines_port(run: Run, plant: Path, at: str) -> None:
    assert run("read", plant, "pump-1", "output_current")[0] == 1
    assert run("read", plant, "pump-1", "output_current", at) == (0, "output_current  3.25  A\n", "")
    both = (at, "--port", "roof=/dev/none-3")
    assert run("read", *both, plant, "pump-1", "output_current")[0] == 0
    assert "/dev/none-3" in run("read", *both, plant, "pump-2", "output_current")[2]


@pytest.mark.slow
def test_a_command_uses_the_settings_in_the_plant_file(run: Run, plant: Path, at: str) -> None:
    text = plant.read_text().replace("address = 1\n", 'address = 1\nframing = "ascii"\nbaudrate = 19200\n')
    plant.write_text(text)
    status, _, err = run("read", plant, "pump-1", "output_current", at)
    assert (status, err.startswith("multidrop: pump-1 does not answer")) == (1, True)


@table(
    ("words", "sentence"),
    [
        (["pmp-1"], "PLANT has no drive 'pmp-1'; did you mean pump-1 or pump-2?"),
        (["zz"], "PLANT has no drive 'zz'; there are pump-1, fan-1, che-1, pump-2"),
        ([], "choose a drive of PLANT: pump-1, fan-1, che-1, pump-2; see `multidrop read --help`"),
        (["pump-1", "output_curent"], "TOY T1 has no register 'output_curent'; did you mean output_current"),
        (
            ["pump-1", "control"],
            "register control cannot be read; see `multidrop models PLANT pump-1`",
        ),
        (
            ["pump-1", "--baudrate", "9600"],
            "--baudrate cannot be used with a plant file. Write the setting in PLANT",
        ),
        (["pump-1", "--option", "rated_frequency=50"], "--option cannot be used with a plant file"),
        (["pump-1", "--ram", "sealed"], "--ram cannot be used with a plant file"),
        (["pump-1", "--port", "hal-1=x"], "PLANT has no line 'hal-1'; did you mean hall-1?"),
        (["pump-1", "--port", "hall-1"], "argument --port: 'hall-1' is not LINE=PORT, such as"),
        (["pump-1", "--port", "hall-1="], "argument --port: 'hall-1=' is not LINE=PORT, such as"),
        (["pump-1", "--port", "roof=/dev/none-1"], "lines hall-1 and roof would both use /dev/none-1"),
        (
            ["pump-1", "--port", "roof=a", "--port", "roof=b"],
            "--port is given twice for line 'roof': give it once",
        ),
    ],
)
def test_a_wrong_drive_name_or_option_is_reported_in_one_sentence(
    run: Run, plant: Path, words: list[str], sentence: str
) -> None:
    status, out, err = run("read", plant, *words)
    assert (status, out) == (2, "")
    assert err.startswith(f"multidrop: {sentence.replace('PLANT', str(plant))}")
    assert err.count("\n") == 1


def test_options_for_plant_files_are_refused_without_a_plant_file(run: Run) -> None:
    sentence = (
        "multidrop: --port needs a plant file. Without a plant file, give the port as the first argument\n"
    )
    for words in (("read", "/dev/none", TOY, 1), ("scan", "/dev/none"), ("doctor", "/dev/none")):
        assert run(*words, "--port=a=b") == (2, "", sentence)


def test_the_commands_read_and_plan_report_the_same_plant_file_errors(run: Run, plant: Path) -> None:
    plant.write_text(
        plant.read_text().replace('"pump-1"', '"fan-1"').replace("address = 4", "address = 4000")
    )
    told = run("plan", plant)
    assert (told[0], told[2].count("\n")) == (2, 2)
    assert run("read", plant, "fan-1") == told
    assert run("read", plant.with_name("none.toml"), "fan-1")[0] == 2


def test_the_write_command_accepts_plant_file_and_drive_name(
    run: Run, plant: Path, at: str, toy: SimulatedDrive
) -> None:
    words = ("write", plant, "pump-1", at, "frequency")
    assert run(*words, "25", "--yes") == (0, "pump-1: frequency = 25.00 Hz: done (cannot be read back)\n", "")
    assert toy["frequency"] == 25
    assert "the following arguments are required: VALUE" in run(*words)[2]
    assert "unrecognized arguments: 26" in run(*words, 25, 26)[2]
    status, out, err = run(*words, "26")
    assert (status, out) == (1, "")
    assert "There is no terminal to ask on: add --yes to confirm" in err
    assert toy["frequency"] == 25


def test_drive_commands_accept_a_plant_file_and_a_drive_name(
    run: Run, plant: Path, at: str, toy: SimulatedDrive
) -> None:
    drive = (plant, "pump-1", at)
    assert run("state", *drive)[1].startswith("stopped\n")
    assert run("set-frequency", *drive, "33.5", "--yes")[0] == 0
    assert toy["frequency"] == 33.5
    assert run("set-frequency", *drive, "--yes")[2].startswith(
        "multidrop: the following arguments are required: HZ"
    )
    assert "argument HZ: 'fast' is not a number" in run("set-frequency", *drive, "fast", "--yes")[2]
    status, out, err = run("start", *drive, "--direction", "reverse", "--yes")
    assert (status, err) == (0, "")
    # this simulated drive always reports a standing motor
    assert out.startswith("pump-1: start done; state: stopped; watchdog: The document names no watchdog")
    assert toy["control"] == Status.RUNNING | Status.REVERSE
    assert run("stop", *drive)[0] == 0  # a stop needs no confirmation
    assert toy["control"] == 0


def test_only_stops_and_reads_accept_a_drive_name_in_another_unicode_form(
    run: Run, tmp_path: Path, port: str, toy: SimulatedDrive
) -> None:
    """Depending on the keyboard, a u with two dots is one character (U+00FC) or two (U+0075 U+0308)."""
    plant = tmp_path / "spelt.toml"
    text = LINE.format("hall-1", port) + DRIVE.format("L\u00fcfter", TOY, 1)
    plant.write_text(text, encoding="utf-8")
    fan = (plant, "Lu\u0308fter")
    for words in (("start", *fan, "--yes"), ("write", *fan, "frequency", 20, "--yes")):
        status, _, err = run(*words)
        assert status == 2
        assert "has no drive" in err
    assert not toy.counters.writes
    toy["control"] = Status.RUNNING
    assert run("stop", *fan)[0] == 0
    assert toy["control"] == 0
    assert run("state", *fan)[1].startswith("stopped\n")
    assert run("read", *fan, "output_current")[0] == 0


def test_an_unidentifiable_drive_starts_only_with_the_key_confirmed(run: Run, plant: Path, at: str) -> None:
    start = ("start", plant, "fan-1", at, "--yes")
    status, _, err = run(*start)
    assert (status, "declare confirmed = 1" in err or "confirmed" in err) == (1, True)
    assert run("read", plant, "fan-1", "run", at)[1].split()[:2] == ["run", "OFF"]
    plant.write_text(plant.read_text().replace("address = 3\n", "address = 3\nconfirmed = 1\n"))
    run(*start)  # may fail: the simulated fan may not show that it runs
    assert run("read", plant, "fan-1", "run", at)[1].split()[:2] == ["run", "ON"]


@pytest.mark.parametrize(("there", "is_started"), [(Toy(4), False), (InvtCHE(4, maximum_frequency=50), True)])
def test_no_start_is_sent_if_the_drive_is_of_another_family(
    run: Run, plant: Path, there: Drive, is_started: bool
) -> None:
    plant.write_text(plant.read_text().replace("address = 4\n", "address = 4\nmaximum_frequency = 50\n"))
    sim = simulated(there)
    with Simulator([Wire([sim], unpaced=True)]) as simulator:
        at = f"--port=hall-1={simulator.wires[0].path}"
        status, _, err = run("start", plant, "che-1", at, "--yes", "--frequency", 20)
    assert (status == 0, bool(sim.counters.writes)) == (is_started, is_started), err


def test_an_interrupted_start_prints_the_stop_command_with_the_plant_file(
    run: Run, plant: Path, at: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*words: object) -> str:
        raise KeyboardInterrupt

    monkeypatch.setattr(Bus, "watchdog", interrupt)
    status, _, err = run("start", plant, "pump-1", at, "--yes")
    assert status == 130
    assert err.splitlines()[-1] == f"multidrop: to stop it, type: multidrop stop {plant} pump-1 {at}"
    assert run(*err.splitlines()[-1].split()[6:])[0] == 0


def test_the_models_command_shows_the_family_of_a_drive_in_a_plant(run: Run, plant: Path) -> None:
    assert run("models", plant, "che-1") == run("models", "invt-che")
    status, _, err = run("models", plant, "che-2")
    assert (status, err.startswith(f"multidrop: {plant} has no drive 'che-2'; did you mean che-1")) == (
        2,
        True,
    )


def test_the_port_option_of_the_poll_command_replaces_ports(run: Run, port: str, tmp_path: Path) -> None:
    plant = one_line(tmp_path, "/dev/none-1")
    assert run("poll", plant, "--seconds", "0.2")[0] == 1
    status, out, _ = run("poll", plant, "--seconds", "0.2", "--json", f"--port=hall-1={port}")
    assert (status, json.loads(out)["samples"] > 0) == (0, True)


def test_the_monitor_accepts_the_port_option(run: Run, plant: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[str] = []

    def watch(watched: Plant, **_: object) -> dict[str, int]:
        shown.extend(line.port for line in watched.lines)
        return {"samples": 1}

    monkeypatch.setattr(monitor, "keys_are_readable", lambda: True)
    monkeypatch.setattr(monitor, "watch", watch)
    assert run("monitor", plant, "--port=roof=/dev/other")[0] == 0
    assert shown == ["/dev/none-1", "/dev/other"]


@pytest.mark.slow
def test_the_scan_command_accepts_a_plant_file_and_a_line(run: Run, plant: Path, port: str, at: str) -> None:
    few = ("--model", TOY, "--addresses", "1", "--baudrates", "9600", "--formats", "8N1", "--json")
    status, out, _ = run("scan", plant, "hall-1", at, *few)
    assert status == 0
    record = json.loads(out)
    assert (record["port"], [drive["address"] for drive in record["drives"]]) == (port, [1])
    sentence = f"multidrop: {plant} has several lines: choose one of hall-1, roof\n"
    assert run("scan", plant, *few) == (2, "", sentence)
    assert "has no line 'hall-2'; did you mean hall-1?" in run("scan", plant, "hall-2", *few)[2]
    assert "unrecognized arguments: hall-1" in run("scan", "/dev/none", "hall-1")[2]
    assert "the following arguments are required: PORT" in run("scan")[2]


@pytest.mark.slow
def test_the_doctor_command_uses_the_drives_of_a_plant(run: Run, plant: Path, port: str, at: str) -> None:
    def findings(*words: object) -> dict[str, str]:
        record = json.loads(run("doctor", plant, *words, at, "--json")[1])
        assert record["port"] == port
        return {finding["topic"]: finding["what"] for finding in record["findings"]}

    assert "round trip" in findings("hall-1")
    assert "not measured" not in findings("pump-1")["round trip"]
    assert "has no drive 'pump-7'; did you mean" in run("doctor", plant, "pump-7")[2]
    assert (
        "--rs485 cannot be used with a plant file" in run("doctor", plant, "pump-1", "--rs485", "kernel")[2]
    )
    assert "--rs485 cannot be used with a plant file" in run("scan", plant, "hall-1", "--rs485", "kernel")[2]
    assert "--settle cannot be used with a plant file" in run("scan", plant, "hall-1", "--settle", "1 s")[2]
    assert "--model cannot be used with a plant file" in run("doctor", plant, "pump-1", "--model", TOY)[2]


def test_the_sniff_command_accepts_a_plant_file_and_a_line(run: Run, plant: Path, at: str) -> None:
    status, out, err = run("sniff", plant, "hall-1", at, "--seconds", "0.2")
    assert (status, out) == (0, "0 exchanges, 0 unknown bytes\n")
    assert err.startswith("listening on /dev/pts/")
    assert "has several lines: choose one of hall-1, roof" in run("sniff", plant, "--seconds", "0.2")[2]
    assert "is a plant file already" in run("sniff", plant, "roof", "--plant", plant, "--seconds", "0.2")[2]


def test_a_model_file_path_is_relative_to_the_plant_file(
    run: Run, port: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The working directory does not matter, and a model's file may import a module beside it."""
    room = tmp_path / "room"
    room.mkdir()
    (room / "steps.py").write_text("CURRENT = 0.01\n")
    (room / "own.py").write_text(
        "from steps import CURRENT\nfrom multidrop import Drive, reading\n\n\n"
        "class Own(Drive):\n    output_current = reading(2, 'A', step=CURRENT)\n"
    )
    (room / "plant.toml").write_text(LINE.format("hall-1", port) + DRIVE.format("own-1", "own.py:Own", 1))
    monkeypatch.chdir(tmp_path)
    status, out, _ = run("read", "room/plant.toml", "own-1")
    assert (status, out) == (0, "output_current  3.25  A\n")


def test_the_same_writes_are_refused_with_and_without_a_plant_file(
    run: Run, plant: Path, at: str, port: str
) -> None:
    """Each command names the drive first by plant file, then by port. The errors must be equal."""
    for command, further in (
        ("write", ("control", "RUNNING", "--yes")),
        ("write", ("sealed", "1", "--yes")),
        ("write", ("frequency", "51", "--yes")),
        ("coast", ()),
        ("reset-fault", ("--yes",)),
        ("set-frequency", ("51", "--yes")),
    ):
        by_plant = run(command, plant, "pump-1", at, *further)
        by_hand = run(command, port, TOY, 1, *further)
        assert by_plant[0] == by_hand[0] != 0
        assert by_plant[2].replace("pump-1", "toy@1") == by_hand[2]


METER = """\
[family]
title = "Meter M1"
manual = "Meter M1, register table"
counts_from = 0

[reading]
current = { at = 2, unit = "A", step = 0.01 }
"""


def test_a_family_file_beside_the_plant_file_is_used_as_model(run: Run, port: str, tmp_path: Path) -> None:
    (tmp_path / "room").mkdir()
    (tmp_path / "room" / "meter.toml").write_text(METER)
    plant = tmp_path / "room" / "plant.toml"
    plant.write_text(LINE.format("hall-1", port) + DRIVE.format("meter-1", "meter.toml", 1))
    assert run("read", plant, "meter-1", "current")[:2] == (0, "current  3.25  A\n")
    assert run("models", plant, "meter-1")[1] == run("models", tmp_path / "room" / "meter.toml")[1]


def test_a_family_file_in_place_of_a_plant_file_is_refused(run: Run, tmp_path: Path) -> None:
    (tmp_path / "meter.toml").write_text(METER)
    status, out, err = run("read", tmp_path / "meter.toml", "meter-1")
    assert (status, out) == (2, "")
    assert "meter.toml: this is a family file, not a plant file" in err


@pytest.mark.parametrize("words", [[], ["--all"], ["--line", "hall-1"]])
def test_the_stop_command_stops_all_drives_of_a_plant_or_line(
    run: Run, plant: Path, at: str, toy: SimulatedDrive, words: list[str]
) -> None:
    toy["control"] = Status.RUNNING
    plant.write_text(plant.read_text().replace('"che-1"\nmodel = "invt-che"', f'"toy-4"\nmodel = "{TOY}"'))
    status, out, _ = run("stop", plant, at, *words)
    assert toy["control"] == 0
    assert {line.split(":")[0] for line in out.splitlines()} >= {"pump-1", "fan-1", "toy-4"}
    assert out.count(": stopped after ") == 3
    has_portless_line = "--line" not in words
    assert ("pump-2: the stop was NOT sent: /dev/none-2: there is no such port" in out) == has_portless_line
    assert status == has_portless_line


def test_the_stop_command_for_a_whole_plant_prints_json(
    run: Run, tmp_path: Path, port: str, toy: SimulatedDrive
) -> None:
    plant = tmp_path / "all.toml"
    drives = DRIVE.format("pump-1", TOY, 1) + DRIVE.format("pump-4", TOY, 4)
    plant.write_text(LINE.format("hall-1", port) + drives)
    toy["control"] = Status.RUNNING
    status, out, _ = run("stop", plant, "--json")
    assert status == 0
    assert toy["control"] == 0
    assert [(found["line"], found["drive"], found["seen"]) for found in json.loads(out)] == [
        ("hall-1", "pump-1", "stopped"),
        ("hall-1", "pump-4", "stopped"),
    ]


@pytest.mark.parametrize(
    ("words", "mistake"),
    [
        (["--line", "hall-2"], "has no line 'hall-2'; did you mean hall-1?"),
        (["pump-1", "--all"], "pump-1 and --all contradict each other: give one of them"),
        (["--all", "--line", "roof"], "--all and --line contradict each other: give one of them"),
    ],
)
def test_a_stop_command_with_wrong_arguments_is_reported_as_not_sent(
    run: Run, plant: Path, at: str, toy: SimulatedDrive, words: list[str], mistake: str
) -> None:
    status, _, err = run("stop", plant, at, *words)
    assert status == 2
    assert err.startswith("multidrop: the stop was NOT sent: ")
    assert mistake in err
    assert not toy.counters.writes


MISTAKES = [
    'rs485 = "sometimes"\nname = "roof"\nport = "/dev/none-3"\n' + DRIVE.format("fan-9", TOY, 9),
    DRIVE.format("fan-9", "no-such-model", 9),
    DRIVE.format("fan-9", TOY, 999),
    "[serve]\nlisten = 5\n\n[[walls]]\n",
]


@pytest.mark.parametrize("words", [[], ["pump-1"]])
@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_drive_can_be_stopped_despite_a_mistake_elsewhere_in_the_plant_file(
    run: Run, tmp_path: Path, port: str, toy: SimulatedDrive, mistake: str, words: list[str]
) -> None:
    plant = tmp_path / "wrong.toml"
    head = "\n[[line]]\n" if mistake.startswith("rs485") else ""
    plant.write_text(LINE.format("hall-1", port) + DRIVE.format("pump-1", TOY, 1) + head + mistake)
    toy["control"] = Status.RUNNING
    assert run("state", plant, "pump-1")[0] == 2  # a command other than a stop refuses the file
    status, out, err = run("stop", plant, *words)
    assert toy["control"] == 0
    assert "a drive is not stopped if its line, model or address has a mistake" in err
    assert (status, "fan-9" in out) == (0 if words else 1, False)


@pytest.mark.parametrize("mistake", ['poll = ["output_curent"]\n', 'every = "soon"\n'])
def test_a_drive_can_be_stopped_despite_a_mistake_in_the_poll_settings(
    run: Run, tmp_path: Path, port: str, toy: SimulatedDrive, mistake: str
) -> None:
    plant = tmp_path / "wrong.toml"
    plant.write_text(LINE.format("hall-1", port) + DRIVE.format("pump-1", TOY, 1) + mistake)
    toy["control"] = Status.RUNNING
    assert run("stop", plant, "pump-1")[0] == 0
    assert toy["control"] == 0


def test_a_stop_is_not_sent_if_the_drives_own_table_has_a_mistake(
    run: Run, tmp_path: Path, port: str
) -> None:
    plant = tmp_path / "wrong.toml"
    drives = DRIVE.format("pump-1", TOY, 1) + DRIVE.format("fan-9", "no-such-model", 9)
    plant.write_text(LINE.format("hall-1", port) + drives)
    status, _, err = run("stop", plant, "fan-9")
    assert status == 2
    assert "the stop was NOT sent: " in err
    assert "no-such-model" in err


def test_an_interrupted_stop_of_a_plant_reports_each_drive(
    run: Run, plant: Path, at: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*arguments: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(verbs, "_start_stops", interrupt)
    status, _, err = run("stop", plant, at)
    assert status == 130
    names = ("pump-1", "fan-1", "che-1", "pump-2")
    assert err.splitlines()[1:] == [f"multidrop: {name}: the stop was NOT sent" for name in names]
