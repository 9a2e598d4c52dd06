"""Commands for one drive, run against a simulated drive."""

from __future__ import annotations

import argparse
import io
import json
import os
import select
import subprocess
import sys
import time
from pathlib import Path

import pytest
from commands import TOY, BoundProcess, Run
from lines import Faulty, patient
from simulated_bus import SimulatedBus
from tables import table
from toy import Status, Toy

import multidrop.cli
from multidrop.cli.support.output import confirm
from multidrop.cli.support.values import nearest_value
from multidrop.control.eeprom_ledger import Ledger, LedgerCell
from multidrop.core import Message
from multidrop.errors import WriteForbidden
from multidrop.families.innovert_ibd import InnovertIBD
from multidrop.families.invt_che import InvtCHE
from multidrop.sim import MotorDrive, simulated
from multidrop.sim.drive import SimulatedDrive
from multidrop.sim.simulator import Simulator
from multidrop.sim.wire import Wire

pytestmark = pytest.mark.usefixtures("_turns_awaited")

DOG = "watchdog: The document names no watchdog: the motor runs on when the client dies."


def test_the_read_command_prints_all_readings_and_settings_with_units(run: Run, port: str) -> None:
    assert run("read", port, TOY, 1) == (
        0,
        "output_frequency      49.9  Hz\n"
        "output_current        3.25  A\n"
        "mystery                777  (scale not stated)\n"
        "fault                 NONE\n"
        "status             RUNNING\n"
        "acceleration_time     10.0  s\n"
        "sealed                   0\n",
        "",
    )


@pytest.mark.parametrize(
    ("variables", "title"),
    [
        ({"LANG": "ru_RU.UTF-8"}, "выходная частота"),
        ({"LANG": "ru_RU.UTF-8", "LC_MESSAGES": "zh_CN"}, "输出频率"),
        ({"LC_MESSAGES": "ru_RU", "LC_ALL": "en_US"}, ""),
    ],
)
def test_register_titles_are_printed_in_the_users_language(
    run: Run, port: str, monkeypatch: pytest.MonkeyPatch, variables: dict[str, str], title: str
) -> None:
    monkeypatch.delenv("LC_ALL")
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    _, out, _ = run("read", port, TOY, 1, "output_frequency")
    assert out == f"output_frequency  49.9  Hz  {title}".rstrip() + "\n"
    _, out, _ = run("models", TOY)
    assert title in out


def test_the_read_command_prints_registers_in_the_given_order(run: Run, port: str) -> None:
    status, out, _ = run("read", port, TOY, 1, "output_current", "output_frequency")
    assert (status, out) == (0, "output_current    3.25  A\noutput_frequency  49.9  Hz\n")


def test_the_read_command_prints_values_as_json(run: Run, port: str) -> None:
    _, out, _ = run("read", port, TOY, 1, "output_current", "mystery", "fault", "status", "--json")
    assert json.loads(out) == {
        "drive": "toy@1",
        "model": "toy",
        "address": 1,
        "values": {
            "output_current": {"value": 3.25, "unit": "A"},
            "mystery": {"value": None, "raw": 777},
            "fault": {"value": "NONE", "raw": 0},
            "status": {"value": ["RUNNING"], "raw": 1},
        },
    }


@table(
    ("name", "raw", "shown", "value"),
    [
        ("fault", 99, "99  (no name in the manual)", None),
        ("status", 0x1101, "RUNNING, bit 8, bit 12", ["RUNNING", "bit 8", "bit 12"]),
    ],
)
def test_a_value_or_bit_without_a_name_is_shown_as_a_number(
    run: Run, port: str, toy: SimulatedDrive, name: str, raw: int, shown: str, value: list[str] | None
) -> None:
    for cell in toy.memory.of(Toy.registers[name]):
        cell.raw = raw
    assert run("read", port, TOY, 1, name)[1] == f"{name}  {shown}\n"
    told = json.loads(run("read", port, TOY, 1, name, "--json")[1])
    assert told["values"] == {name: {"value": value, "raw": raw}}


