"""CommandLog: a file with a line of JSON for each step of a command."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Mapping
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import Any

from multidrop.control import AuditLog
from multidrop.transport import AsideThread

WRITING_S = 10.0  # time limit for writing a record; after it, the disk is reported as hanging
MOST_WAITING = 1000  # limit of records that wait for the disk
CLOSING_S = 1.0  # how long `close` waits for a record that is being written

_thread = AsideThread("multidrop command log")  # one for all logs, because such a thread never ends


class CommandLog:
    """A file with one line of JSON for each step of a command.

    `note` returns once its line is on the disk, so that a caller can log a step before taking it. A separate
    thread writes the records, so a disk that hangs blocks neither the event loop nor the exit of the process.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._log: AuditLog | None = None
        self._is_closed = False

    def open(self) -> AuditLog:
        """Open the file unless it is open. Raises OSError."""
        if self._log is None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._log = AuditLog(self.path)
        return self._log

    async def note(self, record: Mapping[str, Any]) -> None:
        """Append a record with the time of day (UTC), and return once it is synced to the disk.

        Raises OSError if the writing fails, if the log is closed, or if MOST_WAITING records wait already.
        Raises OSError too if the writing takes longer than WRITING_S; the record is then written as soon as
        the disk answers.
        """
        written: Future[None] = Future()
        if not _thread.put(partial(self._write, written, record, time.time_ns()), MOST_WAITING):
            raise OSError(f"{self.path}: {MOST_WAITING} records are already waiting; does the disk answer?")
        done = asyncio.wrap_future(written)
        # read the exception, because asyncio logs an error for one that is never read
        done.add_done_callback(lambda ended: ended.cancelled() or ended.exception())
        await asyncio.wait([done], timeout=WRITING_S)
        if not done.done():
            raise OSError(f"{self.path}: not written within {WRITING_S:g} s; does the disk answer?")
        done.result()

    def _write(self, written: Future[None], record: Mapping[str, Any], now_ns: int) -> None:
        try:
            self._add(record, now_ns)
        except OSError as failure:
            written.set_exception(failure)
        except BaseException as failure:  # even SystemExit must not end the thread
            written.set_exception(OSError(f"{self.path}: {type(failure).__name__}: {failure}"))
        else:
            written.set_result(None)

    def _add(self, record: Mapping[str, Any], now_ns: int) -> None:
        if self._is_closed:
            raise OSError(f"{self.path} is closed")
        log = self.open()
        log.add(now_ns, dict(record))
        log.sync()

    def close(self) -> None:
        """Wait until the record in progress is written, then close the file; later records are refused."""
        self._is_closed = True
        if _thread.flush(CLOSING_S) and self._log:
            self._log.close()
