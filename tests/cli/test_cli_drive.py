"""Commands for one drive, run against a simulated drive."""

from __future__ import annotations

import argparse
import errno
import io
import json
import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from commands import TOY, Run
from examples import usually
from kills import BoundProcess
from lines import PATIENCE, Faulty, patient, until
from motors import ReceivedRequests
from terminals import closing_terminal
from toy import Status, Toy

import multidrop.cli
from multidrop.bus import Bus
from multidrop.cli.support.writing import confirm
from multidrop.control import eeprom_ledger as ledger
from multidrop.core import Message
from multidrop.errors import WriteForbidden
from multidrop.families.innovert_ibd import InnovertIBD
from multidrop.families.invt_che import InvtCHE
from multidrop.recording import open_recording
from multidrop.sim import MotorDrive, simulated
from multidrop.sim.drive import Reason, Refusal, SimulatedDrive
from multidrop.sim.memory import MemoryCell
from multidrop.sim.simulator import Simulator
from multidrop.sim.wire import Wire

pytestmark = pytest.mark.usefixtures("_turns_awaited")

DOG = "watchdog: The document names no watchdog: the motor runs on when the client dies."


class Stubborn(SimulatedDrive):
    """A drive that limits acceleration times to 20 s, and refuses to report its fault."""

    def accept(self, cell: MemoryCell, raw: int) -> int:
        return min(raw, 200) if cell.name == "acceleration_time" else super().accept(cell, raw)

    def read(self, function: int, start: int, count: int) -> list[int]:
        if start <= 4 < start + count:
            raise Refusal(Reason.READ_ADDRESS)
        return super().read(function, start, count)


@pytest.fixture
def toy() -> SimulatedDrive:
    return SimulatedDrive(Toy(1))


@pytest.fixture
def port(toy: SimulatedDrive) -> Iterator[str]:
    """Yield the port of a line with two drives, which have the addresses 1 and 2."""
    toy["output_frequency"] = 49.9
    toy["output_current"] = 3.25
    toy["mystery"] = 777
    toy["status"] = Status.RUNNING
    toy["acceleration_time"] = 10.0
    with Simulator([Wire([toy, Stubborn(Toy(2))], unpaced=True)]) as simulator:
        yield simulator.wires[0].path


def test_read_prints_all_readings_and_settings_with_units(run: Run, port: str) -> None:
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


def test_read_prints_registers_in_the_given_order(run: Run, port: str) -> None:
    status, out, _ = run("read", port, TOY, 1, "output_current", "output_frequency")
    assert (status, out) == (0, "output_current    3.25  A\noutput_frequency  49.9  Hz\n")


def test_read_prints_values_as_json(run: Run, port: str) -> None:
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


def test_a_value_without_a_name_is_shown_as_a_number(run: Run, port: str, toy: SimulatedDrive) -> None:
    for cell in toy.memory.of(Toy.fault):
        cell.raw = 99
    assert run("read", port, TOY, 1, "fault")[1] == "fault  99  (no name in the manual)\n"
    assert json.loads(run("read", port, TOY, 1, "fault", "--json")[1])["values"] == {
        "fault": {"value": None, "raw": 99}
    }


def test_a_bit_without_a_name_is_shown_by_its_number(run: Run, port: str, toy: SimulatedDrive) -> None:
    for cell in toy.memory.of(Toy.status):
        cell.raw = 0x1101
    assert run("read", port, TOY, 1, "status")[1] == "status  RUNNING, bit 8, bit 12\n"
    assert json.loads(run("read", port, TOY, 1, "status", "--json")[1])["values"] == {
        "status": {"value": ["RUNNING", "bit 8", "bit 12"], "raw": 0x1101}
    }


def test_a_refused_register_does_not_hide_the_others(run: Run, port: str) -> None:
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


