"""The log's thread: who logs never waits, and what was lost meanwhile is told."""

from __future__ import annotations

import argparse
import logging
import os
import sys
from contextlib import suppress

import pytest
from lines import until

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


def test_what_is_lost_while_nobody_reads_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log_thread, "MOST_WAITING", 3)
    unread, log = os.pipe()
    with os.fdopen(unread) as reader, os.fdopen(log, "w") as stream:
        fill(log)
        handler = LogThread(stream, FORMAT)
        handler.handle(record("first"))
        until(lambda: handler._waiting.empty())  # it is being written, and that stands still
        for number in range(8):
            handler.handle(record(f"line {number}"))
        told = [reader.readline().strip()]
        told += [reader.readline().strip() for _ in range(4)]
        handler.close()
    lost = "5 later lines of the log are lost: nobody read it in time"
    assert told == ["first", lost, "line 0", "line 1", "line 2"]


def test_all_lines_are_there_when_it_is_closed_and_a_reader_that_goes_harms_nobody() -> None:
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


def test_a_gateway_of_a_fleet_waits_for_nobody_who_reads_its_log(monkeypatch: pytest.MonkeyPatch) -> None:
    async def work(_: argparse.Namespace) -> int:
        logging.getLogger("multidrop.fleet").warning("a stop of pump-1")
        return 7

    monkeypatch.setattr(serve, "_serve", work)
    unread, log = os.pipe()
    with os.fdopen(unread) as reader, os.fdopen(log, "w") as stream:
        fill(log)
        monkeypatch.setattr(sys, "stderr", stream)
        assert serve.run(argparse.Namespace()) == 7
        assert reader.readline().strip() == "multidrop: a stop of pump-1"
