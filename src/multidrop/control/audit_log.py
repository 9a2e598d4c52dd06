"""Audit log: every write that was sent, as one line of JSON in a file that only grows.

A write is noted when its outcome is known: one that a killed process had under way is there only if it had to
be noted first (`noted_first`). A stop is noted when it is called, and each drive's when it ends.
A line that a crash or a full disk truncated harms no other: the next record begins a new line.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from io import SEEK_END
from pathlib import Path
from typing import Any

from multidrop.iso_time import format_time


class AuditLog:
    """The log in this file. Raises OSError when it cannot be opened or written."""

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self._file = self.path.open("a+b", buffering=0)  # one call, one write: processes do not mix lines

    def add(self, utc_ns: int, record: dict[str, Any]) -> None:
        """Append a record. Raises OSError, also when there was room for a part of it only."""
        line = json.dumps({"time": format_time(utc_ns), **record}, ensure_ascii=False)
        whole = (b"\n" if self._is_truncated() else b"") + line.encode(errors="backslashreplace") + b"\n"
        if self._file.write(whole) < len(whole):
            raise OSError(f"{self.path}: there was room for a part of a record only")

    def close(self) -> None:
        self._file.close()

    def _is_truncated(self) -> bool:
        """Return True where the last line has no end, whichever process began it."""
        if self._file.seek(0, SEEK_END) == 0:
            return False
        self._file.seek(-1, SEEK_END)
        return self._file.read(1) != b"\n"


def read_audit(path: Path | str) -> Iterator[dict[str, Any]]:
    """Yield the records of a log in order, without those that a crash truncated.

    Each has `time` (UTC), `port`, `drive`, `write` and `outcome`, and if they are known `model`, `address`,
    `sent` (the newest frame), `frames` (how many frames a stop took), `held` (what the drive holds since),
    `why`, `by` and `way` (see `written_by`). The `outcome` of what was about to be sent is "called". Raises
    OSError.
    """
    with Path(path).open("rb") as lines:
        for line in lines:
            try:
                record = json.loads(line)
            except (ValueError, RecursionError):
                continue
            if isinstance(record, dict):
                yield record
