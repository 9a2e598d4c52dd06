"""The command line as a whole: help, exit statuses and error sentences. Also `models`."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from importlib.metadata import version
from pathlib import Path

import pytest
from batches import METADATA, counting
from commands import TOY, Run
from kills import BoundProcess
from tables import table

from multidrop.cli import COMMANDS, main
from multidrop.cli.fleet import ACTIONS as FLEET
from multidrop.drive import Advice, WriteForbidden, carry_out
from multidrop.families import MODELS, ErmanERG220, InnovertIBD, InvtCHE
from multidrop.families.registry import SHIPPED, find_model
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
            "may be left out: then a share and the seed are 0, and the longest times and bursts are as",
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
            f"control can only be written; see `multidrop models {TOY}`",
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
            "sockt://10.0.0.7:4001: there is no sockt://; a URL is such as tcp://10.0.0.7, "
            "socket://10.0.0.7:4001 or rfc2217://10.0.0.7:4001",
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
def test_a_mistaken_command_is_reported_in_one_sentence_with_status_2(
    run: Run, words: list[str], sentence: str
) -> None:
    assert run(*words) == (2, "", f"multidrop: {sentence}\n")


def test_version_prints_the_version_of_the_package(run: Run) -> None:
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


def test_a_reports_file_name_must_end_in_html(run: Run, tmp_path: Path) -> None:
    (tmp_path / "a.csv").touch()
    status, _, err = run("report", tmp_path / "a.csv", "--out", tmp_path / "a.txt")
    assert (status, err) == (2, f"multidrop: {tmp_path / 'a.txt'}: a report's name must end in .html\n")


def test_a_line_with_a_slash_in_its_name_is_not_simulated(run: Run, tmp_path: Path) -> None:
    plant = tmp_path / "plant.toml"
    plant.write_text(
        '[[line]]\nname = "hall/1"\nport = "x"\n[[line.drive]]\nname = "a"\naddress = 1\nmodel = "yd1000"\n'
    )
    status, _, err = run("simulate", plant, "--ports", tmp_path / "ports")
    assert (status, err) == (2, "multidrop: line 'hall/1' has a / in its name: rename it to link its port\n")


def test_a_file_in_place_of_the_directory_of_ports_is_refused(run: Run, tmp_path: Path) -> None:
    plant = tmp_path / "plant.toml"
    plant.write_text(
        '[[line]]\nname = "a"\nport = "x"\n[[line.drive]]\nname = "a"\naddress = 1\nmodel = "yd1000"\n'
    )
    assert run("simulate", plant, "--ports", plant) == (
        2,
        "",
        f"multidrop: --ports {plant} is a file: name a directory; it is created if missing\n",
    )


def test_a_missing_ledger_file_is_reported_with_the_default_path(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", "/state")
    sentence = f"there is no ledger {tmp_path}/none; the default is /state/multidrop/wear.sqlite"
    assert run("wear", "--ledger", tmp_path / "none") == (2, "", f"multidrop: {sentence}\n")


def test_a_sheet_shows_addresses_that_do_not_wear_eeprom(run: Run, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(
        "from multidrop.families.invt_che import InvtCHE, parameter\n\n\n"
        'class Mine(InvtCHE):\n    """With a parameter."""\n\n'
        '    ramp = parameter(11, "s", step=0.1, span=(0, 3600))\n'
    )
    status, out, _ = run("models", f"{tmp_path / 'mine.py'}:Mine")
    assert status == 0
    assert "        kept: EEPROM; written at 800BH, in RAM" in out


def test_a_sheet_shows_which_writes_may_move_the_motor(run: Run, tmp_path: Path) -> None:
    (tmp_path / "moved.py").write_text(
        "from multidrop import Drive, command, setting\n\n\n"
        'class Moved(Drive):\n    """Moved."""\n\n'
        "    speed = command(1, moves=False)\n    jog_bit = setting(2, moves=True)\n    unsaid = command(3)\n"
    )
    family = f"{tmp_path / 'moved.py'}:Moved"
    _, out, _ = run("models", family)
    _, _, registers = out.partition("holding registers")
    remarks = [line.strip() for line in registers.splitlines() if line.startswith(" " * 8)]
    assert remarks == [
        "a write never starts, stops or resets",
        "kept: not stated; a write may move the motor",
    ]
    _, out, _ = run("models", family, "--json")
    told = {register["name"]: register["moves"] for register in json.loads(out)["registers"]}
    assert told == {"speed": False, "jog_bit": True, "unsaid": None}


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
def test_a_forbidden_write_is_reported_in_one_sentence_with_status_1(
    run: Run, words: list[str], sentence: str
) -> None:
    assert run(*words) == (1, "", f"multidrop: {sentence}\n")


@pytest.mark.parametrize(
    ("words", "advice"),
    [
        (["set-frequency", "/dev/ttyX", "invt-che", "1", "20"], "P0.04: add --option maximum_frequency=HZ"),
        (
            ["start", "/dev/ttyX", "innovert-ibd", "1", "--direction", "forward"],
            "which of bits 2 and 3 turns it forward, and add --option forward_bit=N",
        ),
        (
            ["write", "/dev/ttyX", "yd1000", "1", "control", "run"],
            "use `multidrop start`, `multidrop stop`, `multidrop jog`, `multidrop reset-fault` (manual",
        ),
    ],
)
def test_a_forbidden_write_shows_the_command_to_type(run: Run, words: list[str], advice: str) -> None:
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
    assert "P0.04: write maximum_frequency = HZ below its [[line.drive]]" in err


def test_advice_for_programs_is_converted_for_the_command_line() -> None:
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


def test_each_kind_of_advice_in_errors_has_a_command_that_replaces_it() -> None:
    """The command line replaces advice for programs, such as reset_fault(), by a command or an option."""
    erman, che, ibd = ErmanERG220(1), InvtCHE(1), InnovertIBD(1)
    answers = {"last_fault": 64, "status": 4, "setpoint": 0.0, "frequency_setpoint": 0.0}
    for script, command in (
        (erman.start.script(), "then run `multidrop reset-fault` and add --option acknowledged_fault=64"),
        (che.start.script(), "remove its cause, then run `multidrop reset-fault`"),
        (ibd.identify.script(), "and add --option confirmed=1 if it is an IBD"),
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
def test_a_port_that_cannot_be_opened_is_reported_in_one_sentence_with_status_1(
    run: Run, port: str, sentence: str
) -> None:
    assert run("read", port, TOY, 1) == (1, "", f"multidrop: {sentence}\n")


# ---- models ----


def test_models_lists_the_families(run: Run) -> None:
    status, out, _ = run("models")
    assert status == 0
    lines = [line for line in out.splitlines()[1:-2] if line[0] != " "]  # indented lines continue a title
    assert [line.split()[0] for line in lines] == [*MODELS, *SHIPPED]
    assert max(map(len, out.splitlines())) <= 80
    titles = " ".join(out.split())
    assert [family.title for family in MODELS.values() if family.title not in titles] == []
    _, out, _ = run("models", "--json")
    assert [family["model"] for family in json.loads(out)] == [*MODELS, *SHIPPED]


def test_a_familys_sheet_has_every_fact(run: Run) -> None:
    _, out, _ = run("models", TOY)
    for line in (
        "addresses       1-31",
        "baud rates      9600, 19200 (the first is the default)",
        "rtu formats     8N1, 8E1, 8O1, 8N2",
        "rtu silence     3.5 characters, above 19200 bit/s 1.75 ms, before and after a",
        "ascii silence   none",
        "verbs           start, stop, set-frequency, state",
        "  02H  illegal address",
        "  rated_frequency  rated frequency of the motor (10 to 400 Hz)",
        "holding registers (read 03H, at most 10; write 06H)",
        "  0003H  mystery            reading  scale not stated",
        "        the manual gives no scale",
        "  000AH  acceleration_time  setting  0.1 s             0.1 to 600",
        "        kept: EEPROM; only while stopped",
        "        kept: not stated; never written: it is the maker's",
        "        0 NONE, 1 OVERCURRENT",
        "- the scale of `mystery`.",
    ):
        assert any(shown.startswith(line) for shown in out.splitlines()), f"{line!r} is not in\n{out}"


def test_a_familys_json_has_every_register(run: Run) -> None:
    _, out, _ = run("models", TOY, "--json")
    sheet = json.loads(out)
    by_name = {register["name"]: register for register in sheet["registers"]}
    assert len(by_name) == sheet["register_count"] == 9
    assert by_name["acceleration_time"]["span"] == [0.1, 600]
    assert by_name["fault"]["values"] == {"NONE": 0, "OVERCURRENT": 1}
    assert by_name["mystery"]["step"] is None


@table(
    ("name", "facts"),
    [
        (
            "erman-er-g-220",
            [
                "b.010 address (1 from the factory), set while the motor stands",
                "remote b.001 must be 2 and b.002 5 (RS-485)",
                "broadcast the manual calls address 0 one, and does not say that nobody answers: none",
                "coils (read 01H, at most 12; write 05H)",
                "only verbs write it, except ON",
                "(0 to 4294967295)",
            ],
        ),
        (
            "invt-che",
            [
                "PC.00 address (1 from the factory), PC.01 baud rate",
                "PC.02 format (0 to 5: 8N1, 8E1, 8O1, 8N2, 8E2, 8O2",
                "remote P0.01 must be 2",
                "only verbs write it, except STOP, COAST, STOP_JOG",
            ],
        ),
        (
            "innovert-ibd",
            [
                "rtu silence 10 ms before and after",
                "ascii silence none",
                "PrH.02 address",
                "remote set Prb.01",
            ],
        ),
        ("delixi-modbus", ["P04.30 address", "P00.00 must be 2 (RS-485), and P00.01 1", "0 ASCII_7N2"]),
        (
            "delixi-native",
            [
                "delixi formats 8N1",
                "delixi silence none",
                "until measured, less than 80 ms by its manual; timeout 150 ms",
                "P00.00 must be 2",
                "0 N81, 1 E81",
            ],
        ),
        (
            "yd1000",
            [
                "24 characters (27.5 ms at 9600 bit/s) until measured; timeout 500 ms",
                "F802 address",
                "at least minimum_frequency; at most maximum_frequency",
                "except COMMAND_VALID|FREQUENCY_VALID, COMMAND_VALID,",
                "never together: RESET and RUN, RESET and JOG",
                "what it is from the factory is not stated",
            ],
        ),
    ],
)
def test_a_sheet_has_drive_settings_and_limits_of_values(run: Run, name: str, facts: list[str]) -> None:
    """Settings and limits are printed in the words of the manual (ERMAN, section 3; YD1000, 4.3 and 6.1)."""
    _, out, _ = run("models", name)
    shown = " ".join(out.split())
    assert [fact for fact in facts if fact not in shown] == []
    assert "3.5 characters" not in shown or name in ("erman-er-g-220", "invt-che", "delixi-modbus")


def test_a_familys_json_has_the_limits_of_values(run: Run) -> None:
    _, out, _ = run("models", "yd1000", "--json")
    sheet = json.loads(out)
    by_name = {register["name"]: register for register in sheet["registers"]}
    upper = by_name["upper_limit_frequency"]  # values from 0.5 Hz to the highest frequency FH
    assert (upper["span"][0], upper["at_most"]) == (0.5, "maximum_frequency")
    speeds = [by_name[f"preset_speed_{number}"] for number in range(1, 8)]  # between both limits
    limits = {("minimum_frequency", "upper_limit_frequency")}
    assert {(speed["at_least"], speed["at_most"]) for speed in speeds} == limits
    assert by_name["control"]["harmless"] == [0xC000, 0x8000, 0xC800]
    assert by_name["control"]["never_together"] == [0x2400, 0x2100]
    assert by_name["acceleration_time"]["harmless"] is None
    assert sheet["response_delay_s"] == pytest.approx(24 * 11 / 9600)
    assert sheet["needed_silence_s"]["rtu"] == pytest.approx(24 * 11 / 9600)
    assert "F802" in sheet["line_parameters"]
    assert "reset_fault" in sheet["remote"]
    _, out, _ = run("models", "delixi-native", "--json")
    sheet = json.loads(out)
    assert (sheet["needed_silence_s"], sheet["answering_time_s"]) == ({"delixi": 0}, 0.08)
    _, out, _ = run("models", "erman-er-g-220", "--json")
    assert "address 0" in json.loads(out)["no_broadcasts"]


@table("name", [*MODELS, *SHIPPED])
def test_every_sheet_is_at_most_80_columns_wide(run: Run, name: str) -> None:
    _, out, _ = run("models", name)
    too_wide = [line for line in out.splitlines() if len(line) > 80]
    assert not too_wide
    assert all(register in out for register in find_model(name).registers)


NOTES = """
Where the document errs or is silent, the safest interpretation applies:

