"""Commands that run for a while: `demo`, `poll`, `simulate`; and `convert`. Each runs in its own process."""

from __future__ import annotations

import json
import math
import os
import re
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any, cast

import pytest
from batches import METADATA, counting
from commands import BoundProcess, Run, multidrop, plant_file, running
from lines import until
from peers import require_module
from recordings import recorded
from simulated_pumps import simulated_test, write_test
from tables import usually
from toy import Toy

from multidrop.bus import Bus
from multidrop.capture import Capture, Decoding
from multidrop.cli import simulate as simulate_command
from multidrop.cli.simulate import DRIVES, Operator
from multidrop.core import Message, Status
from multidrop.errors import NoReply
from multidrop.families import MODELS, InvtCHE
from multidrop.recording import open_recording, open_writer
from multidrop.sim import Simulator, Wire, simulated

OUT = ("--out", "a.arrows")
SIMULATING = """
import sys, time
from pathlib import Path
from multidrop.cli.simulate import simulator
with simulator(Path(sys.argv[1]), Path(sys.argv[2])):
    print("ready", flush=True)
    time.sleep(600)
"""


def test_the_poll_command_can_request_realtime_scheduling(
    run: Run, plant: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[bool] = []
    monkeypatch.setattr("multidrop.core.port._Engine.set_realtime", lambda *words: asked.append(words[-1]))
    run("poll", plant, "--seconds", 0.01, "--json")
    assert asked == []
    run("poll", plant, "--seconds", 0.01, "--json", "--realtime")
    assert asked == [True, False]
    plant.write_text("realtime = true\n" + plant.read_text())
    run("poll", plant, "--seconds", 0.01, "--json")
    assert asked == [True, False, True, False]


@pytest.mark.long
@pytest.mark.parametrize("number", usually(signal.SIGINT, signal.SIGTERM))
def test_the_simulate_command_removes_its_port_links_when_interrupted(tmp_path: Path, number: int) -> None:
    link = tmp_path / "ports" / "hall-1"
    with running("simulate", plant_file(tmp_path), "--ports", tmp_path / "ports") as (process, out):
        out.readline()
        assert link.is_symlink()
        process.send_signal(number)
        assert process.wait(timeout=60) == 0
    assert not link.is_symlink()


def test_the_simulate_command_never_replaces_an_existing_file(run: Run, tmp_path: Path) -> None:
    link = tmp_path / "ports" / "hall-1"
    link.parent.mkdir()
    link.write_text("mine")
    assert run("simulate", plant_file(tmp_path), "--ports", link.parent) == (
        2,
        "",
        f"multidrop: {link} exists already: remove it, or choose another directory with --ports\n",
    )
    assert link.read_text() == "mine"


@pytest.mark.long
@pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs pseudo-terminals")
def test_the_simulate_command_replaces_the_link_of_a_killed_simulator(tmp_path: Path) -> None:
    link = tmp_path / "ports" / "hall-1"
    link.parent.mkdir()
    link.symlink_to("/dev/pts/987654")
    with running("simulate", plant_file(tmp_path), "--ports", link.parent) as (_, out):
        assert out.readline() == f"ready hall-1 {link}\n"
        assert link.exists()


@pytest.mark.long
@pytest.mark.slow
def test_the_simulate_command_applies_the_faults_of_its_file(tmp_path: Path) -> None:
    faults, ports = tmp_path / "faults.toml", tmp_path / "ports"
    faults.write_text("drop = 1\n")
    words = ["simulate", plant_file(tmp_path), "--ports", ports, "--unpaced", "--faults", faults]
    with running(*words) as (_, out):
        out.readline()
        with Bus(str(ports / "hall-1")) as bus, pytest.raises(NoReply):
            bus.attach(Toy, 1).read(Toy.output_current)


@pytest.mark.long
def test_the_poll_command_continues_a_segmented_recording_after_a_restart(
    run: Run, plant: Path, tmp_path: Path
) -> None:
    counted = 0
    words = ["--out", tmp_path / "run.arrows", "--rotate", "1 s"]
    for _ in range(2):  # the second run continues the recording
        status, out, err = run("poll", plant, "--seconds", 1.3, *words, "--json")
        assert (status, err) == (0, "")
        summary = json.loads(out)
        counted += summary["samples"] + summary["misses"]
    names = sorted(path.name for path in tmp_path.glob("*.arrows"))
    assert names == [f"run.{number:08d}.arrows" for number in range(1, len(names) + 1)]
    assert len(names) >= 3
    assert sum(len(recorded(tmp_path / name)) for name in names) == counted
    _, out, _ = run("poll", plant, "--seconds", 0.1, *words)
    assert out.endswith(f" in segments of {tmp_path}/run.arrows\n")


def test_the_commands_convert_and_report_ask_for_one_segment_file(run: Run, tmp_path: Path) -> None:
    for number in (1, 2):
        with open_writer(tmp_path / f"run.0000000{number}.arrows", METADATA) as writer:
            writer.write(counting(100, 0))
    whole, newest = tmp_path / "run.arrows", tmp_path / "run.00000002.arrows"
    sentence = f"multidrop: {whole} was recorded in several files: name one of them, such as {newest}\n"
    assert run("convert", whole, tmp_path / "a.csv") == (2, "", sentence)
    require_module("matplotlib")
    assert run("report", whole) == (2, "", sentence)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            ["--keep", "1 h"],
            '--keep and --most need --rotate, because they delete whole files: add --rotate "1 h"',
        ),
        (
            ["--rotate", "1 h"],
            "--rotate needs --out with a file name that ends in .arrows, such as --out run.arrows",
        ),
        (["--rotate", "1 h", "--out", "a.csv"], "--rotate needs --out with a file name that ends in .arrows"),
        (["--rotate", "soon"], "invalid time 'soon': write 1 s to 100 years"),
        (["--most", "big"], "invalid size 'big': write 1 kB or more"),
        (["--trigger", "pump-1.output_current", *OUT], "--trigger pump-1.output_current: column 1: "),
        (
            ["--trigger", "output_current > 30", *OUT],
            "the name output_current needs a drive, such as pump-1.",
        ),
        (["--trigger", "key"], "--trigger needs --out"),
        (["--trigger", "key", *OUT, "--rotate", "1 h"], "--trigger and --rotate exclude each other"),
        (["--trigger", "key", "--out", "a.txt"], "a.txt: a recording's name must end in .arrows"),
        (
            ["--trigger", "key", *OUT],
            "--trigger key waits for a key press, so it needs a terminal and no --json",
        ),
        (["--pre", "1 s"], "--pre and --post belong to a trigger"),
    ],
)
def test_invalid_recording_options_are_named_in_the_error(
    run: Run, plant: Path, words: list[str], sentence: str
) -> None:
    status, out, told = run("poll", plant, *words)
    assert (status, out) == (2, "")
    assert sentence in told


