"""The audit log's newest records, for the page."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from multidrop.control import read_audit
from multidrop.gateway.http.messages import Denied

MOST_RECORDS = 200  # of an answer

_UTC = re.compile(
    r"\d{4}-\d\d-\d\d(T\d\d:\d\d(:\d\d(\.\d+)?)?Z?)?", re.ASCII
)  # also of its beginning, such as a day


def time_asked(query: Mapping[str, str]) -> str:
    """Return the time before which records are asked for; "": all. Raises Denied for what is no UTC time."""
    if "before" in query and not _UTC.fullmatch(query["before"]):
        wrong = query["before"][:40]
        raise Denied(400, f"before = {wrong!r} is no time in UTC, such as 2026-11-22 or 2026-11-22T09:30")
    return query.get("before", "")


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
