"""A command leaves a complete new file, or none."""

from __future__ import annotations

import argparse
import json
import logging
import os
import re
import sys
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from batches import counting
from interruptions import full_at
from lines import until
from peers import require_module

from multidrop import Plant
from multidrop.cli import main
from multidrop.cli.fleet import services
from multidrop.cli.support import log_thread, polling
from multidrop.cli.support.files import write_new
from multidrop.cli.support.log_thread import LogThread
from multidrop.cli.support.polling import polling_session
from multidrop.polling.batch import Batch
from multidrop.recording import RecordingError, open_recording


def test_an_incomplete_file_is_removed_if_the_disk_is_full(tmp_path: Path) -> None:
    page = tmp_path / "report.html"
    with full_at(100), pytest.raises(OSError, match=f"^{page}: cannot be written: File too large"):
        write_new(page, "x" * 101)
    assert not page.exists()
    write_new(page, "x" * 101)
    with pytest.raises(ValueError, match="exists already"):
        write_new(page, "y")
    assert page.read_text() == "x" * 101


class PollerOf:
    """A poller that delivers these batches."""

    batches: tuple[Batch, ...] = ()

    def __init__(self, plant: Plant) -> None:
        self._left = list(self.batches)

    def take(self) -> Batch | None:
        return self._left.pop(0) if self._left else None

    def close(self) -> None:
        pass


def test_a_full_disk_error_states_the_number_of_readable_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second batch does not fit on the disk. The third would fit, but must not follow missing rows."""
    monkeypatch.setattr(PollerOf, "batches", (counting(20), counting(2000), counting(5)))
    monkeypatch.setattr(polling, "Poller", PollerOf)
    out = tmp_path / "run.arrows"
    with (
        full_at(20_000),
        pytest.raises(RecordingError, match="the 20 rows before that can be read"),
        polling_session(Plant((), Path()), out) as session,
    ):
        session.hand_out()
    assert sum(map(len, open_recording(out))) == 20


# ---- the log's thread: logging calls never wait, and lost lines are counted and reported ----


FORMAT = logging.Formatter("%(message)s")


def record(text: str) -> logging.LogRecord:
    return logging.LogRecord("multidrop", logging.INFO, "", 0, text, None, None)


def fill(pipe: int) -> None:
    os.set_blocking(pipe, False)
    with suppress(BlockingIOError):
        while True:
            os.write(pipe, b" ")
    os.set_blocking(pipe, True)


def test_log_lines_lost_by_a_slow_reader_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log_thread, "MOST_WAITING", 3)
    unread, log = os.pipe()
    with os.fdopen(unread) as reader, os.fdopen(log, "w") as stream:
        fill(log)
        handler = LogThread(stream, FORMAT)
        handler.handle(record("first"))
        until(lambda: handler._thread._work.empty())  # the log's thread is blocked in its first write
        for number in range(8):
            handler.handle(record(f"line {number}"))
        told = [reader.readline().strip()]
        told += [reader.readline().strip() for _ in range(4)]
        handler.close()
    lost = "5 later lines of the log are lost: its reader was too slow"
    assert told == ["first", lost, "line 0", "line 1", "line 2"]


def test_closing_a_log_writes_all_pending_lines() -> None:
    unread, log = os.pipe()
    with os.fdopen(log, "w") as stream:
        handler = LogThread(stream, FORMAT)
        handler.handle(record("last"))
        handler.close()
        assert os.read(unread, 100) == b"last\n"
        handler = LogThread(stream, FORMAT)
        os.close(unread)
        for _ in range(2):
            handler.handle(record("unread"))
        handler.close()
        assert handler._thread.flush(60.0)


def test_a_fleet_gateway_never_waits_for_log_output(monkeypatch: pytest.MonkeyPatch) -> None:
    async def work(*_: object) -> int:
        logging.getLogger("multidrop.fleet").warning("a stop of pump-1")
        return 7

    monkeypatch.setattr(services, "_serve", work)
    monkeypatch.setattr(log_thread, "ENDING_S", 0.05)
    unread, log = os.pipe()
    with os.fdopen(unread) as reader, os.fdopen(log, "w") as stream:
        fill(log)
        monkeypatch.setattr(sys, "stderr", stream)
        assert services.run(argparse.Namespace(command="serve", log="text")) == 7
        assert reader.readline().strip().endswith(" warning a stop of pump-1")


@pytest.mark.parametrize("command", ["serve", "hub"])
def test_the_log_of_a_fleet_has_time_and_level_in_text_and_json(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], tmp_path: Path, command: str
) -> None:
    require_module("nats")
    from multidrop.fleet.samples.hub import HubState

    async def work(*_: object) -> Any:
        logging.getLogger("multidrop.fleet").warning("line %s is lost\x1b", "hall-1")
        return HubState(0, 0, 0, 0, 0, 0, None) if command == "hub" else 0

    monkeypatch.setattr(services, "_read" if command == "hub" else "_serve", work)
    for form in ("text", "json"):
        words = ["hub", "--parquet", str(tmp_path)] if command == "hub" else ["fleet", "serve", "gw-1"]
        assert main([*words, "--log", form]) == 0
    text, told = capfd.readouterr().err.splitlines()
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT[0-9:.]+\+00:00 warning line hall-1 is lost\\x1b", text)
    found = json.loads(told)
    assert (found["level"], found["logger"]) == ("warning", "multidrop.fleet")
    assert found["message"] == "line hall-1 is lost\x1b"
    assert datetime.fromisoformat(found["time"]).tzinfo is not None
