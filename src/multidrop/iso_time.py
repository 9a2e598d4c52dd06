"""UTC in ns as ISO 8601 text, such as 2026-11-21T09:30:00.123456789Z."""

from __future__ import annotations

from datetime import datetime, timedelta
from functools import lru_cache

_EPOCH = datetime(1970, 1, 1)
_SECOND_NS = 1_000_000_000


def format_time(time_ns: int) -> str:
    """Return a time in ns since 1970 (UTC) as text."""
    second, rest = divmod(time_ns, _SECOND_NS)
    return f"{_format_second(second)}.{rest:09d}Z"


def parse_time(text: str) -> int:
    """Return the ns since 1970 (UTC). Raises ValueError unless the text has the form of `format_time`."""
    second, dot, rest = text.partition(".")
    if not dot or len(rest) != 10 or rest[-1] != "Z":
        raise ValueError(text)
    return _parse_second(second) * _SECOND_NS + int(rest[:-1])


@lru_cache(maxsize=1024)
def _format_second(second: int) -> str:
    return (_EPOCH + timedelta(seconds=second)).isoformat()


@lru_cache(maxsize=1024)
def _parse_second(text: str) -> int:
    return (datetime.fromisoformat(text).replace(tzinfo=None) - _EPOCH) // timedelta(seconds=1)
