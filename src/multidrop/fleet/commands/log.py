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
MOST_WAITING = 1000  # limit of records that wait for the disk
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
        self._latest: asyncio.Task[None] | None = None  # the task that writes the latest record
        self._writing = threading.Lock()
        self._is_closed = False
        self._waiting = 0

    def open(self) -> AuditLog:
        """Open the file unless it is open. Raises OSError."""
        if self._log is None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._log = AuditLog(self.path)
        return self._log

    async def note(self, record: Mapping[str, Any]) -> None:
        """Append a record with the time of day (UTC), and return once it is synced to the disk.

        Raises OSError if the writing fails, if the log is closed, if MOST_WAITING records wait already, or if
        the system cannot start a thread. Raises OSError too if the writing takes longer than WRITING_S; the
        record is then written as soon as the disk answers.
        """
        if self._waiting >= MOST_WAITING:
            raise OSError(f"{self.path}: {MOST_WAITING} records are already waiting; does the disk answer?")
        self._waiting += 1
        work = self._write(record, time.time_ns(), self._latest)
        self._latest = writing = supervisor().start("command log", work)
        writing.add_done_callback(self._note_end)
        await asyncio.wait([writing], timeout=WRITING_S)
        if not writing.done():
            raise OSError(f"{self.path}: not written within {WRITING_S:g} s; does the disk answer?")
        writing.result()

    def _note_end(self, writing: asyncio.Task[None]) -> None:
        self._waiting -= 1
        if not writing.cancelled():
            writing.exception()  # read it, because asyncio logs an error for one that is never read

    async def _write(
        self, record: Mapping[str, Any], now_ns: int, earlier: asyncio.Task[None] | None
    ) -> None:
        if earlier is not None and not earlier.done():
            await asyncio.wait([earlier])
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