LATE_OR_SILENT = {str(each) for each in (Status.NO_REPLY, Status.LATE_ANSWER_DUE, Status.NOT_ASKED)}


@pytest.mark.slow
def test_a_recording_has_as_many_rows_as_the_summary_counts(run: Run, plant: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.arrows"
    status, told, err = run("poll", plant, "--seconds", 0.6, "--out", out, "--json")
    assert (status, err) == (0, "")
    summary = json.loads(told)
    rows = recorded(out)
    samples = [row for row in rows if row.value is not None]
    assert {row.drive for row in samples} == {"pump-1"}
    assert len(samples) == summary["samples"] > 0
    misses = [row for row in rows if row.value is None]
    assert Counter(row.status for row in misses) == summary["lines"]["hall-1"]["misses"]
    assert {"no reply"} <= {row.status for row in misses if row.drive == "pump-9"} <= LATE_OR_SILENT
    # on a busy machine, replies of pump-1 may be late or lost
    assert {row.status for row in misses if row.drive == "pump-1"} <= LATE_OR_SILENT
    assert len(misses) == summary["misses"]
    assert summary["lines"]["hall-1"]["exchanges"] > 0
    assert summary["lines"]["hall-1"]["drives"]["pump-1"]["samples_per_second"] > 0
    assert summary["lines"]["hall-1"]["utilisation"] > 0


def test_a_recording_made_by_poll_describes_its_registers(run: Run, plant: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.arrows"
    run("poll", plant, "--seconds", 0.1, "--out", out)
    drive = open_recording(out).metadata["drives"]["pump-1"]
    assert (drive["line"], drive["model"], drive["address"], drive["settings"]) == (
        "hall-1",
        "toy",
        1,
        "9600 8N1",
    )
    place = {"function": 3, "address": 2, "words": 1}
    assert drive["registers"]["output_current"] == {
        "unit": "A",
        "step": 0.01,
        "values": None,
        "bits": False,
        **place,
    }
    assert drive["registers"]["mystery"] == {
        "bits": False,
        "unit": "",
        "step": None,
        "values": None,
        **place,
        "address": 3,
    }


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("number", usually(signal.SIGINT, signal.SIGTERM))
def test_a_poll_command_ended_by_a_signal_keeps_its_recording(
    plant: Path, tmp_path: Path, number: int
) -> None:
    out = tmp_path / "out.csv"
    with running("poll", plant, "--out", out, "--json") as (process, printed):
        while not out.exists() or out.stat().st_size < 2000:
            assert process.poll() is None
        process.send_signal(number)
        text = printed.read()
        assert process.wait(timeout=60) == 0
    assert len(recorded(out)) == json.loads(text)["samples"] + json.loads(text)["misses"]


@pytest.mark.slow
def test_the_poll_summary_compares_predicted_and_measured_rates_as_text(run: Run, plant: Path) -> None:
    plant.write_text(plant.read_text().replace("address = 9\n", "address = 9\nbaudrate = 19200\n"))
    lines = run("poll", plant, "--seconds", 0.6)[1].splitlines()
    assert lines[0].startswith("hall-1: ")
    assert lines[1].split() == ["DRIVE", "EXCHANGES/S", "SAMPLES/S", "MISSES"]
    living, dead = (next(line for line in lines if line.split()[0] == name) for name in ("pump-1", "pump-9"))
    assert any(reason in living for reason in {"none", *LATE_OR_SILENT})
    assert dead.split()[:3] == ["pump-9", "0.0", "0.0"]
    assert any(reason in dead for reason in LATE_OR_SILENT)
    words = [line.split() for line in lines]
    told = lines[words.index(["PREDICTED", "WITH", "DELAYS", "MEASURED"]) + 1 :]
    assert [line.split()[0] for line in told[:4]] == ["bus", "utilisation", "pump-1,", "pump-9,"]
    assert told[3].split()[-1] == "0.0"
    assert re.search(r"\n  and the measured \d+\.\d\d ms to change the port's settings\n", "\n".join(lines))
    assert max(map(len, lines)) <= 80


@pytest.mark.slow
def test_the_json_summary_of_poll_compares_prediction_and_measurement(run: Run, plant: Path) -> None:
    summary = json.loads(run("poll", plant, "--seconds", 0.5, "--json")[1])["lines"]["hall-1"]
    found = summary["comparison"]
    planned = json.loads(run("plan", plant, "--json")[1])["lines"]["hall-1"]
    assert list(found) == ["predicted", "predicted_with_measured_delays", "measured"]
    assert found["predicted"]["cycle_ms"] == planned["cycle_ms"]
    assert found["predicted"]["utilisation"] == planned["utilisation"]
    # pump-9 never answers, so both predictions assume 5 ms for it
    delay = summary["drives"]["pump-1"]["response_delay_ms"]
    known = found["predicted_with_measured_delays"]["cycle_ms"]
    assert known == pytest.approx(planned["cycle_ms"] + delay - 5, abs=0.01)
    assert found["measured"]["utilisation"] == summary["utilisation"]
    assert found["measured"]["exchanges_per_second"]["pump-9"] == 0
    assert found["measured"]["cycle_ms"] > 0
    assert found["measured"]["switching_ms"] == summary["switching_ms"] > 0


@pytest.mark.slow
def test_no_bus_cycle_is_measured_if_a_drive_has_a_polling_period(run: Run, plant: Path) -> None:
    plant.write_text(plant.read_text().replace("address = 1\n", 'address = 1\nevery = "200 ms"\n'))
    found = json.loads(run("poll", plant, "--seconds", 0.5, "--json")[1])["lines"]["hall-1"]["comparison"]
    assert found["measured"]["cycle_ms"] is None
    assert found["predicted"]["exchanges_per_second"]["pump-1"] == 5


@pytest.mark.slow
def test_a_poll_command_without_any_sample_returns_1(run: Run, plant: Path) -> None:
    text = plant.read_text().replace("address = 1\n", "address = 8\n")
    plant.write_text(text)
    status, out, _ = run("poll", plant, "--seconds", 0.5, "--json")
    assert (status, json.loads(out)["samples"]) == (1, 0)


def test_the_poll_command_prints_all_mistakes_of_a_plant_file(run: Run, tmp_path: Path) -> None:
    path = plant_file(tmp_path)
    path.write_text(
        path.read_text().replace("port =", "prot =").replace("address = 1", "address = 99\nevery = 5\n")
        + 'poll = ["control", "output_curent"]\n'
    )
    status, out, err = run("poll", path)
    assert (status, out) == (2, "")
    assert [re.sub(rf'multidrop: {path}:\d+: line "hall-1"', "", line) for line in err.splitlines()] == [
        ": unknown key 'prot'; did you mean port?",
        ', drive "pump-1": every = 5 is not right; write every = "50 ms"',
        ', drive "pump-1": address 99 is not supported by TOY T1; choose 1 to 31',
        ', drive "pump-1", poll number 1: '
        "control can only be written, not polled; see `multidrop models toy`",
        ', drive "pump-1", poll number 2: '
        "TOY T1 has no register 'output_curent'; did you mean output_current or output_frequency?",
    ]


def test_the_commands_poll_and_convert_never_overwrite_a_recording(run: Run, tmp_path: Path) -> None:
    out = tmp_path / "out.csv"
    out.write_text("mine")
    sentence = f"multidrop: {out} exists already: name another file, or remove it first\n"
    assert run("poll", plant_file(tmp_path), "--out", out) == (2, "", sentence)
    assert run("convert", out, out) == (2, "", sentence)
    assert out.read_text() == "mine"


@pytest.mark.parametrize(
    ("out", "status", "sentence"),
    [
        ("out.txt", 2, "a recording's name must end in .arrows, .csv, .parquet"),
        ("none/out.arrows", 1, "cannot be written: No such file or directory"),
    ],
)
def test_a_recording_that_cannot_be_written_is_reported_in_one_sentence(
    run: Run, plant: Path, tmp_path: Path, out: str, status: int, sentence: str
) -> None:
    done, _, err = run("poll", plant, "--seconds", 1, "--out", tmp_path / out)
    assert (done, err) == (status, f"multidrop: {tmp_path / out}: {sentence}\n")


@pytest.mark.long
@pytest.mark.uncounted
def test_a_full_disk_ends_polling_and_keeps_the_earlier_rows(plant: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.arrows"
    done = multidrop("poll", plant, "--seconds", 30, "--out", out, most_bytes=12_000)
    rows = len(recorded(out))
    assert rows > 0
    assert done.returncode == 1
    assert done.stderr.startswith(
        f"multidrop: {out}: cannot be written: File too large; the {rows} rows before"
    )
    assert done.stderr.count("\n") == 1


def test_the_poll_command_reports_a_missing_port_in_one_sentence(run: Run, tmp_path: Path) -> None:
    sentence = f"multidrop: {tmp_path}/ports/hall-1: there is no such port\n"
    out = tmp_path / "out.csv"
    assert run("poll", plant_file(tmp_path), "--seconds", 1, "--out", out) == (1, "", sentence)
    assert not out.exists()


@pytest.mark.slow
def test_a_converted_recording_has_every_row(run: Run, plant: Path, tmp_path: Path) -> None:
    run("poll", plant, "--seconds", 0.3, "--out", tmp_path / "a.arrows")
    rows = recorded(tmp_path / "a.arrows")
    status, out, _ = run("convert", tmp_path / "a.arrows", tmp_path / "b.csv")
    assert (status, out) == (0, f"{len(rows)} rows in {tmp_path}/b.csv\n")
    assert recorded(tmp_path / "b.csv") == rows


@pytest.mark.long
@pytest.mark.usefixtures("_unpainted")
@pytest.mark.parametrize("suffix", usually(".arrows", ".csv"))
def test_the_convert_command_warns_of_a_recording_with_a_missing_end(
    run: Run, tmp_path: Path, suffix: str
) -> None:
    path = tmp_path / f"a{suffix}"
    with open_writer(path, METADATA) as writer:
        for at in range(3):
            writer.write(counting(100, 100 * at))
    with path.open("r+b") as file:
        file.truncate(path.stat().st_size - 7)
    whole = sum(map(len, open_recording(path)))
    missing = open_recording(path).truncated
    assert 0 < missing < path.stat().st_size
    sentence = (
        f"multidrop: {path} ends within a row: {whole} rows read, and the last {missing} bytes skipped\n"
    )
    out = tmp_path / "b.parquet"
    assert run("convert", path, out) == (0, f"{whole} rows in {out}\n", sentence)
    assert run("plot", path) == (0, f"{tmp_path}/a.png\n", sentence)
    assert run("report", path) == (0, f"{tmp_path}/a.html\n", sentence)


def test_the_convert_command_refuses_a_file_that_is_not_a_recording(run: Run, tmp_path: Path) -> None:
    (tmp_path / "a.arrows").write_text("hello")
    status, out, err = run("convert", tmp_path / "a.arrows", tmp_path / "b.csv")
    assert (status, out) == (2, "")
    assert err.startswith(f"multidrop: {tmp_path}/a.arrows is not a recording: ")
    assert run("convert", tmp_path / "none.csv", tmp_path / "b.csv")[0] == 2


@pytest.mark.long
@pytest.mark.slow
def test_the_demo_reads_every_variant_of_every_family(tmp_path: Path) -> None:
    """The demo also replaces the recording of an earlier demo, and captures its traffic."""
    out, capture = tmp_path / "demo.arrows", tmp_path / "demo.pcapng"
    with open_writer(out, {"drives": dict.fromkeys(DRIVES)}):
        pass
    done = multidrop("demo", "--seconds", 3, "--out", out, "--capture", capture, "--json")
    assert (done.returncode, done.stderr) == (0, "")
    summary = json.loads(done.stdout)
    drives = open_recording(out).metadata["drives"]
    assert {(model, framing) for model in MODELS for framing in framings_of(model)} <= {
        (drive["model"], drive["framing"]) for drive in drives.values()
    }
    assert all(
        register["step"] is not None or register["values"] is not None
        for drive in drives.values()
        for register in drive["registers"].values()
    )
    rows = recorded(out)
    assert {row.drive for row in rows if row.value is not None} == set(drives)
    assert summary["misses"] == sum(row.value is None for row in rows)
    assert any(row.value for row in rows if row.register == "output_frequency")  # at least one motor runs
    with Capture(capture) as found:
        assert sum(map(len, Decoding(found))) > 0


def framings_of(model: str) -> list[str]:
    return [str(framing) for framing in MODELS[model].framings]


@pytest.mark.slow
def test_the_demos_simulated_operator_never_restarts_a_stopped_motor(monkeypatch: pytest.MonkeyPatch) -> None:
    """The operator skips a silent drive, and restarts a motor after a trip."""
    monkeypatch.setattr(simulate_command, "STEP_S", 0.05)
    sims: list[Any] = [simulated(InvtCHE(address, maximum_frequency=50)) for address in (1, 2, 3)]
    sims[0].deaf_until = math.inf
    stopped, tripped = sims[1].motor, sims[2].motor
    with Simulator([Wire(sims, unpaced=True)]) as simulator, Bus(simulator.wires[0].path) as bus:
        drives = [bus.attach(sim.drive) for sim in sims]
        with Operator([bus]):
            until(lambda: stopped.energised and tripped.energised)
            drives[1].stop()
            tripped.trip(1)
            until(lambda: tripped.energised)
            assert not stopped.energised


def test_a_demo_overwrites_only_recordings_of_earlier_demos(run: Run, tmp_path: Path) -> None:
    out = tmp_path / "demo.arrows"
    with open_writer(out, {"drives": {"pump-1": {}}}):
        pass
    mine = out.read_bytes()
    sentence = f"multidrop: {out} exists already: name another file, or remove it first\n"
    assert run("demo", "--seconds", 1, "--out", out) == (2, "", sentence)
    assert out.read_bytes() == mine


@pytest.mark.long
def test_a_killed_demo_leaves_no_simulator(tmp_path: Path) -> None:
    ports = tmp_path / "ports"
    words = [sys.executable, "-c", SIMULATING, str(plant_file(tmp_path)), str(ports)]
    with BoundProcess(words, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        assert (ports / "hall-1").is_symlink()
        process.kill()
    until(lambda: not (ports / "hall-1").is_symlink())


@pytest.mark.slow
def test_the_poll_command_records_each_trigger_in_its_own_file(run: Run, plant: Path, tmp_path: Path) -> None:
    condition = "integral(pump-1.output_current >= 0) > 0.3"
    options = ("--trigger", condition, "--trigger", "fault", "--pre", "100 ms", "--post", "200 ms")
    for number in (1, 2):  # each run starts the integral of the trigger's condition at 0
        _, out, _ = run("poll", plant, "--seconds", 1, *options, "--out", tmp_path / "trip.arrows")
        path = tmp_path / f"trip.{number:08d}.arrows"
        assert f"1 trigger recorded\ntrigger: see {path}\n" in out
    assert not list(tmp_path.glob("*.totals.json"))
    recording = open_recording(path)
    trigger = recording.metadata["trigger"]
    assert (trigger["condition"], trigger["pre_s"], trigger["post_s"]) == (condition, 0.1, 0.2)
    values = [(row.time_ns, row.value) for row in recorded(path) if row.register == "trigger_1"]
    assert next(time for time, value in values if value) == trigger["time_ns"]
    assert values[0][0] >= trigger["time_ns"] - 100_000_000
    assert values[-1][0] <= trigger["time_ns"] + 200_000_000


@pytest.mark.slow
def test_the_poll_command_records_two_triggers_for_one_fault(run: Run, tmp_path: Path) -> None:
    """The simulated drive trips once after 30 requests. Nothing else changes, so there are two triggers."""
    with simulated_test(write_test(tmp_path)) as (_, (fan,)):
        answer = fan.answer

        def tripping(request: Message, now: float) -> Message | None:
            if fan.counters.requests == 30:
                fan.trip(4)
            return cast("Message | None", answer(request, now))

        vars(fan)["answer"] = tripping
        triggers = (
            "--trigger",
            "fault",
            "--trigger",
            "changed(fan.fault)",
            "--pre",
            "1 s",
            "--post",
            "500 ms",
        )
        words = ("poll", tmp_path / "plant.toml", "--seconds", 5, "--out", tmp_path / "trip.arrows")
        _, out, _ = run(*words, *triggers)
    assert "2 triggers recorded" in out
    paths = [tmp_path / f"trip.{number:08d}.arrows" for number in (1, 2)]
    fired = [open_recording(path).metadata["trigger"] for path in paths]
    assert {trigger["condition"] for trigger in fired} == {"fault of fan", "changed(fan.fault)"}
    for path, trigger in zip(paths, fired, strict=True):
        faults = [(row.time_ns, row.value) for row in recorded(path) if row.register == "fault"]
        before = [time for time, value in faults if value == 0.0]
        assert before
        assert max(before) < trigger["time_ns"]
        assert min(time for time, value in faults if value == 4.0) == trigger["time_ns"]
