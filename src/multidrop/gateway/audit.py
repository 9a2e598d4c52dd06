"""The audit log's newest records, for the page."""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import Any

from multidrop import read_audit

MOST_RECORDS = 200  # of an answer


def newest_records(path: Path | None, before: str = "") -> list[dict[str, Any]]:
    """Return records before this time (ISO 8601, UTC; "": all), the newest first. Raises OSError."""
    if path is None or not path.exists():
        return []
    found: deque[dict[str, Any]] = deque(maxlen=MOST_RECORDS)
    for record in read_audit(path):
        if not before or str(record.get("time", "")) < before:
            found.append(record)
    return list(reversed(found))