- The example of function 04 has the checksum of function 03's example. Its
  reply has a byte count of 10H for 5 registers: the library requires the byte
  count that fits the request.
- The example of function 06"""


def test_a_sheet_keeps_indented_lines_of_notes(run: Run, tmp_path: Path) -> None:
    notes = "Two words:\n    0 off\n    1 on\n* one\n* two"
    docstring = f'"""Mine.\n\n{notes}"""'.replace("\n", "\n    ")
    (tmp_path / "mine.py").write_text(
        "from multidrop import Drive, reading\n\n\n"
        f"class Mine(Drive):\n    {docstring}\n\n    speed = reading(1)\n"
    )
    assert run("models", f"{tmp_path / 'mine.py'}:Mine")[1].endswith(f"Mine.\n\n{notes}\n")


def test_a_sheet_wraps_its_notes_as_paragraphs(run: Run) -> None:
    _, out, _ = run("models", "erman-er-g-220")
    assert NOTES in out
    assert "refuse others.\n\nNo ranges, defaults" in out


# ---- signals ----


def test_a_command_can_run_in_a_thread_and_keeps_signal_handlers(capsys: pytest.CaptureFixture[str]) -> None:
    """Only the main thread can change signal handlers, so a command in another thread must not try."""
    found: list[int] = []
    before = signal.getsignal(signal.SIGTERM)
    thread = threading.Thread(target=lambda: found.append(main(["models", TOY])))
    thread.start()
    thread.join()
    assert found == [0]
    assert "TOY T1" in capsys.readouterr().out
    assert signal.getsignal(signal.SIGTERM) is before


# ---- output that cannot be written ----


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
def test_no_file_gets_the_descriptor_of_a_closed_stream(closed: int) -> None:
    """A serial port with that descriptor would receive the printed output."""
    code = (
        "import os, multidrop.cli as cli; cli.main(['--version']); os._exit(os.open(os.devnull, os.O_RDONLY))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, preexec_fn=lambda: os.close(closed)
    )
    assert done.returncode > 2
