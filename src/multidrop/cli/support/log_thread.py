"""A log handler with its own thread, so that no stop waits for a halted terminal or a full pipe."""

from __future__ import annotations

import argparse
import json
import logging
import os
import sys
from collections.abc import Mapping
from contextlib import AbstractContextManager, suppress
from datetime import UTC, datetime
from functools import partial
from typing import TextIO

from multidrop.cli.support.output import logging_by
from multidrop.printable import masked, printable
from multidrop.transport.aside_log import MOST_WAITING, AsideThread

ENDING_S = 1.0  # how long `close` waits until the last lines are written, in s


class LogThread(logging.Handler):
    """Writes log records to a stream in its own thread. Counts the records that do not fit into the queue."""

    def __init__(self, stream: TextIO, formatter: logging.Formatter) -> None:
        super().__init__()
        self.setFormatter(formatter)
        self._stream = self._file = stream
        with suppress(OSError):  # a stream in memory has no file descriptor
            # Write to a duplicate descriptor: at exit Python flushes `stream` and would wait for a halted
            # terminal.
            own = os.dup(stream.fileno())
            self._file = os.fdopen(own, "w", 1, encoding=stream.encoding, errors="backslashreplace")
        self._thread = AsideThread("multidrop log")
        self._lost = 0

    def emit(self, record: logging.LogRecord) -> None:
        """Queue a record without waiting; count it as lost if the queue is full."""
        if not self._thread.put(partial(self._write, self.format(record)), MOST_WAITING):
            self._lost += 1

    def close(self) -> None:
        """Wait up to ENDING_S for the last lines."""
        if self._file is not self._stream:
            self._thread.put(self._file.close)
        self._thread.flush(ENDING_S)
        super().close()

    def _write(self, line: str) -> None:
        if self._lost:
            lost, self._lost = self._lost, 0
            text = f"{lost} later lines of the log are lost: its reader was too slow"
            self._put(self.format(logging.LogRecord("multidrop", logging.WARNING, "", 0, text, None, None)))
        self._put(line)

    def _put(self, line: str) -> None:
        with suppress(OSError, ValueError):  # the disk is full, or the reader is gone
            self._file.write(f"{line}\n")


# ---- formats ----


class JsonFormatter(logging.Formatter):
    """Formats a record as one JSON object on one line."""

    def format(self, record: logging.LogRecord) -> str:
        found = {
            "time": _time(record),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": masked(record.getMessage()),
        }
        if record.exc_info:
            found["exception"] = masked(self.formatException(record.exc_info))
        return json.dumps(found, ensure_ascii=False)


class TextFormatter(logging.Formatter):
    """Formats time, level and message on one escaped line, with any traceback below it."""

    def format(self, record: logging.LogRecord) -> str:
        text = f"{_time(record)} {record.levelname.lower()} {printable(masked(record.getMessage()))}"
        return f"{text}\n{masked(self.formatException(record.exc_info))}" if record.exc_info else text


def _time(record: logging.LogRecord) -> str:
    return datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds")


FORMATTERS = {"text": TextFormatter, "json": JsonFormatter}


def logging_to_stderr(form: str, levels: Mapping[str, int]) -> AbstractContextManager[None]:
    """While the context lasts, write these loggers' messages to stderr, from the given levels up."""
    return logging_by(LogThread(sys.stderr, FORMATTERS[form]()), levels)


def add_log_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--log", choices=FORMATTERS, default="text", help="form of the log on stderr")
