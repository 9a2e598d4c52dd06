"""CommandLog: a file with a line of JSON for each step of a command."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from multidrop.control import AuditLog
from multidrop.supervisor import supervisor

WRITING_S = 10.0  # time limit for writing a record; after it, the disk is reported as hanging
CLOSING_S = 1.0  # how long `close` waits for a record that is being written


class CommandLog:
    """A file with one line of JSON for each step of a command.

    `note` returns once its line is on the disk, so that a caller can log a step before taking it. Each record
    is written in its own daemon thread, so a disk that hangs blocks neither the event loop nor the exit of
    the process.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._log: AuditLog | None = None
        self._turn = asyncio.Lock()  # writes records in the order of the calls
        self._writing = threading.Lock()
        self._is_closed = False

    def open(self) -> AuditLog:
        """Open the file unless it is open. Raises OSError."""
        if self._log is None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._log = AuditLog(self.path)
        return self._log

    async def note(self, record: Mapping[str, Any]) -> None:
        """Append a record with the time of day (UTC), and return once it is synced to the disk.

        Raises OSError if that fails, if the log is closed, or if the system cannot start a thread.
        """
        now_ns = time.time_ns()
        async with self._turn:
            if self._is_closed:
                raise OSError(f"{self.path} is closed")
            try:
                await supervisor().thread("command log", WRITING_S, lambda: self._add(record, now_ns))
            except OSError:
                raise
            except Exception as failure:  # the thread that writes the record did not start, or failed
                raise OSError(f"{self.path}: {type(failure).__name__}: {failure}") from failure

    def _add(self, record: Mapping[str, Any], now_ns: int) -> None:
        with self._writing:
            log = self.open()
            log.add(now_ns, dict(record))
            log.sync()

    def close(self) -> None:
        """Wait until the record in progress is written, then close the file; later records are refused."""
        self._is_closed = True
        if self._writing.acquire(timeout=CLOSING_S):
            if self._log:
                self._log.close()
            self._writing.release()
