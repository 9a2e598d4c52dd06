"""The log's thread: logging calls never wait, and lost lines are counted and reported."""

from __future__ import annotations

import argparse
import io
import json
import logging
import os
import re
import sys
import threading
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from lines import until
from peers import require_module

from multidrop.cli import hub, main
from multidrop.cli.fleet import serve
from multidrop.cli.support import log_thread
from multidrop.cli.support.log_thread import LogThread

FORMAT = logging.Formatter("%(message)s")


def record(text: str) -> logging.LogRecord:
    return logging.LogRecord("multidrop", logging.INFO, "", 0, text, None, None)


def fill(pipe: int) -> None:
    os.set_blocking(pipe, False)
    with suppress(BlockingIOError):
        while True:
            os.write(pipe, b" ")
    os.set_blocking(pipe, True)


def test_lines_lost_by_a_slow_reader_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log_thread, "MOST_WAITING", 3)
    unread, log = os.pipe()
    with os.fdopen(unread) as reader, os.fdopen(log, "w") as stream:
        fill(log)
        handler = LogThread(stream, FORMAT)
        handler.handle(record("first"))
        until(lambda: handler._waiting.empty())  # the thread hangs in a write
        for number in range(8):
            handler.handle(record(f"line {number}"))
        told = [reader.readline().strip()]
        told += [reader.readline().strip() for _ in range(4)]
        handler.close()
    lost = "5 later lines of the log are lost: its reader was too slow"
    assert told == ["first", lost, "line 0", "line 1", "line 2"]


def test_closing_a_log_writes_all_lines_and_ignores_a_closed_reader() -> None:
    unread, log = os.pipe()
    with os.fdopen(log, "w") as stream:
        handler = LogThread(stream, FORMAT)
        handler.handle(record("last"))
        assert handler.is_alive()
        handler.close()
        assert not handler.is_alive()
        assert os.read(unread, 100) == b"last\n"
        handler = LogThread(stream, FORMAT)
        os.close(unread)
        for _ in range(2):
            handler.handle(record("unread"))
        handler.close()
        assert not handler._thread.is_alive()


def test_a_fleets_gateway_never_waits_for_its_log(monkeypatch: pytest.MonkeyPatch) -> None:
    async def work(*_: object) -> int:
        logging.getLogger("multidrop.fleet").warning("a stop of pump-1")
        return 7

    monkeypatch.setattr(serve, "_serve", work)
    unread, log = os.pipe()
    with os.fdopen(unread) as reader, os.fdopen(log, "w") as stream:
        fill(log)
        monkeypatch.setattr(sys, "stderr", stream)
        assert serve.run(argparse.Namespace(log="text")) == 7
        assert reader.readline().strip().endswith(" warning a stop of pump-1")


@pytest.mark.parametrize("command", [serve, hub])
def test_logs_of_a_fleet_have_time_and_level_in_text_and_json(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], tmp_path: Path, command: Any
) -> None:
    require_module("nats")
    from multidrop.fleet.samples.hub import HubState

    async def work(*_: object) -> Any:
        logging.getLogger("multidrop.fleet").warning("line %s is lost\x1b", "hall-1")
        return HubState(0, 0, 0, 0, 0, 0, None) if command is hub else 0

    name = "_read_until_signal" if command is hub else "_serve"
    monkeypatch.setattr(command, name, work)
    for form in ("text", "json"):
        words = ["hub", "--parquet", str(tmp_path)] if command is hub else ["fleet", "serve", "gw-1"]
        assert main([*words, "--log", form]) == 0
    text, told = capfd.readouterr().err.splitlines()
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT[0-9:.]+\+00:00 warning line hall-1 is lost\\x1b", text)
    found = json.loads(told)
    assert (found["level"], found["logger"]) == ("warning", "multidrop.fleet")
    assert found["message"] == "line hall-1 is lost\x1b"
    assert datetime.fromisoformat(found["time"]).tzinfo is not None


def test_closing_a_log_whose_thread_never_started_raises_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C came before the thread was started. `logging` closes the handler at exit."""
    monkeypatch.setattr(threading.Thread, "start", lambda thread: None)
    LogThread(io.StringIO(), FORMAT).close()
