"""Clocks: monotonic times for ages, and the time of day."""

from __future__ import annotations

import time

if hasattr(time, "CLOCK_MONOTONIC"):

    def monotonic_ns() -> int:
        """Return the time of CLOCK_MONOTONIC, the clock of rows."""
        return time.clock_gettime_ns(time.CLOCK_MONOTONIC)

else:

    def monotonic_ns() -> int:
        """Return the monotonic time, the clock of rows."""
        return time.monotonic_ns()


if hasattr(time, "CLOCK_BOOTTIME"):

    def boottime_ns() -> int:
        """Return the time of CLOCK_BOOTTIME, which includes sleep."""
        return time.clock_gettime_ns(time.CLOCK_BOOTTIME)

else:  # on macOS and Windows the monotonic clock includes sleep
    boottime_ns = monotonic_ns


def now_and_slept_ns() -> tuple[int, int]:
    """Return the monotonic time, and how long the computer has slept since its boot, both in ns.

    The order of the two reads ensures that a pause between them never counts as sleep.
    """
    booted_ns = boottime_ns()
    now_ns = monotonic_ns()
    return now_ns, booted_ns - now_ns


def utc_ms() -> int:
    """Return the time of day, in ms since 1970."""
    return time.time_ns() // 1_000_000