def test_the_read_command_prints_the_other_registers_if_the_drive_refuses_one(run: Run, port: str) -> None:
    status, out, err = run("read", port, TOY, 2, "status", "fault")
    assert (status, out) == (1, "status  none\nfault         refused: code 02H, illegal address\n")
    assert err == ""


MUTE = """\
from enum import IntEnum
from multidrop.drive.family import Drive, verb, write
from multidrop.drive.register import command, reading

class Word(IntEnum):
    STOP = 0

class Mute(Drive):
    model = "mute"
    speed = reading(1, "rpm")
    control = command(0x14, Word)

    @verb
    def stop(self):
        yield from write(Mute.control, Word.STOP)
"""


def test_a_drive_with_an_unreadable_state_can_be_stopped(
    run: Run, port: str, toy: SimulatedDrive, tmp_path: Path
) -> None:
    (tmp_path / "mute.py").write_text(MUTE)
    words = ("stop", port, f"{tmp_path}/mute.py:Mute", 1)
    status, out, err = run(*words)
    is_run = f"multidrop: {tmp_path}/mute.py is run as Python: a user's model is a program\n"
    assert (status, err) == (0, is_run)
    assert out.startswith("mute@1: stop done; state: the family cannot say")
    assert json.loads(run(*words, "--json")[1])["state"] is None
    writes = [(write.address, write.raw) for write in toy.counters.writes]
    assert len(writes) >= 2  # on a busy machine, the stop may be repeated
    assert set(writes) == {(0x14, 0)}


def test_the_write_command_prints_its_outcome_on_one_line(run: Run, port: str, toy: SimulatedDrive) -> None:
    toy["status"] = Status(0)
    assert run("write", port, TOY, 1, "acceleration_time", "12.5", "--yes") == (
        0,
        "toy@1: acceleration_time = 12.5 s: done (read back)\n",
        "",
    )
    assert toy["acceleration_time"] == 12.5
    assert run("write", port, TOY, 1, "frequency", "25", "--yes") == (
        0,
        "toy@1: frequency = 25.00 Hz: done (cannot be read back)\n",
        "",
    )
    assert toy["frequency"] == 25


def test_a_standstill_only_write_fails_while_the_motor_runs(run: Run, port: str, toy: SimulatedDrive) -> None:
    status, out, err = run("write", port, TOY, 1, "acceleration_time", "12.5", "--yes")
    assert (status, out) == (1, "")
    assert "acceleration_time of toy@1 is not written: it can be written only at standstill" in err
    assert toy["acceleration_time"] == 10.0


def test_the_write_command_prints_its_outcome_as_json(run: Run, port: str) -> None:
    _, out, _ = run("write", port, TOY, 1, "frequency", "25", "--json", "--yes")
    assert json.loads(out) == {
        "drive": "toy@1",
        "register": "frequency",
        "value": 25.0,
        "unit": "Hz",
        "outcome": "done",
    }


def test_the_write_command_returns_1_if_the_drive_clamps_the_value(run: Run, port: str) -> None:
    assert run("write", port, TOY, 2, "acceleration_time", "30", "--yes") == (
        1,
        "",
        "toy@2: acceleration_time = 30.0 s: taken as 20.0 s\n",
    )


def test_a_rounding_error_of_a_calculated_value_is_not_reported(capsys: pytest.CaptureFixture[str]) -> None:
    setpoint = InvtCHE.registers["setpoint"]
    assert nearest_value(setpoint, 22 / 1000 * 100) == 2.2
    assert capsys.readouterr().err == ""
    assert nearest_value(setpoint, 12.0049999 / 50 * 100) == 24.01
    assert "24.0099998 becomes 24.01 %" in capsys.readouterr().err


