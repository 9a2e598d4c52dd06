"""A log that writes on its own thread, so that no stop waits for a halted terminal or a full pipe."""

from __future__ import annotations

import argparse
import json
import logging
import os
import queue
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from typing import TextIO

from multidrop.cli.support.output import logging_by
from multidrop.printable import masked, printable

MOST_WAITING = 10_000  # lines
ENDING_S = 1.0  # how long `close` waits for the last lines


class LogThread(logging.Handler):
    """Writes records to a stream's file on its own thread; counts those that do not fit into the queue."""

    def __init__(self, stream: TextIO, formatter: logging.Formatter) -> None:
        super().__init__()
        self.setFormatter(formatter)
        self._stream = self._file = stream
        with suppress(OSError):  # a stream in memory has no file
            # A duplicate: Python flushes `stream` at exit, and would wait for a halted one.
            own = os.dup(stream.fileno())
            self._file = os.fdopen(own, "w", 1, encoding=stream.encoding, errors="backslashreplace")
        self._waiting: queue.Queue[str | None] = queue.Queue(MOST_WAITING)
        self._lost = 0
        self._thread = threading.Thread(target=self._write, name="multidrop log", daemon=True)
        self._thread.start()

    def is_alive(self) -> bool:
        """True while the thread that writes is running."""
        return self._thread.is_alive()

    def emit(self, record: logging.LogRecord) -> None:
        """Queue a record without waiting."""
        try:
            self._waiting.put_nowait(self.format(record))
        except queue.Full:
            self._lost += 1

    def close(self) -> None:
        """Wait up to ENDING_S for the last lines."""
        with suppress(queue.Full):
            self._waiting.put_nowait(None)
        if self._thread.ident is not None:  # Ctrl-C may have come before its start
            self._thread.join(ENDING_S)
        super().close()

    def _write(self) -> None:
        while (line := self._waiting.get()) is not None:
            if self._lost:
                lost, self._lost = self._lost, 0
                said = f"{lost} later lines of the log are lost: its reader was too slow"
                self._put(
                    self.format(logging.LogRecord("multidrop", logging.WARNING, "", 0, said, None, None))
                )
            self._put(line)
        if self._file is not self._stream:
            with suppress(OSError):
                self._file.close()

    def _put(self, line: str) -> None:
        with suppress(OSError, ValueError):  # a full disk, or a closed reader
            self._file.write(f"{line}\n")


# ---- forms ----


class JsonFormatter(logging.Formatter):
    """One JSON object a line."""

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
    """Time, level and message on one line, escaped; a traceback below it."""

    def format(self, record: logging.LogRecord) -> str:
        text = f"{_time(record)} {record.levelname.lower()} {printable(masked(record.getMessage()))}"
        return f"{text}\n{masked(self.formatException(record.exc_info))}" if record.exc_info else text


def _time(record: logging.LogRecord) -> str:
    return datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds")


FORMATTERS = {"text": TextFormatter, "json": JsonFormatter}


@contextmanager
def logging_to_stderr(form: str, levels: Mapping[str, int]) -> Iterator[LogThread]:
    """Write the loggers' messages, from the given levels up, to stderr."""
    log = LogThread(sys.stderr, FORMATTERS[form]())
    with logging_by(log, levels):
        yield log


def add_log_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--log", choices=FORMATTERS, default="text", help="form of the log on stderr")
