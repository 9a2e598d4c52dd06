"""A log handler with its own thread, so that no stop waits for a halted terminal or a full pipe."""

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

MOST_WAITING = 10_000  # limit of the lines in the queue
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
        self._waiting: queue.Queue[str | None] = queue.Queue(MOST_WAITING)
        self._lost = 0
        self._thread = threading.Thread(target=self._write, name="multidrop log", daemon=True)
        self._thread.start()

    def is_alive(self) -> bool:
        return self._thread.is_alive()

    def emit(self, record: logging.LogRecord) -> None:
        """Queue a record without waiting; count it as lost if the queue is full."""
        try:
            self._waiting.put_nowait(self.format(record))
        except queue.Full:
            self._lost += 1

    def close(self) -> None:
        """Stop the thread; wait up to ENDING_S for the last lines."""
        with suppress(queue.Full):
            self._waiting.put_nowait(None)
        if self._thread.ident is not None:  # Ctrl-C may come before the thread's start
            self._thread.join(ENDING_S)
        super().close()

    def _write(self) -> None:
        while (line := self._waiting.get()) is not None:
            if self._lost:
                lost, self._lost = self._lost, 0
                text = f"{lost} later lines of the log are lost: its reader was too slow"
                self._put(
                    self.format(logging.LogRecord("multidrop", logging.WARNING, "", 0, text, None, None))
                )
            self._put(line)
        if self._file is not self._stream:
            with suppress(OSError):
                self._file.close()

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


@contextmanager
def logging_to_stderr(form: str, levels: Mapping[str, int]) -> Iterator[LogThread]:
    """While the context lasts, write these loggers' messages to stderr, from the given levels up."""
    log = LogThread(sys.stderr, FORMATTERS[form]())
    with logging_by(log, levels):
        yield log


def add_log_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--log", choices=FORMATTERS, default="text", help="form of the log on stderr")