def test_a_value_finer_than_the_register_step_is_rounded_with_a_warning(
    run: Run, port: str, toy: SimulatedDrive
) -> None:
    """The rounded value is sent to the drive and reported to the user."""
    note = "multidrop: frequency has steps of 0.01 Hz: 12.345 becomes 12.34 Hz\n"
    assert run("write", port, TOY, 1, "frequency", "12.345", "--yes") == (
        0,
        "toy@1: frequency = 12.34 Hz: done (cannot be read back)\n",
        note,
    )
    assert run("set-frequency", port, TOY, 1, "12.345", "--yes") == (
        0,
        "toy@1: set-frequency done at frequency = 12.34 Hz; state: running\n",
        note,
    )
    status, out, err = run("start", port, TOY, 1, "--frequency", "12.345", "--yes", "--json")
    assert (status, err) == (0, note)
    assert json.loads(out)["setpoint"] == {"register": "frequency", "value": 12.34, "unit": "Hz"}
    assert {write.raw for write in toy.counters.writes if write.name == "frequency"} == {1234}
    status, out, err = run("write", port, TOY, 1, "frequency", "12.345")
    assert (status, out) == (1, "")
    assert f"{note}multidrop: Write frequency = 12.34 Hz to toy@1" in err


def test_set_frequency_prints_the_setpoint_in_the_registers_unit(run: Run) -> None:
    che = InvtCHE(1, maximum_frequency=50)
    with Simulator([Wire([simulated(che)], unpaced=True)]) as simulator:
        words = ("invt-che", 1, "12.3456", "--option", "maximum_frequency=50", "--yes")
        status, out, _ = run("set-frequency", simulator.wires[0].path, *words)
    assert status == 0
    assert "set-frequency done at setpoint = 24.69 %;" in out


@pytest.mark.slow
def test_start_needs_a_frequency_if_the_setpoint_is_unreadable(run: Run) -> None:
    """A command does not know the setpoint that an earlier command has written."""
    with Simulator([Wire([simulated(InnovertIBD(1))], unpaced=True)]) as simulator:
        words = (simulator.wires[0].path, "innovert-ibd", 1, "--yes")
        sentence = "multidrop: innovert-ibd@1 cannot report its setpoint: add --frequency HZ\n"
        assert run("start", *words) == (1, "", sentence)
        assert run("start", *words, "--frequency", 20)[0] == 0


@patient
def test_the_start_command_writes_the_setpoint_first(run: Run, port: str, toy: SimulatedDrive) -> None:
    assert run("start", port, TOY, 1, "--frequency", 20, "--yes")[0] == 0
    assert [write.name for write in toy.counters.writes] == ["frequency", "control"]


@pytest.mark.parametrize("at", ["opening", "setpoint", "reading"])
def test_the_start_command_sends_no_start_after_a_suspension(
    run: Run, monkeypatch: pytest.MonkeyPatch, at: str
) -> None:
    """The user may press Ctrl-Z during the command, and continue it hours later."""
    sim = simulated(InvtCHE(1, maximum_frequency=50))
    assert isinstance(sim, MotorDrive)
    line = SimulatedBus(sim)
    places = {"setpoint": lambda each: each.start == 0x2000, "reading": lambda each: each.start == 0x3016}

    def answer(request: Message) -> None:
        if at in places and places[at](request):
            line.slept = 3600.0

    def open_late() -> SimulatedBus:
        line.slept = 3600.0 if at == "opening" else 0.0
        return line

    monkeypatch.setattr(line, "answers", answer)
    monkeypatch.setattr(line, "open", open_late)
    words = ("start", "hall", "invt-che", 1, "--yes", "--frequency", 20, "--option", "maximum_frequency=50")
    status, _, err = run(*words)
    assert (status, "was not sent" in err) == (1, True)
    assert not sim.motor.energised
    assert line.slept


@patient
@pytest.mark.parametrize(("answer", "writes"), [("y", 1), ("yes", 1), ("n", 0), ("", 0), ("start", 0)])
def test_the_start_command_needs_a_yes_on_a_terminal(
    run: Run, port: str, toy: SimulatedDrive, monkeypatch: pytest.MonkeyPatch, answer: str, writes: int
) -> None:
    terminal = io.StringIO(answer + "\n")
    monkeypatch.setattr(terminal, "isatty", lambda: True)
    monkeypatch.setattr("sys.stdin", terminal)
    status, _, err = run("start", port, TOY, 1)
    assert err.startswith(f"Start the motor of toy@1 on {port}? [y/N] ")
    assert (status == 0) == bool(writes)
    assert len(toy.counters.writes) == writes


