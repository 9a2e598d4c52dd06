"""AuditLog: an append-only file of JSON lines that records every write that was sent.

A write is recorded when its outcome is known. If the process is killed while a write is in flight, the write
is only recorded if it was made within `noted_first`. A stop is recorded when it is called, and again for each
drive when it ends. A line that a crash or a full disk truncated does not damage the next record.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from multidrop.iso_time import format_time

OPENING_S = 5.0  # timeout for opening the file

_sync = getattr(os, "fdatasync", os.fsync)  # macOS has no fdatasync


class AuditLog:
    """The audit log in the file `path`. Raises OSError if it cannot be opened within OPENING_S seconds."""

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self._file = _opened(self.path)

    def add(self, utc_ns: int, record: dict[str, Any]) -> None:
        """Append a record. Raises OSError, also if only a part of it was written."""
        line = json.dumps({"time": format_time(utc_ns), **record}, ensure_ascii=False)
        whole = (b"\n" if self._is_truncated() else b"") + line.encode(errors="backslashreplace") + b"\n"
        if self._file.write(whole) < len(whole):
            raise OSError(f"{self.path}: only a part of a record was written")

    def sync(self) -> None:
        """Flush all records to the disk. Raises OSError."""
        _sync(self._file.fileno())

    def close(self) -> None:
        self._file.close()

    def _is_truncated(self) -> bool:
        """Return True if the last line is incomplete, whichever process wrote it."""
        if self._file.seek(0, os.SEEK_END) == 0:
            return False
        self._file.seek(-1, os.SEEK_END)
        return self._file.read(1) != b"\n"


def _opened(path: Path) -> IO[bytes]:
    """Open the log with a timeout, because a disk may hang."""
    from multidrop.supervisor import in_time  # loads asyncio: 4 MB that a poller without a log saves

    def open_file() -> IO[bytes]:
        return path.open("a+b", buffering=0)  # one write per record: processes do not mix their lines

    try:
        return in_time("audit log", OPENING_S, open_file)
    except RuntimeError:  # the system has no thread left
        return open_file()


def read_audit(path: Path | str) -> Iterator[dict[str, Any]]:
    """Yield the records of a log in order, without truncated ones. Raises OSError.

    Each record has `time` (UTC), `port`, `drive`, `write` and `outcome`. If known, it also has `model`,
    `address`, `sent` (the newest frame), `frames` (the number of frames of a stop), `held` (the value that
    the drive holds), `why`, `by`, `way` and `id` (see `written_by`). The outcome "called" means that the
    write is about to be sent.
    """
    with Path(path).open("rb") as lines:
        for line in lines:
            try:
                record = json.loads(line)
            except (ValueError, RecursionError):
                continue
            if isinstance(record, dict):
                yield record
