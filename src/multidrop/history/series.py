"""Parse the names of series and the moments of a query."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import UTC, datetime, timedelta

Series = tuple[str, str]  # drive and register
Moment = int | datetime
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def parsed_series(series: str | Iterable[str] | None) -> list[Series] | None:
    """Return series as pairs of drive and register. Raises ValueError for an invalid name."""
    if series is None:
        return None
    found = []
    for name in [series] if isinstance(series, str) else series:
        drive, point, register = name.rpartition(".")
        if not (drive and point and register):
            raise ValueError(
                f"invalid series {name!r}: write a drive and a register, such as 'pump-1.motor_speed'"
            )
        found.append((drive, register))
    return list(dict.fromkeys(found))


def ns_of(moment: Moment) -> int:
    """Convert a moment (UTC in ns, or a datetime with a time zone) to UTC in ns."""
    if isinstance(moment, datetime):
        if moment.tzinfo is None:
            raise ValueError(f"{moment} has no time zone: write datetime(..., tzinfo=UTC)")
        return (moment - _EPOCH) // timedelta(microseconds=1) * 1000
    if isinstance(moment, bool) or not isinstance(moment, int):
        raise TypeError(f"a moment is UTC in ns or a datetime with a time zone, not {moment!r}")
    return moment
