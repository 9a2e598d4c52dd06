"""Clock: the times by which the gateway judges ages, which nobody sets, and the time of day."""

from __future__ import annotations

import time

if hasattr(time, "CLOCK_MONOTONIC"):

    def monotonic_ns() -> int:
        """Return the time of CLOCK_MONOTONIC, as rows have it."""
        return time.clock_gettime_ns(time.CLOCK_MONOTONIC)

else:

    def monotonic_ns() -> int:
        """Return the time of the clock that never steps, as rows have it."""
        return time.monotonic_ns()


if hasattr(time, "CLOCK_BOOTTIME"):

    def boottime_ns() -> int:
        """Return the time of CLOCK_BOOTTIME, which runs on while the machine sleeps."""
        return time.clock_gettime_ns(time.CLOCK_BOOTTIME)

else:  # on macOS and Windows the other one runs on, too
    boottime_ns = monotonic_ns


def now_and_slept_ns() -> tuple[int, int]:
    """Return the present time, and for how long the machine slept so far.

    Read in this order, that is never too much where a pause comes in between.
    """
    booted_ns = boottime_ns()
    now_ns = monotonic_ns()
    return now_ns, booted_ns - now_ns


def utc_ms() -> int:
    """Return the time of day, in ms since 1970."""
    return time.time_ns() // 1_000_000
