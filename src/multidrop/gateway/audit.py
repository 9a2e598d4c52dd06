"""The audit log's newest records, for the page."""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import Any

from multidrop import read_audit

MOST_RECORDS = 200  # of an answer


def newest_records(path: Path | None, before: str = "", count: int = MOST_RECORDS) -> dict[str, Any]:
    """Return so many `entries` before this time (ISO 8601, UTC; "": all), the newest first.

    `more` tells whether there are older ones. Raises OSError.
    """
    count = max(1, min(count, MOST_RECORDS))
    found: deque[dict[str, Any]] = deque(maxlen=count + 1)
    if path is not None and path.exists():
        found += (record for record in read_audit(path) if not before or str(record.get("time", "")) < before)
    newest = list(reversed(found))
    return {"entries": newest[:count], "more": len(newest) > count}
