"""The log's own thread: no stop waits for a terminal that was halted, or a pipe that nobody reads."""

from __future__ import annotations

import logging
import os
import queue
import threading
from contextlib import suppress
from typing import TextIO

MOST_WAITING = 10_000  # lines
ENDING_S = 1.0  # for which the last of them are waited for


class LogThread(logging.Handler):
    """Writes records to a stream's file on a thread of its own; those that find no room are counted."""

    def __init__(self, stream: TextIO, formatter: logging.Formatter) -> None:
        super().__init__()
        self.setFormatter(formatter)
        self._stream = self._file = stream
        with suppress(OSError):  # a stream in memory has no file
            # Its own: Python flushes that of `stream` when it ends, and would wait for one that is held up.
            own = os.dup(stream.fileno())
            self._file = os.fdopen(own, "w", 1, encoding=stream.encoding, errors="backslashreplace")
        self._waiting: queue.Queue[str | None] = queue.Queue(MOST_WAITING)
        self._lost = 0
        self._thread = threading.Thread(target=self._write, name="multidrop log", daemon=True)
        self._thread.start()

    def is_alive(self) -> bool:
        """True until the thread has ended: then nothing is logged any more."""
        return self._thread.is_alive()

    def emit(self, record: logging.LogRecord) -> None:
        """Take a record, without waiting."""
        try:
            self._waiting.put_nowait(self.format(record))
        except queue.Full:
            self._lost += 1

    def close(self) -> None:
        """Wait a second for the last lines; where nobody reads them they are left."""
        with suppress(queue.Full):
            self._waiting.put_nowait(None)
        self._thread.join(ENDING_S)
        super().close()

    def _write(self) -> None:
        while (line := self._waiting.get()) is not None:
            if self._lost:
                lost, self._lost = self._lost, 0
                said = f"{lost} later lines of the log are lost: nobody read it in time"
                self._put(
                    self.format(logging.LogRecord("multidrop", logging.WARNING, "", 0, said, None, None))
                )
            self._put(line)
        if self._file is not self._stream:
            with suppress(OSError):
                self._file.close()

    def _put(self, line: str) -> None:
        with suppress(OSError, ValueError):  # a full disk, or a reader that is gone
            self._file.write(f"{line}\n")