def test_a_family_that_cannot_read_its_state_is_stopped(
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
    assert len(writes) >= 2  # the stop is repeated on a busy machine
    assert set(writes) == {(0x14, 0)}


def test_write_prints_its_outcome_on_one_line(run: Run, port: str, toy: SimulatedDrive) -> None:
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


def test_a_write_for_a_stopped_motor_is_refused_while_it_runs(
    run: Run, port: str, toy: SimulatedDrive
) -> None:
    status, out, err = run("write", port, TOY, 1, "acceleration_time", "12.5", "--yes")
    assert (status, out) == (1, "")
    assert "acceleration_time of toy@1 is not written: it changes only while the motor stands" in err
    assert toy["acceleration_time"] == 10.0


def test_write_prints_its_outcome_as_json(run: Run, port: str) -> None:
    _, out, _ = run("write", port, TOY, 1, "frequency", "25", "--json", "--yes")
    assert json.loads(out) == {
        "drive": "toy@1",
        "register": "frequency",
        "value": 25.0,
        "unit": "Hz",
        "outcome": "done",
    }


def test_a_clamped_value_is_reported_with_status_1(run: Run, port: str) -> None:
    assert run("write", port, TOY, 2, "acceleration_time", "30", "--yes") == (
        1,
        "",
        "toy@2: acceleration_time = 30.0 s: taken as 20.0 s\n",
    )


def test_a_value_between_two_steps_is_rounded_with_a_warning(
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


def test_a_setpoint_in_percent_is_shown_in_percent(run: Run) -> None:
    che = InvtCHE(1, maximum_frequency=50)
    with Simulator([Wire([simulated(che)], unpaced=True)]) as simulator:
        words = ("invt-che", 1, "12.3456", "--option", "maximum_frequency=50", "--yes")
        status, out, _ = run("set-frequency", simulator.wires[0].path, *words)
    assert status == 0
    assert "set-frequency done at setpoint = 24.69 %;" in out


def test_start_stop_and_set_frequency_write_to_the_drive(run: Run, port: str, toy: SimulatedDrive) -> None:
    assert run("start", port, TOY, 1, "--direction", "reverse", "--yes") == (
        0,
        f"toy@1: start done; state: running; {DOG}\n",
        "",
    )
    assert toy["control"] == 3
    assert run("set-frequency", port, TOY, 1, "33.5", "--yes")[0] == 0
    assert toy["frequency"] == 33.5
    assert run("stop", port, TOY, 1)[0] == 0  # a stop needs no confirmation
    assert toy["control"] == 0


@pytest.mark.slow
def test_starting_a_drive_with_unreadable_setpoint_needs_a_frequency(run: Run) -> None:
    """No command knows which setpoint another command has written."""
    with Simulator([Wire([simulated(InnovertIBD(1))], unpaced=True)]) as simulator:
        words = (simulator.wires[0].path, "innovert-ibd", 1, "--yes")
        sentence = "multidrop: innovert-ibd@1 cannot report its setpoint: add --frequency HZ\n"
        assert run("start", *words) == (1, "", sentence)
        assert run("start", *words, "--frequency", 20)[0] == 0


@patient
def test_start_writes_the_setpoint_first(run: Run, port: str, toy: SimulatedDrive) -> None:
    assert run("start", port, TOY, 1, "--frequency", 20, "--yes")[0] == 0
    assert [write.name for write in toy.counters.writes] == ["frequency", "control"]


@patient
@pytest.mark.parametrize(("answer", "writes"), [("y", 1), ("yes", 1), ("n", 0), ("", 0), ("start", 0)])
def test_on_a_terminal_a_start_is_confirmed_or_not_sent(
    run: Run,
    port: str,
    toy: SimulatedDrive,
    monkeypatch: pytest.MonkeyPatch,
    answer: str,
    writes: int,
) -> None:
    terminal = io.StringIO(answer + "\n")
    monkeypatch.setattr(terminal, "isatty", lambda: True)
    monkeypatch.setattr("sys.stdin", terminal)
    status, _, err = run("start", port, TOY, 1)
    assert err.startswith(f"Start the motor of toy@1 on {port}? [y/N] ")
    assert (status == 0) == bool(writes)
    assert len(toy.counters.writes) == writes


def test_input_typed_before_the_question_does_not_answer_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """The second "y" of an impatient user belongs to the previous question."""
    terminal, program = os.openpty()

    class Screen(io.StringIO):
        def write(self, text: str) -> int:
            if "[y/N]" in text:
                os.write(terminal, b"n\n")
            return super().write(text)

    os.write(terminal, b"y\n")
    with os.fdopen(program) as keyboard, os.fdopen(terminal, "rb"):
        assert select.select([keyboard], [], [], 10)[0]  # the typed input has arrived
        monkeypatch.setattr("sys.stdin", keyboard)
        monkeypatch.setattr("sys.stderr", Screen())
        with pytest.raises(WriteForbidden, match="nothing was sent"):
            confirm("Start the motor of pump?", argparse.Namespace(yes=False))


def test_every_write_is_recorded_in_the_audit_log(run: Run, port: str, tmp_path: Path) -> None:
    log = tmp_path / "audit.jsonl"
    run("set-frequency", port, TOY, 1, 20, "--yes", "--audit", log)
    run("start", port, TOY, 1, "--yes", "--audit", log)
    run("stop", port, TOY, 1, "--audit", log)
    records = [json.loads(line) for line in log.read_text().splitlines()]
    assert [
        (record["drive"], record["write"], record.get("sent", "")[:17], record["outcome"])
        for record in records
    ] == [
        ("toy@1", "frequency = 20.00 Hz", "01 06 00 15 07 D0", "done"),
        ("toy@1", "control = RUNNING", "01 06 00 14 00 01", "done"),
        ("toy@1", "stop", "", "called"),
        ("toy@1", "stop", "01 06 00 14 00 00", "stopped"),
    ]


@pytest.mark.parametrize("log", ["none/audit.jsonl", "."])
def test_a_stop_is_sent_if_its_log_cannot_be_opened(
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


def test_wear_shows_the_ledger(run: Run, port: str, toy: SimulatedDrive) -> None:
    status, out, _ = run("wear")
    assert (status, out.endswith("no writes to EEPROM yet\n")) == (0, True)
    toy["status"] = Status(0)
    assert run("write", port, TOY, 1, "acceleration_time", "12.5", "--yes")[0] == 0
    status, out, err = run("write", port, TOY, 1, "acceleration_time", "13", "--yes")
    assert (status, out) == (1, "")
    assert "is written once in 60 s at most" in err
    assert "no writes to EEPROM yet" in run("wear")[1]  # writes to a simulated drive are not counted
    assert not ledger.Ledger().enter(
        ledger.LedgerCell("/dev/ttyS7", 1, "toy", "acceleration_time"), time.time(), 60.0
    )
    head, row, *_ = run("wear")[1].splitlines()
    assert head.split() == ["PORT", "ADDRESS", "MODEL", "REGISTER", "WRITES", "THIS", "YEAR", "LEFT", "LAST"]
    assert row.split()[:7] == ["/dev/ttyS7", "1", "toy", "acceleration_time", "1", "1", "999"]
    (wear,) = json.loads(run("wear", "--json")[1])
    assert (wear["register"], wear["writes"], wear["left"]) == ("acceleration_time", 1, 999)


def test_state_and_read_write_nothing_to_the_drive(run: Run, port: str, toy: SimulatedDrive) -> None:
    run("state", port, TOY, 1)
    run("read", port, TOY, 1)
    assert not toy.counters.writes


def test_state_is_printed_in_words_and_as_json(run: Run, port: str) -> None:
    assert run("state", port, TOY, 1) == (0, f"running\n{DOG}\n", "")
    _, out, _ = run("state", port, TOY, 1, "--json")
    assert json.loads(out)["state"] == {"condition": "running", "direction": None, "fault": None, "note": ""}


@pytest.mark.slow
@pytest.mark.parametrize("words", [(9,), (1, "--baudrate", 19200)], ids=["no drive", "wrong baud rate"])
def test_a_silent_drive_is_reported_with_advice(run: Run, port: str, words: tuple[object, ...]) -> None:
    sentence = "does not answer: check its address, baud rate, format, wiring, and that it has power"
    assert run("read", port, TOY, *words, "status") == (1, "", f"multidrop: toy@{words[0]} {sentence}\n")


def test_a_damaged_reply_is_one_sentence(run: Run, toy: SimulatedDrive) -> None:
    wire = Faulty([toy], lambda reply: reply[:-1] + b"\0", unpaced=True)
    with Simulator([wire]):
        assert run("state", wire.path, TOY, 1) == (
            1,
            "",
            "multidrop: toy@1: bad checksum (received 01 03 02 00 00 B8 00)\n",
        )


def test_a_port_in_use_is_reported_and_a_stop_as_not_sent(run: Run, port: str) -> None:
    holder = (
        "import serial, sys; port = serial.Serial(sys.argv[1], exclusive=True);"
        "print('held', flush=True); sys.stdin.read()"
    )
    words = [sys.executable, "-c", holder, port]
    with BoundProcess(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == b"held\n"
        reason = f"{port}: it is in use by another program"
        assert run("read", port, TOY, 1) == (1, "", f"multidrop: {reason}\n")
        status, out, err = run("stop", port, "invt-che", 1)
        assert (status, out) == (1, "")
        assert err.startswith(f"multidrop: the stop was NOT sent: {reason}; use the hard-wired stop")
        other.communicate()


# ---- interruptions ----


Che = tuple[ReceivedRequests, list[object]]


@pytest.fixture
def che() -> Iterator[Che]:
    """Yield the requests that a simulated CHE receives, and the command-line words that name it."""
    sim = simulated(InvtCHE(1, maximum_frequency=50))
    assert isinstance(sim, MotorDrive)
    sim.motor.acceleration_time = sim.motor.deceleration_time = 0.2
    with Simulator([Wire([sim], unpaced=True)]) as simulator:
        yield ReceivedRequests(sim), [simulator.wires[0].path, "invt-che", 1, "--option=maximum_frequency=50"]


def pressing(when: Callable[[Message], bool]) -> Callable[[Message], bool]:
    """Return a function that presses Ctrl-C at the first request of this kind, and loses no reply."""
    pressed: list[Message] = []

    def loses(request: Message) -> bool:
        if when(request) and not pressed:
            pressed.append(request)
            os.kill(os.getpid(), signal.SIGINT)
        return False

    return loses


@patient
def test_an_interrupted_start_reports_requests_and_the_stop_command(run: Run, che: Che) -> None:
    received, words = che
    received.loses = pressing(lambda request: request in received.starts)
    status, _, err = run("start", *words, "--frequency", 20, "--yes")
    assert status == 130
    assert len(received.starts) == 1
    assert "multidrop: interrupted\nmultidrop: invt-che@1: control = FORWARD " in err
    assert f"multidrop: to stop it, type: multidrop stop {words[0]} invt-che 1 --option=maximum" in err


def pressed_at(place: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let Ctrl-C come when a bus is opened or closed."""
    carry_out = getattr(Bus, place)

    def pressed(*args: Any, **details: Any) -> None:
        if place == "close":  # closes the port, so that no file stays open
            carry_out(*args, **details)
        raise KeyboardInterrupt

    monkeypatch.setattr(Bus, place, pressed)


@patient
@pytest.mark.parametrize(
    ("place", "told"), [("__init__", "the start was not sent"), ("close", "start is done")]
)
def test_ctrl_c_while_a_port_opens_or_closes_reports_the_start(
    run: Run, che: Che, monkeypatch: pytest.MonkeyPatch, place: str, told: str
) -> None:
    received, words = che
    pressed_at(place, monkeypatch)
    status, _, err = run("start", *words, "--frequency", 20, "--yes")
    assert (status, len(received.starts)) == (130, int(place == "close"))
    assert f"multidrop: interrupted\nmultidrop: invt-che@1: {told}\n" in err
    assert "multidrop: to stop it, type: multidrop stop " in err


@pytest.mark.parametrize(
    ("place", "status", "told"),
    [
        ("__init__", Status(0), "toy@1: the write was not sent\n"),
        ("close", Status(0), "toy@1: acceleration_time = 20.0 s: done (read back)\n"),
        (
            "close",
            Status.RUNNING,
            "acceleration_time of toy@1 is not written: it changes only while the motor",
        ),
    ],
)
def test_ctrl_c_while_a_port_opens_or_closes_reports_the_write(
    run: Run,
    port: str,
    toy: SimulatedDrive,
    monkeypatch: pytest.MonkeyPatch,
    place: str,
    status: Status,
    told: str,
) -> None:
    toy["status"] = status
    pressed_at(place, monkeypatch)
    ended, _, err = run("write", port, TOY, 1, "acceleration_time", 20, "--yes")
    assert ended == 130
    assert f"multidrop: interrupted\nmultidrop: {told}" in err


@patient
def test_an_interrupted_stop_is_sent_once_more(run: Run, che: Che) -> None:
    received, words = che
    assert run("start", *words, "--frequency", 20, "--yes")[0] == 0
    begun = len(received.writes)
    received.loses = pressing(lambda request: request.start == 0x1000)
    status, _, err = run("stop", *words)
    assert status == 130
    until(lambda: len(received.writes) >= begun + 3)  # the drive may receive it after the client has left
    # The last write ends a jog.
    assert [write.data for write in received.writes[begun:]] == [b"\0\5", b"\0\5", b"\0\x08"]
    assert "the stop was sent" in err
    assert "multidrop: to stop it, type: multidrop stop " in err


@pytest.mark.long
@pytest.mark.slow
@patient
@pytest.mark.parametrize("verb", usually("stop", "coast"))
def test_a_stop_continues_after_its_terminal_was_closed(run: Run, che: Che, verb: str) -> None:
    received, words = che
    assert run("start", *words, "--frequency", 20, "--yes")[0] == 0
    begun = len(received.writes)
    is_closed = threading.Event()

    def loses(request: Message) -> bool:
        if len(received.writes) > begun and not is_closed.is_set():
            terminal.close()
            is_closed.set()
        return len(received.writes) < begun + 3

    received.loses = loses
    with closing_terminal(verb, *words) as terminal:
        assert terminal.process.wait(PATIENCE) >= 0  # it was not ended by a signal; its output is closed
    assert is_closed.is_set()
    assert len(received.writes) >= begun + 3
    assert received.starts == received.starts[:1]
    until(lambda: received.sim["status"] == 3)


@patient
@pytest.mark.parametrize(
    ("mistake", "told"),
    [
        (["--drvie", "x"], ["ignored unknown options: --drvie x\n"]),
        (["--secnds=5"], ["ignored unknown options: --secnds=5"]),
        (["pump-2"], ["stop takes one drive, which is invt-che@1: ignored pump-2"]),
    ],
)
def test_a_mistake_after_the_drives_name_does_not_prevent_a_stop(
    run: Run, che: Che, mistake: list[str], told: list[str]
) -> None:
    received, words = che
    assert run("start", *words, "--frequency", 20, "--yes")[0] == 0
    begun = len(received.writes)
    status, out, err = run("stop", *words, *mistake)
    assert (status, len(received.writes) > begun) == (2, True)
    assert "stop done" in out
    assert all(text in err for text in told)
    assert received.sim["status"] == 3
    assert run("start", *words, "--yes", *mistake)[0] == 2  # other commands are not sent
    assert received.starts == received.starts[:1]


@patient
def test_the_value_of_an_unknown_option_is_not_taken_for_a_drive(run: Run, che: Che) -> None:
    received, (port, model, address, option) = che
    status, out, err = run("stop", port, model, "--secnds", 5, address, option)
    assert status == 2
    assert "stop done" in out
    assert "ignored unknown options: --secnds 5\n" in err
    assert received.writes
    sent = len(received.writes)
    status, _, err = run("stop", port, model, "--now", address, option)
    assert (status, len(received.writes)) == (2, sent)
    assert "the stop was NOT sent: " in err
    assert "ADDRESS" in err


@patient
def test_a_stop_is_sent_even_if_its_terminal_closes_while_it_starts(
    run: Run, che: Che, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The arguments are not parsed yet, which takes a while on a small computer."""

    def parse(*words: Any) -> Any:
        signal.raise_signal(signal.SIGHUP)
        return real(*words)

    received, words = che
    assert run("start", *words, "--frequency", 20, "--yes")[0] == 0
    before = signal.signal(signal.SIGHUP, lambda number, frame: None)
    real = multidrop.cli._Parser.parse_known_intermixed_args
    monkeypatch.setattr(multidrop.cli._Parser, "parse_known_intermixed_args", parse)
    try:
        assert run("state", *words)[0] == 130
        assert run("stop", *words)[0] == 0
    finally:
        signal.signal(signal.SIGHUP, before)
    assert received.sim["status"] == 3


@pytest.mark.parametrize(
    "words",
    [["nowhere", "invt-che"], ["nowhere", "invt-che", "one"], ["nowhere", "invt-che", 1, "--baudrate"]],
)
def test_a_stop_that_names_no_drive_is_reported_as_not_sent(run: Run, words: list[object]) -> None:
    status, _, err = run("emergency-stop", *words)
    assert status == 2
    assert err.startswith("multidrop: the emergency-stop was NOT sent: ")


def plant_of(port: object, folder: Path) -> Path:
    """Return a plant file with a CHE at this port."""
    plant = folder / "hall.toml"
    drive = '[[line.drive]]\nname = "pump"\nmodel = "invt-che"\naddress = 1\nmaximum_frequency = 50\n'
    plant.write_text(f'[[line]]\nname = "hall"\nport = "{port}"\n{drive}')
    return plant


@pytest.mark.long
@patient
@pytest.mark.parametrize("keys", usually(b"sy", b"Sy"))
def test_a_stop_from_the_monitor_continues_after_its_terminal_was_closed(
    run: Run, che: Che, tmp_path: Path, keys: bytes
) -> None:
    received, words = che
    assert run("start", *words, "--frequency", 20, "--yes")[0] == 0
    begun = len(received.writes)
    plant, out = plant_of(words[0], tmp_path), tmp_path / "seen.csv"
    received.loses = lambda request: request.start == 0x1000 and len(received.writes) < begun + 4
    with closing_terminal("monitor", plant, "--out", out) as terminal:
        terminal.wait_for(" Hz ")
        terminal.press(keys)
        until(lambda: len(received.writes) > begun)
        terminal.close()
        assert terminal.process.wait(PATIENCE) >= 0
    assert len(received.writes) >= begun + 4
    assert received.starts == received.starts[:1]
    until(lambda: received.sim["status"] == 3)
    rows = [row for batch in open_recording(out) for row in batch]
    assert rows[-1].register in {row.register for row in rows[:-1]}  # the recording was completed and closed


@pytest.mark.long
@patient
def test_the_monitor_ends_without_writing_when_its_terminal_is_closed(che: Che, tmp_path: Path) -> None:
    received, words = che
    plant = plant_of(words[0], tmp_path)
    with closing_terminal("monitor", plant) as terminal:
        terminal.wait_for(" Hz ")
        terminal.close()
        assert terminal.process.wait(PATIENCE) >= 0
    assert received.writes == []


@patient
def test_a_stop_is_sent_even_if_no_warning_can_be_printed(
    run: Run, che: Che, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Gone(io.StringIO):
        def write(self, text: str) -> int:
            raise OSError(errno.EIO, "Input/output error")

    received, words = che
    monkeypatch.setattr(sys, "stderr", Gone())
    assert multidrop.cli.main(list(map(str, ("stop", *words, "--audit", tmp_path)))) == 0
    assert [write.data for write in received.writes] == [b"\0\5"]


@pytest.mark.parametrize("seconds", ["-1", "0", "nan", "inf", "ten", ""])
@pytest.mark.parametrize("verb", ["stop", "coast"])
def test_an_invalid_time_does_not_prevent_a_stop(run: Run, che: Che, verb: str, seconds: str) -> None:
    received, words = che
    status, _, err = run(verb, *words, "--seconds", seconds)
    assert status == 0
    assert received.writes
    assert f"--seconds: '{seconds}' is not a number of seconds above 0: ignored; the stop is repeated" in err


@pytest.mark.slow
def test_a_stop_is_repeated_for_the_given_seconds(run: Run, che: Che) -> None:
    received, words = che
    received.loses = lambda request: True
    status, _, err = run("stop", *words, "--seconds", 1)
    assert status == 1
    assert "it was never confirmed" in err
    assert received.writes[0].data == b"\0\5"
    assert {write.data for write in received.writes} <= {b"\0\5", b"\0\x08"}  # a run's stop and a jog's stop


@pytest.mark.parametrize(
    "words", [["read", "{}", "invt-che", "1", "status"], ["scan", "{}"], ["sniff", "{}"]]
)
def test_undocumented_port_urls_are_refused_before_they_are_opened(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "precious").write_text("precious")
    port = f"spy:///dev/null?file={tmp_path}/precious"
    assert multidrop.cli.main([word.format(port) for word in words]) == 2
    assert "there is no spy://" in capsys.readouterr().err
    assert (tmp_path / "precious").read_text() == "precious"
