"""Stops and interrupted commands: Ctrl-C, closed terminals, and mistakes in a stop's arguments."""

from __future__ import annotations

import errno
import io
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from commands import TOY, Run
from lines import PATIENCE, patient, until
from motors import ReceivedRequests
from tables import usually
from terminals import closing_terminal
from toy import Status

import multidrop.cli
from multidrop.bus import Bus
from multidrop.core import Message
from multidrop.families.invt_che import InvtCHE
from multidrop.recording import open_recording
from multidrop.sim import MotorDrive, simulated
from multidrop.sim.drive import SimulatedDrive
from multidrop.sim.simulator import Simulator
from multidrop.sim.wire import Wire

pytestmark = pytest.mark.usefixtures("_turns_awaited")

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
    """Return a function that presses Ctrl-C at the first matching request. It never loses a reply."""
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
    """Press Ctrl-C when a bus is opened or closed."""
    carry_out = getattr(Bus, place)

    def pressed(*args: Any, **details: Any) -> None:
        if place == "close":  # closes the port first, so that no file stays open
            carry_out(*args, **details)
        raise KeyboardInterrupt

    monkeypatch.setattr(Bus, place, pressed)


@patient
@pytest.mark.parametrize(
    ("place", "told"), [("__init__", "the start was not sent"), ("close", "start is done")]
)
def test_ctrl_c_while_a_port_opens_or_closes_says_if_the_start_was_sent(
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
            "acceleration_time of toy@1 is not written: it can be written only at standstill",
        ),
    ],
)
def test_ctrl_c_while_a_port_opens_or_closes_says_if_the_write_was_sent(
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
    until(lambda: len(received.writes) >= begun + 3)  # the last write may arrive late
    # The last write is the one that ends a jog.
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
        # A signal would give a negative status. The status is 1 if the terminal closed the command's output.
        assert terminal.process.wait(PATIENCE) >= 0
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
def test_a_stop_is_sent_despite_an_invalid_option(
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
    assert run("start", *words, "--yes", *mistake)[0] == 2  # a command other than a stop is not sent
    assert received.starts == received.starts[:1]


@patient
def test_the_stop_command_ignores_an_unknown_option_with_a_value(run: Run, che: Che) -> None:
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
def test_a_stop_is_sent_if_the_terminal_closes_before_parsing(
    run: Run, che: Che, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The terminal closes before the arguments are parsed, which takes a while on a small computer."""

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
def test_a_stop_command_without_a_valid_drive_is_reported_as_not_sent(run: Run, words: list[object]) -> None:
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
def test_the_monitor_completes_a_stop_after_its_terminal_was_closed(
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
    # the recording can be read to its end, because it was closed
    assert rows[-1].register in {row.register for row in rows[:-1]}


@pytest.mark.long
@patient
def test_a_closed_terminal_ends_the_monitor_without_a_write(che: Che, tmp_path: Path) -> None:
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
def test_an_invalid_time_limit_does_not_prevent_a_stop(run: Run, che: Che, verb: str, seconds: str) -> None:
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
    # commands that stop a run, and that end a jog
    assert {write.data for write in received.writes} <= {b"\0\5", b"\0\x08"}
