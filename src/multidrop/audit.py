"""Audit log: every write that was sent, as one line of JSON in a file that only grows.

A line that was torn by a crash harms no other: the next process begins a new one.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from datetime import UTC, datetime
from io import SEEK_END
from pathlib import Path
from typing import Any


class AuditLog:
    """The log in this file; OSError when it cannot be opened or written."""

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self._file = self.path.open("ab", buffering=0)  # one call, one write: processes do not mix lines
        if _is_torn(self.path):
            self._file.write(b"\n")

    def add(self, utc_ns: int, record: dict[str, Any]) -> None:
        time = datetime.fromtimestamp(utc_ns // 10**9, UTC).strftime("%Y-%m-%dT%H:%M:%S")
        line = json.dumps({"time": f"{time}.{utc_ns % 10**9:09d}Z", **record}, ensure_ascii=False)
        self._file.write(line.encode() + b"\n")

    def close(self) -> None:
        self._file.close()


def _is_torn(path: Path) -> bool:
    with path.open("rb") as log:
        if log.seek(0, SEEK_END) == 0:
            return False
        log.seek(-1, SEEK_END)
        return log.read(1) != b"\n"


def read_audit(path: Path | str) -> Iterator[dict[str, Any]]:
    """The records of a log in order; what a crash has torn is passed over."""
    with Path(path).open("rb") as lines:
        for line in lines:
            try:
                record = json.loads(line)
            except ValueError:
                continue
            if isinstance(record, dict):
                yield record
