"""`fleet watch`: its text picture of a fleet fits every terminal size, and marks an old view as old."""

from __future__ import annotations

import asyncio
import json
import os
import re
import signal
import subprocess
import sys
from argparse import Namespace
from itertools import pairwise
from typing import Any
from unittest.mock import AsyncMock

import pytest
from commands import BoundProcess, Run
from nats_clusters import Cluster
from tables import table
from terminals import on_terminal

from multidrop.cli.fleet import views
from multidrop.cli.fleet.views import moment, move_table, picture, size
from multidrop.fleet.overview import FleetWatch
from multidrop.supervisor import Ended, supervisor

SPOOL = {"bytes": 81234, "lost": 0, "behind": 2, "lag_s": 1.5, "trouble": None}
SAYS = {"state": "working", "margin_s": 1.94, "troubles": {}, "trouble": "", "spool": SPOOL}
GATEWAY = {"host": "pc-1", "session": 3, "began_ms": 0, "draining": False, "lines": 6, "unseen_s": 0.1}
MOVE: dict[str, Any] = {"line": "line-1", "revision": 9, "at_ms": 3_723_000, "from": "gw-1", "to": "gw-2"}


def line(master: str | None) -> dict[str, Any]:
    return {"port": "socket://h:1", "revision": 1, "master": master, "session": 3, "since_ms": 0}


def told(age_s: float | None = 0.0, trouble: str | None = None, lines: int = 3) -> dict[str, Any]:
    return {
        "at_ms": 0,
        "age_s": age_s,
        "trouble": trouble,
        "gateways": {"gw-1": GATEWAY | {"says": SAYS}, "gw-2": GATEWAY | {"says": None}},
        "lines": {f"line-{at}": line("gw-1" if at else None) for at in range(lines)},
        "moves": [MOVE] * 20,
    }


def drawn(told: dict[str, Any], width: int = 120, height: int = 40) -> str:
    lines = picture(told, (width, height), "multidrop fleet watch")
    assert len(lines) == height
    assert all(len(one.plain) <= width for one in lines)
    return "\n".join(one.plain for one in lines)


def test_the_screen_shows_gateways_lines_and_changes_of_masters() -> None:
    text = drawn(told())
    assert re.search(r"gw-1 +pc-1 +3 +1970-01-01 00:00:00 +working +6 +1\.9 s +81 kB +2 +1\.5 s +0\n", text)
    assert re.search(r"gw-2 +pc-1 .*no answer +6 +- +- +- +- +-\n", text)
    assert "3 lines, 1 without a master" in text
    assert text.index("line-0  socket://h:1  none") < text.index("line-1  socket://h:1  gw-1")
    assert "1970-01-01 01:02:03  line-1  from gw-1  to gw-2" in text


@pytest.mark.long
@table("height", [*range(1, 30), 59])
def test_the_screen_fits_each_terminal_height(height: int) -> None:
    for width in (20, 80, 200):
        drawn(told(trouble="no server", lines=100), width, height)


def test_lines_without_a_master_come_first_and_hidden_lines_are_counted() -> None:
    text = drawn(told(lines=500))
    shown = len(re.findall(r"^line-\d+ ", text, re.MULTILINE))
    assert f"and {500 - shown} more lines" in text
    assert "line-0  " in text
    assert text.count("from gw-1") >= 6


def test_a_terminal_of_80_by_24_shows_twelve_lines_with_their_masters() -> None:
    text = drawn(told(lines=12), 80, 24)
    assert re.search(r"^line-0 +none +\| line-3", text, re.MULTILINE)
    assert len(re.findall(r"line-\d+ +(?:gw-1|none)", text)) == 12
    assert "last changes of master:" in text


def test_screen_shows_only_the_newest_notes_that_fit() -> None:
    notes = {"notes": [f"{at} " + "words " * 20 for at in range(3)]}
    shown = drawn(told() | notes, 80).splitlines()
    assert [row[0] for row in shown if re.match(r"\d words", row)] == ["1", "2"]


def test_a_narrow_terminal_drops_less_important_columns() -> None:
    head = [drawn(told(), width).splitlines()[2] for width in (200, 80, 72, 64, 56, 48, 40)]
    assert [re.sub(" +", " ", one) for one in head] == [
        "GATEWAY HOST SESSION SINCE STATE LINES LEASE SPOOL UNSENT LAG LOST",
        "GATEWAY HOST SESSION STATE LINES LEASE SPOOL UNSENT LAG LOST",
        "GATEWAY SESSION STATE LINES LEASE SPOOL UNSENT LAG LOST",
        "GATEWAY STATE LINES LEASE SPOOL UNSENT LAG LOST",
        "GATEWAY STATE LINES LEASE UNSENT LAG LOST",
        "GATEWAY STATE LINES LEASE UNSENT LOST",
        "GATEWAY STATE LINES UNSENT LOST",
    ]


