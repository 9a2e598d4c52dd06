"""The command line as a whole: help, exit statuses and error sentences."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from importlib.metadata import version
from pathlib import Path

import pytest
from batches import METADATA, counting
from commands import TOY, BoundProcess, Run
from tables import table

from multidrop.cli import COMMANDS, main
from multidrop.cli.fleet import ACTIONS as FLEET
from multidrop.drive import carry_out
from multidrop.errors import Advice, WriteForbidden
from multidrop.families import ErmanERG220, InnovertIBD, InvtCHE
from multidrop.recording import open_writer


def test_the_help_lists_every_command(run: Run) -> None:
    status, out, err = run("--help")
    assert (status, err) == (0, "")
    assert all(f"\n  {name} " in out for name in COMMANDS)
    assert max(map(len, out.splitlines())) <= 80
    assert run() == (2, out, "")


@table("name", [*COMMANDS, *(f"fleet {action}" for action in FLEET)])
def test_every_command_has_help_within_80_columns(run: Run, name: str) -> None:
    status, out, err = run(*name.split(), "--help")
    assert (status, err) == (0, "")
    assert out.startswith(f"usage: multidrop {name} ")
    assert max(map(len, out.splitlines())) <= 80


@table("name", ["read", "write", "state", "start"])
def test_each_commands_help_describes_each_argument(run: Run, name: str) -> None:
    words = " ".join(run(name, "--help")[1].split())
    for word in ("PORT: a device", "MODEL: one of", "ADDRESS: the drive's", "PLANT.toml DRIVE: a plant file"):
        assert word in words


@table(
    "name, told",
    [
        ("read", "parity and stop bits; default: the family's"),
        ("read", "default: the family's first"),
        ("doctor", "default: the family's first"),
        ("write", "append every write and its outcome to this file"),
        ("hub", "seconds of samples in a commit; 10 if not given"),
        (
            "simulate",
            "may be left out: then a rate and the seed are 0, and the longest times and bursts are as",
        ),
        ("fleet serve", "spool, logs and lock; NAME in ~/.local/state/multidrop/fleet if not given"),
        ("fleet stop", "this machine's commands; else commands.jsonl in ~/.local/state/multidrop/fleet"),
    ],
)
def test_the_help_names_the_defaults_of_options(run: Run, name: str, told: str) -> None:
    assert told in " ".join(run(*name.split(), "--help")[1].split())


def test_the_help_imports_no_command_and_no_large_library() -> None:
    code = (
        "import sys; before = {*sys.modules}; from multidrop.cli import main; main(['--help']); "
        "print(*({*sys.modules} - before))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert not loaded & {
        "multidrop.core",
        "multidrop.drive.family",
        "serial",
        "nanoarrow",
        "numpy",
        "pyarrow",
        "tomllib",
    }
    assert not {name for name in loaded if name.startswith("multidrop.cli.")}


@table(
    ("words", "sentence"),
    [
        (["raed"], "there is no command 'raed'; did you mean read?"),
        (["zzz"], "there is no command 'zzz'; see `multidrop --help`"),
        (
            ["read", "/dev/ttyX"],
            "the following arguments are required: MODEL, ADDRESS; see `multidrop read --help`",
        ),
        (
            ["read", "/dev/ttyX", TOY, "1", "--baud", "9600"],
            "unrecognized arguments: --baud 9600; did you mean --baudrate?; see `multidrop read --help`",
        ),
        (["schema"], "the following arguments are required: KIND; see `multidrop schema --help`"),
        (
            ["read", "/dev/ttyX", TOY, "one"],
            "argument ADDRESS: 'one' is not a number such as 1; see `multidrop read --help`",
        ),
        (["read", "/dev/ttyX", TOY, "99"], "address 99 is not supported by TOY T1; choose 1 to 31"),
        (
            ["read", "/dev/ttyX", TOY, "1", "output_curent"],
            "TOY T1 has no register 'output_curent'; did you mean output_current or output_frequency?",
        ),
        (
            ["read", "/dev/ttyX", TOY, "1", "control"],
            f"register control cannot be read; see `multidrop models {TOY}`",
        ),
        (
            ["read", "/dev/ttyX", TOY, "1", "--baudrate", "38400"],
            "baud rate 38400 is not supported by TOY T1; choose 9600, 19200",
        ),
        (
            ["read", "/dev/ttyX", TOY, "1", "--option", "rated"],
            "argument --option: 'rated' is not NAME=VALUE with a number as its value; "
            "see `multidrop read --help`",
        ),
        (
            ["read", "/dev/ttyX", TOY, "1", "--option", "rated-frequency=5"],
            "rated_frequency = 5.0 is outside 10 to 400 Hz",
        ),
        (["write", "/dev/ttyX", TOY, "1", "frequency", "fast"], "frequency takes a number in Hz, not 'fast'"),
        (["write", "/dev/ttyX", TOY, "1", "frequency", "60"], "frequency = 60 is outside 0 to 50 Hz"),
        (["write", "/dev/ttyX", TOY, "1", "frequency", "-5"], "frequency = -5 is outside 0 to 50 Hz"),
        (["start", "/dev/ttyX", TOY, "1", "--frequency", "60"], "frequency = 60 is outside 0 to 50 Hz"),
        (["start", "/dev/ttyX", TOY, "1", "--frequency", "-5"], "frequency = -5 is outside 0 to 50 Hz"),
        (
            ["write", "/dev/ttyX", "yd1000", "1", "meter_selection", "0.5"],
            "meter_selection takes a whole number, not 0.5",
        ),
        (
            ["read", "sockt://10.0.0.7:4001", TOY, "1"],
            "sockt://10.0.0.7:4001: the scheme sockt:// is not supported; write a URL such as "
            "tcp://10.0.0.7, socket://10.0.0.7:4001 or rfc2217://10.0.0.7:4001",
        ),
        (["jog", "/dev/ttyX", TOY, "1"], "toy@1: the document of TOY T1 has no jog command"),
        (["set-frequency", "/dev/ttyX", TOY, "1", "nan"], "frequency takes a finite number, not nan"),
        (
            ["models", "innovert-ibt"],
            "there is no model 'innovert-ibt'; did you mean innovert-ibd? "
            "(or write path/to/file.toml or file.py:Class)",
        ),
    ],
)
def test_wrong_commands_print_a_sentence_and_return_2(run: Run, words: list[str], sentence: str) -> None:
    assert run(*words) == (2, "", f"multidrop: {sentence}\n")


def test_the_version_option_prints_the_version_of_the_package(run: Run) -> None:
    assert run("--version") == (0, f"multidrop {version('multidrop')}\n", "")


@pytest.mark.parametrize(
    ("library", "words"),
    [
        ("asammdf", ["convert", "a.csv", "b.mf4"]),
        ("h5py", ["convert", "a.csv", "b.h5"]),
        ("pyarrow", ["convert", "a.csv", "b.parquet"]),
        ("matplotlib", ["report", "a.csv"]),
        ("shtab", ["completion", "bash"]),
        ("starlette", ["schema", "plant"]),
        ("uvicorn", ["serve", "--demo"]),
        ("yaml", ["import", "device.yaml"]),
        ("nats", ["hub", "nats://127.0.0.1:1", "--parquet", "rows", "--once"]),
        ("nats", ["fleet", "status", "--nats", "nats://127.0.0.1:1"]),
    ],
)
def test_a_missing_library_is_reported_with_its_pip_command_and_status_2(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, library: str, words: list[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with open_writer(tmp_path / "a.csv", METADATA) as writer:
        writer.write(counting(1, 0))
    Path("device.yaml").write_text("a: 1")
    for module in ("mdf4", "hdf5"):
        monkeypatch.delitem(sys.modules, f"multidrop.recording.{module}", raising=False)
    monkeypatch.setitem(sys.modules, library, None)
    status, out, err = run(*words)
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert ": pip install " in err


@table("seconds", ["ten", "0", "-1", "nan", "inf"])
def test_an_invalid_polling_time_is_reported_in_one_sentence(run: Run, seconds: str) -> None:
    status, out, err = run("poll", "plant.toml", f"--seconds={seconds}")
    assert (status, out) == (2, "")
    assert f"argument --seconds: '{seconds}' is not a number of seconds above 0" in err


def test_the_file_name_of_a_report_must_end_in_html(run: Run, tmp_path: Path) -> None:
    (tmp_path / "a.csv").touch()
    status, _, err = run("report", tmp_path / "a.csv", "--out", tmp_path / "a.txt")
    assert (status, err) == (2, f"multidrop: {tmp_path / 'a.txt'}: a report's name must end in .html\n")


@table(
    ("name", "ports", "sentence"),
    [
        (
            "hall/1",
            "ports",
            "--ports cannot name a file after line 'hall/1': rename the line to a name without /",
        ),
        ("a", "plant.toml", "--ports plant.toml is a file: name a directory; it is created if missing"),
    ],
)
def test_the_simulate_command_reports_unusable_names_for_port_links(
    run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str, ports: str, sentence: str
) -> None:
    drive = '[[line.drive]]\nname = "a"\naddress = 1\nmodel = "yd1000"\n'
    monkeypatch.chdir(tmp_path)
    Path("plant.toml").write_text(f'[[line]]\nname = "{name}"\nport = "x"\n{drive}')
    assert run("simulate", "plant.toml", "--ports", ports) == (2, "", f"multidrop: {sentence}\n")


def test_a_missing_ledger_file_is_reported(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", "/state")
    sentence = f"there is no EEPROM ledger {tmp_path}/none; the default file is /state/multidrop/wear.sqlite"
    assert run("wear", "--ledger", tmp_path / "none") == (2, "", f"multidrop: {sentence}\n")


@table(
    ("words", "sentence"),
    [
        (
            ["write", "/dev/ttyX", TOY, "1", "output_current", "1"],
            "output_current of toy@1 is not written: it is a reading",
        ),
        (
            ["write", "/dev/ttyX", TOY, "1", "sealed", "1"],
            "sealed of toy@1 is not written: it is the maker's",
        ),
        (
            ["write", "/dev/ttyX", TOY, "1", "frequency", "5"],
            "Write frequency = 5.00 Hz to toy@1 on /dev/ttyX? There is no terminal to ask on: "
            "add --yes to confirm",
        ),
        (
            ["start", "/dev/ttyX", TOY, "1"],
            "Start the motor of toy@1 on /dev/ttyX? There is no terminal to ask on: add --yes to confirm",
        ),
        (
            ["start", "/dev/ttyX", TOY, "1", "--frequency", "20.5", "--direction", "reverse"],
            "Start the motor of toy@1 on /dev/ttyX at 20.5 Hz, reverse? There is no terminal to ask on: "
            "add --yes to confirm",
        ),
        (
            ["set-frequency", "/dev/ttyX", TOY, "1", "20"],
            "Change the frequency setpoint of toy@1 on /dev/ttyX to 20 Hz? There is no terminal to ask on: "
            "add --yes to confirm",
        ),
    ],
)
def test_forbidden_writes_print_a_sentence_and_return_1(run: Run, words: list[str], sentence: str) -> None:
    assert run(*words) == (1, "", f"multidrop: {sentence}\n")


@pytest.mark.parametrize(
    ("words", "advice"),
    [
        (
            ["set-frequency", "/dev/ttyX", "invt-che", "1", "20"],
            "frequency: add --option maximum_frequency=HZ",
        ),
        (
            ["start", "/dev/ttyX", "innovert-ibd", "1", "--direction", "forward"],
            "which of them turns the motor forward and add --option forward_bit=N",
        ),
        (
            ["write", "/dev/ttyX", "yd1000", "1", "control", "run"],
            "use `multidrop start`, `multidrop stop`, `multidrop jog`, `multidrop reset-fault` (manual",
        ),
    ],
)
def test_the_error_for_a_forbidden_write_suggests_a_command_or_option(
    run: Run, words: list[str], advice: str
) -> None:
    status, out, err = run(*words)
    assert (status, out) == (1, "")
    assert advice in err


def test_advice_for_a_drive_in_a_plant_refers_to_the_plant_file(run: Run, tmp_path: Path) -> None:
    plant = tmp_path / "plant.toml"
    plant.write_text(
        '[[line]]\nname = "hall"\nport = "/dev/ttyX"\n'
        '[[line.drive]]\nname = "fan"\nmodel = "invt-che"\naddress = 1\n'
    )
    status, out, err = run("set-frequency", plant, "fan", "20")
    assert (status, out) == (1, "")
    assert "maximum frequency: write maximum_frequency = HZ below its [[line.drive]]" in err


def test_error_advice_names_a_command_instead_of_a_python_method() -> None:
    reset = WriteForbidden(
        "x has a fault: remove its cause, then call reset_fault()", advice=Advice.call("reset_fault")
    )
    assert reset.for_command_line() == "x has a fault: remove its cause, then run `multidrop reset-fault`"
    declare = WriteForbidden("and declare confirmed = 1 if it is", advice=Advice.declare("confirmed", 1))
    assert declare.for_command_line() == "and add --option confirmed=1 if it is"
    in_plant = declare.for_command_line(in_plant=True)
    assert in_plant == "and write confirmed = 1 below its [[line.drive]] if it is"
    assert reset.for_command_line(in_plant=True) == reset.for_command_line()
    assert WriteForbidden("use emergency_stop()").for_command_line() == "use emergency_stop()"


def test_every_kind_of_error_advice_has_a_command_or_option() -> None:
    """The command line replaces advice for programs, such as reset_fault(), by a command or an option."""
    erman, che, ibd = ErmanERG220(1), InvtCHE(1), InnovertIBD(1)
    answers = {"last_fault": 64, "status": 4, "setpoint": 0.0, "frequency_setpoint": 0.0}
    for script, command in (
        (erman.start.script(), "then run `multidrop reset-fault` and add --option acknowledged_fault=64"),
        (che.start.script(), "remove its cause, then run `multidrop reset-fault`"),
        (ibd.identify.script(), "and add --option confirmed=1 if the drive is an IBD"),
    ):
        with pytest.raises(WriteForbidden) as refused:
            carry_out(script, lambda step: step.register.decode(answers.get(step.register.name, 0)))
        assert refused.value.for_command_line().endswith(command)


@pytest.mark.parametrize(
    ("port", "sentence"),
    [
        ("/dev/no-such-port", "/dev/no-such-port: there is no such port"),
        ("/dev/null", "/dev/null: it is not a serial port"),
    ],
)
def test_unusable_ports_print_a_sentence_and_return_1(run: Run, port: str, sentence: str) -> None:
    assert run("read", port, TOY, 1) == (1, "", f"multidrop: {sentence}\n")


def test_a_command_in_a_thread_changes_no_signal_handlers(capsys: pytest.CaptureFixture[str]) -> None:
    """Only the main thread can change signal handlers, so a command in another thread must not try."""
    found: list[int] = []
    before = signal.getsignal(signal.SIGTERM)
    thread = threading.Thread(target=lambda: found.append(main(["models", TOY])))
    thread.start()
    thread.join()
    assert found == [0]
    assert "TOY T1" in capsys.readouterr().out
    assert signal.getsignal(signal.SIGTERM) is before


PRINTING = [["models", "yd1000"], ["--help"], ["--version"], []]


def in_a_process(words: list[str]) -> list[str]:
    return [sys.executable, "-c", f"import sys; from multidrop.cli import main; sys.exit(main({words}))"]


@pytest.mark.long
@table("words", PRINTING)
def test_output_on_a_full_disk_fails_with_one_sentence(words: list[str]) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(in_a_process(words), stdout=full, stderr=subprocess.PIPE, text=True)
    assert (done.returncode, done.stderr) == (1, "multidrop: No space left on device\n")


@pytest.mark.long
@table("words", PRINTING)
def test_output_into_a_closed_pipe_returns_0(words: list[str]) -> None:
    with BoundProcess(in_a_process(words), stdout=subprocess.PIPE, stderr=subprocess.PIPE) as command:
        assert command.stdout is not None
        command.stdout.close()
        command.stdout = None
        assert command.communicate()[1] == b""
    assert command.returncode == 0


@pytest.mark.long
@pytest.mark.parametrize(
    ("closed", "words", "status"),
    [(0, ["start", "/dev/ttyX", "yd1000", "1"], 1), (1, ["models", "yd1000"], 0), (2, ["models", "zzz"], 2)],
)
def test_a_closed_standard_stream_causes_no_traceback(closed: int, words: list[str], status: int) -> None:
    done = subprocess.run(
        in_a_process(words), capture_output=True, text=True, preexec_fn=lambda: os.close(closed)
    )
    assert (done.returncode, done.stdout) == (status, "")
    assert "Traceback" not in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("closed", [0, 1, 2])
def test_the_descriptor_of_a_closed_output_stream_is_not_reused(closed: int) -> None:
    """A serial port with that descriptor would receive the printed output."""
    code = (
        "import os, multidrop.cli as cli; cli.main(['--version']); os._exit(os.open(os.devnull, os.O_RDONLY))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, preexec_fn=lambda: os.close(closed)
    )
    assert done.returncode > 2
