"""Clocks: monotonic time, boot time (which also runs while the computer sleeps), and UTC."""

from __future__ import annotations

import time
from datetime import UTC, datetime

if hasattr(time, "CLOCK_MONOTONIC"):

    def monotonic_ns() -> int:
        """Return the time of CLOCK_MONOTONIC in ns, the clock by which polled values are dated."""
        return time.clock_gettime_ns(time.CLOCK_MONOTONIC)

else:

    def monotonic_ns() -> int:
        return time.monotonic_ns()


if hasattr(time, "CLOCK_BOOTTIME"):

    def boottime_ns() -> int:
        """Return the time of CLOCK_BOOTTIME, which also runs while the computer sleeps, in ns."""
        return time.clock_gettime_ns(time.CLOCK_BOOTTIME)

else:  # on macOS and Windows the monotonic clock itself runs while the computer sleeps
    boottime_ns = monotonic_ns


def now_and_slept_ns() -> tuple[int, int]:
    """Return the monotonic time, and how long the computer has slept since its boot, both in ns."""
    booted_ns = boottime_ns()  # read first, so that a pause between the two reads never counts as sleep
    now_ns = monotonic_ns()
    return now_ns, booted_ns - now_ns


def iso_time(ms: int) -> str:
    """Return a time in ms since 1970 (UTC) as ISO 8601 text, such as 2026-11-22T09:30:00.123Z."""
    second, rest = divmod(ms, 1000)
    return f"{datetime.fromtimestamp(second, UTC):%Y-%m-%dT%H:%M:%S}.{rest:03d}Z"


def utc_ms() -> int:
    """Return the time of day, in ms since 1970."""
    return time.time_ns() // 1_000_000