def test_a_narrow_terminal_still_shows_masters_and_their_last_changes() -> None:
    shown = drawn(told(), 40).splitlines()
    assert [re.sub(" +", " ", row) for row in shown if re.match("LINE|line-1 ", row)] == [
        "LINE MASTER SINCE",
        "line-1 gw-1 1970-01-01 00:00:00",
    ]
    assert "1970-01-01 01:02:03  line-1  to gw-2" in shown
    assert "LINE    MASTER" in drawn(told(), 30).splitlines()


def test_long_text_is_wrapped_or_marked_as_cut() -> None:
    found = told(12.0, "no server is reached at nats://a:4222") | {"notes": ["a note of some words " * 3]}
    shown = drawn(found, 40).splitlines()
    assert shown[1] == "this is 12 s old: no server is reached~"
    assert shown[-3:] == [
        "a note of some words a note of some",
        "         words a note of some words",
        "Ctrl-C ends it",
    ]


@table("height", range(1, 60))
def test_each_table_header_on_the_screen_has_a_row_below(height: int) -> None:
    rows = drawn(told(lines=12), 80, height).splitlines()
    for row, next_row in pairwise(rows):
        if row.startswith(("LINE ", "last changes of master")):
            assert re.match(r"line-|1970-", next_row), (row, next_row)


def test_screen_lists_lines_early_if_the_master_does_not_answer() -> None:
    """If all gateways are dead, none ends the others' sessions, so records still name them as masters."""
    found = told(lines=12)
    assert "1 without a master\n" in drawn(found)
    found["lines"]["line-7"]["master"] = "gw-2"
    rows = drawn(found).splitlines()
    assert "12 lines, 1 without a master, 1 whose master does not answer" in rows
    first = [row.split()[0] for row in rows if row.startswith("line-")][:3]
    assert first == ["line-0", "line-7", "line-1"]
    (one,) = (line for line in picture(found, (120, 40), "") if line.plain.startswith("line-7"))
    assert "  gw-2, no answer  " in one.plain
    assert str(one.style) == "bold red"


@pytest.mark.parametrize(("master", "status"), [("gw-1", 0), ("gw-2", 1), (None, 1)])
def test_the_exit_status_is_1_if_a_line_has_no_living_master(
    monkeypatch: pytest.MonkeyPatch, master: str | None, status: int
) -> None:
    async def seen(paths: object) -> dict[str, Any]:
        return told() | {"lines": {"line-1": line(master)}}

    monkeypatch.setattr(views, "_fleet_state", seen)
    assert asyncio.run(views._print_status(Namespace(json=False), [])) == status