def test_input_typed_before_a_question_is_ignored(monkeypatch: pytest.MonkeyPatch) -> None:
    """An impatient user may have typed a second "y" as an answer to the previous question."""
    terminal, program = os.openpty()

    class Screen(io.StringIO):
        def write(self, text: str) -> int:
            if "[y/N]" in text:
                os.write(terminal, b"n\n")
            return super().write(text)

    os.write(terminal, b"y\n")
    with os.fdopen(program) as keyboard, os.fdopen(terminal, "rb"):
        assert select.select([keyboard], [], [], 10)[0]  # wait until the typed input has arrived
        monkeypatch.setattr("sys.stdin", keyboard)
        monkeypatch.setattr("sys.stderr", Screen())
        with pytest.raises(WriteForbidden, match="nothing was sent"):
            confirm("Start the motor of pump?", argparse.Namespace(yes=False))


def test_every_write_is_recorded_in_the_audit_log(run: Run, port: str, tmp_path: Path) -> None:
    log = tmp_path / "audit.jsonl"
    run("set-frequency", port, TOY, 1, 20, "--yes", "--audit", log)
    run("start", port, TOY, 1, "--yes", "--audit", log)
    run("stop", port, TOY, 1, "--audit", log)
    noted = [json.loads(line) for line in log.read_text().splitlines()]
    assert [
        (record["drive"], record["write"], record.get("sent", "")[:17], record["outcome"]) for record in noted
    ] == [
        ("toy@1", "frequency = 20.00 Hz", "01 06 00 15 07 D0", "done"),
        ("toy@1", "control = RUNNING", "01 06 00 14 00 01", "done"),
        ("toy@1", "stop", "", "called"),
        ("toy@1", "stop", "01 06 00 14 00 00", "stopped"),
    ]


@pytest.mark.parametrize("log", ["none/audit.jsonl", "."])
def test_a_stop_is_sent_even_if_its_audit_log_cannot_be_opened(
    run: Run, port: str, toy: SimulatedDrive, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, log: str
) -> None:
    monkeypatch.chdir(tmp_path)
    status, out, err = run("stop", port, TOY, 1, "--audit", log)
    assert status == 0
    assert out.startswith("toy@1: stop done")
    assert err.startswith(f"multidrop: {log}: ")
    assert err.endswith(": the stop is sent, not logged\n")
    assert toy.counters.writes
    status, out, err = run("set-frequency", port, TOY, 1, 5, "--yes", "--audit", log)
    assert (status, out) == (2, "")


