"""`multidrop params`, run against a simulated drive."""

from __future__ import annotations

import json
import os
import pty
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import patient
import pytest
from commands import Run, multidrop
from simulated_pumps import CHE, STEPS, with_parameters, write_test

from multidrop import YD1000, ErmanERG220, cli
from multidrop.recording import open_recording
from multidrop.sim import MotorDrive, Simulator, Wire
from multidrop.transport import clock

pytestmark = pytest.mark.usefixtures("_patient")
PATIENT_MULTIDROP = [sys.executable, patient.__file__, str(Path(cli.__file__).parents[1] / "__main__.py")]


@pytest.fixture
def sim() -> MotorDrive:
    return with_parameters(ErmanERG220(1))


@pytest.fixture
def drive(sim: MotorDrive, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[tuple[object, ...]]:
    """Yield the command-line words that name the drive. The working directory is empty."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    with Simulator([Wire([sim], unpaced=True)]) as simulator:
        yield simulator.wires[0].path, "erman-er-g-220", 1


def edited(path: str, before: str, after: str) -> None:
    text = Path(path).read_text()
    assert before in text
    Path(path).write_text(text.replace(before, after))


def test_saved_parameters_can_be_applied_again(run: Run, drive: tuple[object, ...], sim: MotorDrive) -> None:
    assert run("params", "save", *drive, "pump.toml")[0] == 0
    assert run("params", "diff", "pump.toml", *drive)[0] == 0
    sim["acceleration_time"] = 25.0
    status, out, _ = run("params", "diff", "pump.toml", *drive)
    assert status == 1
    assert out.splitlines()[1].split() == ["b.003", "acceleration_time", "10.0", "s", "25.0", "s"]
    status, out, _ = run("params", "apply", "pump.toml", *drive, "--dry-run")
    assert (status, sim["acceleration_time"]) == (0, 25.0)
    assert "b.003 acceleration_time: 25.0 s -> 10.0 s" in out
    status, out, _ = run("params", "apply", "pump.toml", *drive, "--yes")
    assert (status, sim["acceleration_time"]) == (0, 10.0)
    assert out.endswith("1 parameter written\n")
    assert "has these parameters already" in run("params", "apply", "pump.toml", *drive, "--yes")[1]


def test_params_apply_writes_only_after_confirmation(
    run: Run, drive: tuple[object, ...], sim: MotorDrive
) -> None:
    run("params", "save", *drive, "pump.toml")
    sim["acceleration_time"] = 25.0
    status, _, err = run("params", "apply", "pump.toml", *drive)
    assert (status, sim["acceleration_time"]) == (1, 25.0)
    assert "Write 1 parameter to" in err


@pytest.mark.long
def test_a_refused_write_is_reported_with_the_option_that_permits_it(
    run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    # shorter, because with the manual's silences the test would take 2 s
    monkeypatch.setattr(YD1000, "silence_characters", 3.5)
    sim = with_parameters(YD1000(1))
    with Simulator([Wire([sim], unpaced=True)], speed=50) as simulator, clock.at_speed(50):
        drive = simulator.wires[0].path, "yd1000", 1
        Path("fan.toml").write_text('format = 1\nmodel = "yd1000"\n\n[parameters]\n"0009" = 100\n')
        for seconds in (25.0, 30.0):
            sim["acceleration_time"] = seconds
            status, out, _ = run("params", "apply", "fan.toml", *drive, "--yes")
    assert (status, sim["acceleration_time"]) == (1, 30.0)
    assert "not written: acceleration_time of " in out
    assert "`multidrop params apply --commissioning`" in out
    assert "params.apply(" not in out


@pytest.mark.slow
def test_params_apply_with_commissioning_needs_a_terminal(
    run: Run, drive: tuple[object, ...], sim: MotorDrive
) -> None:
    run("params", "save", *drive, "pump.toml")
    sim["acceleration_time"] = 25.0
    words = ("params", "apply", "pump.toml", *drive, "--yes", "--commissioning", "--audit", "audit.jsonl")
    status, _, err = run(*words)
    assert status == 1
    assert "--commissioning needs a terminal, at which a person" in err
    ours, theirs = pty.openpty()
    try:
        done = subprocess.run(
            [*PATIENT_MULTIDROP, *map(str, words)], stdin=theirs, capture_output=True, timeout=60
        )
    finally:
        os.close(ours)
        os.close(theirs)
    assert (done.returncode, sim["acceleration_time"]) == (0, 10.0)
    assert json.loads(Path("audit.jsonl").read_text())["commissioning"] is True


def test_params_apply_never_writes_while_the_motor_runs(
    run: Run, drive: tuple[object, ...], sim: MotorDrive
) -> None:
    run("params", "save", *drive, "pump.toml")
    sim["acceleration_time"] = 25.0
    sim.motor.target = 40.0
    sim.motor.run()
    status, _, err = run("params", "apply", "pump.toml", *drive, "--yes")
    assert status == 1
    assert "run `multidrop stop` first" in err
    assert sim["acceleration_time"] == 25.0


def test_the_actions_of_the_params_command_print_json(
    run: Run, drive: tuple[object, ...], sim: MotorDrive
) -> None:
    saved = json.loads(run("params", "save", *drive, "pump.csv", "--json")[1])
    assert saved["parameters"]["b.003"] == 100
    sim["acceleration_time"] = 25.0
    found = json.loads(run("params", "diff", "pump.csv", *drive, "--json")[1])["differences"]
    assert [(each["code"], each["first"], each["second"]) for each in found] == [("b.003", 100, 250)]
    planned = json.loads(run("params", "apply", "pump.csv", *drive, "--dry-run", "--json")[1])
    assert planned["writes"] == [{"code": "b.003", "before": 250, "after": 100}]
    done = json.loads(run("params", "apply", "pump.csv", *drive, "--yes", "--json")[1])
    assert done["written"] == planned["writes"]
    listed = json.loads(run("params", "list", *drive, "--json")[1])["parameters"]
    assert {row["code"]: row["raw"] for row in listed}["b.003"] == 100


def test_the_params_command_compares_two_files_and_two_drives(run: Run, drive: tuple[object, ...]) -> None:
    run("params", "save", *drive, "a.toml")
    run("params", "save", *drive, "b.csv")
    assert run("params", "diff", "a.toml", "b.csv")[0] == 0
    edited("a.toml", '"b.003" = 100', '"b.003" = 60')
    assert run("params", "diff", "a.toml", "b.csv")[0] == 1
    plant = (
        "[[line]]\nname = 'hall'\nport = '{}'\n[[line.drive]]\nname = 'pump-1'\nmodel = '{}'\naddress = {}\n"
    )
    Path("plant.toml").write_text(plant.format(*drive))
    assert run("params", "diff", "plant.toml", "pump-1", "plant.toml", "pump-1")[0] == 0
    assert run("params", "diff", "plant.toml", "pump-1", "pump-1")[0] == 0


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("apply", "gone.toml", "DRIVE"), "gone.toml: the parameter file cannot be read"),
        (("apply", "plant.toml", "DRIVE"), "give a parameter file, and then the drive"),
        (("apply", "other.toml", "DRIVE"), "of yd1000"),
        (("apply", "newer.toml", "DRIVE"), "has format 9, but this version of multidrop reads format 1"),
        (("apply", "unknown.toml", "DRIVE"), "has no parameter b.999"),
        (("apply", "wide.toml", "DRIVE"), "does not fit"),
        (("diff", "other.toml", "newest.toml"), "other.toml has parameters of yd1000, and newest.toml of"),
        (("diff", "--defaults", "DRIVE"), "prints no factory values"),
        (("diff", "newest.toml"), "give two sides to compare"),
        (("save", "DRIVE", "other.toml"), "other.toml exists already, and is not replaced"),
        (("save", "DRIVE"), "give a drive, and then the name of one file for its parameters"),
        (("list", "invt-che"), "addresses of parameters are not known"),
    ],
)
def test_wrong_arguments_of_the_params_command_are_reported_in_one_sentence(
    run: Run, drive: tuple[object, ...], words: tuple[str, ...], sentence: str
) -> None:
    Path("plant.toml").write_text("[[line]]\nname = 'hall'\n")
    Path("other.toml").write_text('model = "yd1000"\n[parameters]\n"0009" = 100\n')
    Path("newer.toml").write_text("format = 9\n[parameters]\n'b.003' = 1\n")
    Path("newest.toml").write_text('model = "erman-er-g-220"\n[parameters]\n"b.003" = 100\n')
    Path("unknown.toml").write_text("[parameters]\n'b.999' = 1\n")
    Path("wide.toml").write_text("[parameters]\n'b.003' = 99999\n")
    given = [one for word in words for one in (drive if word == "DRIVE" else (word,))]
    status, out, err = run("params", *given)
    assert status in (1, 2)
    assert sentence in err
    assert (out, err.count("\n")) == ("", 1)


# ---- `multidrop run`: the dry run, refusals, and a simulated run ----


HIDDEN = CHE | {"poll": ["output_current"]}


def test_a_dry_run_shows_the_planned_times_and_the_limits(run: Run, tmp_path: Path) -> None:
    path = write_test(tmp_path, '[abort]\nlimits = ["fan.output_current > 30"]\n' + STEPS, fan=HIDDEN)
    assert run("run", path, "--dry-run") == (
        0,
        """\
 AT  LASTS  PHASE    COMMANDS
0 s    0 s  start    fan to 10 Hz, start fan
0 s    2 s  steps 1  fan to 20 Hz
2 s    2 s  steps 2  fan to 30 Hz
3 steps in 4 s, then all drives stop
! no polled register of fan shows a fault, so a fault does not abort the run
aborts: fan.output_current > 30; no value for 5 s; a failed command
""",
        "",
    )
    status, out, _ = run("run", path, "--dry-run", "--json")
    assert (status, [step["at_s"] for step in json.loads(out)["steps"]]) == (0, [0.0, 0.0, 2.0])


def test_a_test_run_with_too_short_steps_is_refused_before_a_port_opens(run: Run, tmp_path: Path) -> None:
    path = write_test(tmp_path, STEPS.replace('"2 s"', '"50 ms"'))
    status, out, _ = run("run", path, "--dry-run")
    assert status == 1
    assert "! steps 1 lasts 50 ms, less than 2 bus cycles of line hall: it would fit with " in out
    status, _, errors = run("run", path, "--yes")
    assert status == 2
    assert "it would fit with" in errors


def test_contradictory_options_of_the_run_command_are_refused(run: Run, tmp_path: Path) -> None:
    path = write_test(tmp_path)
    assert run("run", path, "--speed", 3)[::2] == (
        2,
        "multidrop: --speed is the pace of simulated time: add --simulate, or remove --speed\n",
    )
    assert "--simulate opens its own ports" in run("run", path, "--simulate", "--port", "hall=x")[2]
    status, _, errors = run("run", path)
    assert status == 1
    assert "There is no terminal to ask on: add --yes to confirm" in errors
    assert "fan, if this computer or its power fails: " in errors
    assert "which commands fan at up to 30 Hz, and then stops all drives of the plant?" in errors


def test_the_question_before_a_run_mentions_missing_setpoints_and_fault_registers(
    run: Run, tmp_path: Path
) -> None:
    text = '[[phase]]\nname = "a"\n[[phase.step]]\nstart = ["fan"]\ndwell = "9 s"'
    status, _, errors = run("run", write_test(tmp_path, text, fan=HIDDEN))
    assert status == 1
    assert "no polled register of fan shows a fault" in errors
    assert "fan is started at the setpoint that it has, because no earlier step sets one" in errors
    assert "which commands fan, and then stops" in errors


@pytest.mark.slow
def test_a_simulated_run_needs_no_drive_and_is_recorded(tmp_path: Path) -> None:
    out = tmp_path / "run.arrows"
    done = multidrop("run", write_test(tmp_path), "--simulate", "--speed", 4, "--out", out)
    assert done.returncode == 0
    # On a busy machine, a reply of the simulated drive may be too late; the stop is then repeated.
    assert [said for said in done.stderr.splitlines() if not said.startswith("the stop is repeated")] == []
    stopped, next_command = done.stdout.splitlines()
    assert stopped.startswith("fan: stopped after ")
    assert next_command == f"recorded in {out}; next: multidrop report {out}"
    pytest.importorskip("pandas", reason="needs pandas")
    assert {"steps 1", "stop"} <= {*open_recording(out).to_pandas()["phase"]}