def test_a_missing_gateway_and_a_lost_port_are_shown(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    gone = told() | {"lines": {"line-1": line("gw-1")}}
    lost = told() | {"lines": {"line-1": line("gw-1"), "line-2": line("gw-2")}}
    gone["missing"] = {"gw-9": {"host": "pc-9", "session": 4, "seen_ms": 1_764_000_000_000}}
    why = "port lost: socket://10.0.0.7:4001: nothing listens there"
    more = {"lost": ["line-1", 5], "troubles": {"line-1": why}, "unopened": ["line-2", "line-1"]}
    lost["gateways"]["gw-1"]["says"] = SAYS | more
    lost["gateways"]["gw-2"]["says"] = SAYS | {"lost": 7, "unopened": None}
    for found, sentence in (
        (gone, "gw-9 on pc-9 is missing: last seen 2025-11-24 16:00:00"),
        (lost, f"gw-1: line line-1: {why}"),
    ):
        monkeypatch.setattr(views, "_fleet_state", AsyncMock(return_value=found))
        assert asyncio.run(views._print_status(Namespace(json=False), [])) == 1
        assert sentence in capsys.readouterr().out.splitlines()
    assert "1 with a lost port" in drawn(lost)
    assert "gw-1: line line-2 cannot be opened from here; another gateway polls it" in drawn(lost)


def test_lines_are_sorted_by_number_so_line_10_follows_line_9() -> None:
    rows = drawn(told(lines=12)).splitlines()
    assert [row.split()[0] for row in rows if row.startswith("line-")] == [f"line-{at}" for at in range(12)]


def test_an_old_view_is_dim_and_shows_its_age() -> None:
    found = told(12.0, "no connection to nats://a:4222")
    assert "this is 12 s old: no connection to nats://a:4222" in drawn(found)
    lines = picture(found, (120, 40), "")
    assert {str(one.style) for one in lines if one.plain.startswith("gw-1")} == {"dim"}
    assert {str(one.style) for one in picture(told(), (120, 40), "") if one.plain.startswith("gw-1")} == {""}


def test_control_characters_in_a_hosts_name_are_not_printed() -> None:
    found = told()
    found["gateways"]["gw-1"]["host"] = "\x1b[2J"
    assert "\x1b" not in drawn(found)


def test_changes_of_masters_without_a_known_former_master_are_shown() -> None:
    moves = [MOVE | {"from": None}, MOVE | {"from": ""}, MOVE | {"to": ""}]
    assert [re.sub(" +", " ", row)[27:] for row in move_table(moves)] == [
        "to gw-2",
        "from none to gw-2",
        "from gw-1 to none",
    ]


@table(
    ("number", "text"),
    [(0, "0 B"), (999, "999 B"), (1000, "1.0 kB"), (81234, "81 kB"), (5e9, "5.0 GB"), (3e15, "3000 TB")],
)
def test_a_size_in_bytes_is_shown_with_a_unit(number: float, text: str) -> None:
    assert size(number) == text


class FailingView:
    """A view of a fleet that is read once. All later reads fail."""

    looks = 0

    async def look(self) -> None:
        self.looks += 1
        if self.looks > 1:
            raise OSError("no server")

    def fleet(self) -> dict[str, Any]:
        return {"gateways": {}, "lines": {}, "moves": []}


async def test_a_failed_read_shows_the_last_view_with_its_age(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(views, "EVERY_S", 0.02)
    shown: list[dict[str, Any]] = []
    over = asyncio.Event()

    def show(told: dict[str, Any]) -> None:
        shown.append(told)
        if len(shown) == 3:
            over.set()

    await views.follow(FleetWatch(FailingView()), show, over)
    assert [one["trouble"] for one in shown] == [None, "no server", "no server"]
    assert shown[0]["age_s"] < shown[1]["age_s"] < shown[2]["age_s"]


async def test_fleet_watch_ends_when_the_connection_task_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """A `fleet watch` without a connection would show an old view forever."""
    monkeypatch.setattr(views, "EVERY_S", 0.01)
    supervisor().keep("path", asyncio.sleep(0)).cancel()
    watch: Any = FleetWatch(FailingView())
    with pytest.raises(Ended, match="path has ended: it was cancelled"):
        await views.follow(watch, lambda told: None, asyncio.Event())


def test_the_watch_command_suggests_json_without_a_terminal(run: Run) -> None:
    status, out, err = run("fleet", "watch")
    assert (status, out) == (2, "")
    assert "`multidrop fleet watch` needs a terminal. Without a terminal, add --json" in err


@pytest.mark.long
def test_watch_prints_one_line_a_second_until_interrupted(fleet: Cluster) -> None:
    command = [sys.executable, "-m", "multidrop", "fleet", "watch", "--json"]
    environment = {**os.environ, "MULTIDROP_NATS": ",".join(fleet.urls)}
    with BoundProcess(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        found = [json.loads(process.stdout.readline()) for _ in range(3)]
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
        assert process.stderr.read() == ""
    assert [one["trouble"] for one in found] == [None] * 3
    # 0.9 s instead of 2 s, because the first read may have taken long
    assert found[0]["at_ms"] + 900 <= found[2]["at_ms"]


@pytest.mark.long
def test_the_watch_command_draws_on_a_terminal_until_interrupted(fleet: Cluster) -> None:
    with on_terminal("fleet", "watch", MULTIDROP_NATS=",".join(fleet.urls)) as terminal:
        terminal.wait_for("0 lines, 0 without a master")
        terminal.process.send_signal(signal.SIGINT)
        assert terminal.process.wait(30) == 0
        terminal.written = os.read(terminal.fd, 65536)
        assert b"\x1b[?25h" in terminal.written  # this sequence shows the cursor again
        assert b"Traceback" not in terminal.written


def test_a_time_beyond_the_calendar_is_shown_as_a_question_mark() -> None:
    assert moment(10**30) == "?"