def test_ctrl_c_at_a_question_sends_no_request(
    run: Run, port: str, toy: SimulatedDrive, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted() -> str:
        raise KeyboardInterrupt

    terminal = io.StringIO()
    monkeypatch.setattr(terminal, "isatty", lambda: True)
    monkeypatch.setattr(terminal, "readline", interrupted)
    monkeypatch.setattr("sys.stdin", terminal)
    status, _, err = run("start", port, TOY, 1)
    assert (status, err.splitlines()[1:3]) == (130, ["multidrop: interrupted", "multidrop: nothing was sent"])
    assert not toy.counters.writes


def test_the_command_wear_shows_the_eeprom_ledger(run: Run, port: str, toy: SimulatedDrive) -> None:
    status, out, _ = run("wear")
    assert (status, out.endswith("no writes to EEPROM yet\n")) == (0, True)
    toy["status"] = Status(0)
    assert run("write", port, TOY, 1, "acceleration_time", "12.5", "--yes")[0] == 0
    status, out, err = run("write", port, TOY, 1, "acceleration_time", "13", "--yes")
    assert (status, out) == (1, "")
    assert "but only one write in 60 s is allowed" in err
    assert "no writes to EEPROM yet" in run("wear")[1]  # writes to a simulated drive are not counted
    assert not Ledger().enter(LedgerCell("/dev/ttyS7", 1, "toy", "acceleration_time"), time.time(), 60.0)
    head, row, *_ = run("wear")[1].splitlines()
    assert head.split() == ["PORT", "ADDRESS", "MODEL", "REGISTER", "WRITES", "THIS", "YEAR", "LEFT", "LAST"]
    assert row.split()[:7] == ["/dev/ttyS7", "1", "toy", "acceleration_time", "1", "1", "999"]
    (wear,) = json.loads(run("wear", "--json")[1])
    assert (wear["register"], wear["writes"], wear["left"]) == ("acceleration_time", 1, 999)
    Ledger().enter(LedgerCell("/dev/ttyS7", 2, "meter: Meter 2", "period"), time.time(), 60.0)
    assert run("wear")[1].splitlines()[2].split()[:4] == ["/dev/ttyS7", "2", "meter", "period"]


def test_the_commands_state_and_read_send_no_write(run: Run, port: str, toy: SimulatedDrive) -> None:
    run("state", port, TOY, 1)
    run("read", port, TOY, 1)
    assert not toy.counters.writes


def test_the_state_command_prints_words_or_json(run: Run, port: str) -> None:
    assert run("state", port, TOY, 1) == (0, f"running\n{DOG}\n", "")
    _, out, _ = run("state", port, TOY, 1, "--json")
    assert json.loads(out)["state"] == {"condition": "running", "direction": None, "fault": None, "note": ""}


@pytest.mark.slow
@pytest.mark.parametrize("words", [(9,), (1, "--baudrate", 19200)], ids=["no drive", "wrong baud rate"])
def test_a_silent_drive_is_reported_with_advice(run: Run, port: str, words: tuple[object, ...]) -> None:
    used = f"at address {words[0]} with {19200 if len(words) > 1 else 9600} 8N1"
    advice = "check its address, baud rate, format, wiring, and that it has power"
    sentence = f"multidrop: toy@{words[0]} does not answer {used}: {advice}\n"
    assert run("read", port, TOY, *words, "status") == (1, "", sentence)


def test_a_damaged_reply_is_reported_in_one_sentence(run: Run, toy: SimulatedDrive) -> None:
    wire = Faulty([toy], lambda reply: reply[:-1] + b"\0", unpaced=True)
    with Simulator([wire]):
        assert run("state", wire.path, TOY, 1) == (
            1,
            "",
            "multidrop: toy@1: bad checksum (received 01 03 02 00 00 B8 00)\n",
        )


def test_a_stop_on_a_port_in_use_is_reported_as_not_sent(run: Run, port: str) -> None:
    holder = (
        "import serial, sys; port = serial.Serial(sys.argv[1], exclusive=True);"
        "print('held', flush=True); sys.stdin.read()"
    )
    words = [sys.executable, "-c", holder, port]
    with BoundProcess(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == b"held\n"
        reason = f"{port}: it is in use by this or another program"
        assert run("read", port, TOY, 1) == (1, "", f"multidrop: {reason}\n")
        status, out, err = run("stop", port, "invt-che", 1)
        assert (status, out) == (1, "")
        assert err.startswith(f"multidrop: the stop was NOT sent: {reason}; use the hard-wired stop")
        other.communicate()


@pytest.mark.parametrize(
    "words", [["read", "{}", "invt-che", "1", "status"], ["scan", "{}"], ["sniff", "{}"]]
)
def test_undocumented_port_urls_are_refused_before_they_are_opened(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "precious").write_text("precious")
    port = f"spy:///dev/null?file={tmp_path}/precious"
    assert multidrop.cli.main([word.format(port) for word in words]) == 2
    assert "the scheme spy:// is not supported" in capsys.readouterr().err
    assert (tmp_path / "precious").read_text() == "precious"
