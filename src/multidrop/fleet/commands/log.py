"""Command log: one line of JSON for each step of a command, on the disk before the next step is taken."""

from __future__ import annotations

import asyncio
import json
import os
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

_sync = getattr(os, "fdatasync", os.fsync)  # an asker may be on a system without it


class CommandLog:
    """The log in this file, which only grows. Raises OSError where it cannot be opened.

    A line that a crash or a full disk truncated harms no other: the next one begins a new line.
    """

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        self._file = path.open("a+b", buffering=0)
        self._disk = ThreadPoolExecutor(1, "multidrop log")  # a disk that hangs holds nothing else up

    async def note(self, record: Mapping[str, Any]) -> None:
        """Append a record with the time of day (UTC), and wait until the disk has it.

        Raises OSError, also once the log is closed.
        """
        loop = asyncio.get_running_loop()
        try:
            written = loop.run_in_executor(self._disk, self._add, record, time.time_ns())
        except RuntimeError:
            raise OSError(f"{self.path} is closed") from None
        await written

    def _add(self, record: Mapping[str, Any], now_ns: int) -> None:
        at = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(now_ns // 10**9))
        line = json.dumps({"time": f"{at}.{now_ns % 10**9 // 1000:06d}Z", **record}, ensure_ascii=False)
        whole = (b"\n" if self._is_truncated() else b"") + line.encode(errors="backslashreplace") + b"\n"
        if self._file.write(whole) < len(whole):
            raise OSError(f"{self.path}: there was room for a part of a record only")
        _sync(self._file.fileno())

    def _is_truncated(self) -> bool:
        if self._file.seek(0, os.SEEK_END) == 0:
            return False
        self._file.seek(-1, os.SEEK_END)
        return self._file.read(1) != b"\n"

    def close(self) -> None:
        """Close it after what is queued; a record that comes later is not taken."""
        self._disk.submit(self._file.close)
        self._disk.shutdown(wait=False)


class UnopenedLog:
    """A log that could not be opened: each attempt to note something in it says why."""

    def __init__(self, path: Path, failure: OSError) -> None:
        self.path = path
        self._failure = failure

    async def note(self, record: Mapping[str, Any]) -> None:
        """Raise the OSError that kept it from being opened."""
        raise self._failure

    def close(self) -> None:
        """Do nothing: there is no file."""


def open_log(path: Path) -> CommandLog | UnopenedLog:
    """Open the log in this file. One that cannot be opened fails when something is to be noted."""
    try:
        return CommandLog(path)
    except OSError as failure:
        return UnopenedLog(path, failure)
