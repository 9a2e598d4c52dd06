"""The clock of all that is polled and written: CLOCK_MONOTONIC, as the core reads it.

Call these through the module, `clock.now_ns()`: a test then replaces them in one place.
"""

from __future__ import annotations

import time

from multidrop.core import utc_minus_monotonic_ns

sleep = time.sleep


def now_ns() -> int:
    """Return the time of CLOCK_MONOTONIC in ns."""
    return time.clock_gettime_ns(time.CLOCK_MONOTONIC)


def utc_ns() -> int:
    """Return the same moment as UTC in ns."""
    return int(now_ns() + utc_minus_monotonic_ns())
