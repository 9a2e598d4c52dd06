"""Queries of the audit log's newest records, for the page."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from multidrop.control import read_audit
from multidrop.gateway.http.messages import Denied

MOST_RECORDS = 200  # limit of an answer

_UTC = re.compile(r"\d{4}-\d\d-\d\d(T\d\d:\d\d(:\d\d(\.\d+)?)?Z?)?", re.ASCII)  # or a prefix, as of a day


def time_asked(query: Mapping[str, str]) -> str:
    """Return the `before` of a query, "" without one. Raises Denied if it is not a UTC time."""
    if "before" in query and not _UTC.fullmatch(query["before"]):
        wrong = query["before"][:40]
        raise Denied(400, f"before = {wrong!r} is not a time in UTC, such as 2026-11-22 or 2026-11-22T09:30")
    return query.get("before", "")


def newest_records(path: Path | None, before: str = "", count: int = MOST_RECORDS) -> dict[str, Any]:
    """Return `count` entries before this time (ISO 8601, UTC; "" for all), the newest first.

    `more` is True if there are older entries. Raises OSError.
    """
    count = max(1, min(count, MOST_RECORDS))
    found: deque[dict[str, Any]] = deque(maxlen=count + 1)
    if path is not None and path.exists():
        found += (record for record in read_audit(path) if not before or str(record.get("time", "")) < before)
    newest = list(reversed(found))
    return {"entries": newest[:count], "more": len(newest) > count}
