"""The core's clock, read and waited for in Python."""

from __future__ import annotations

import time

sleep = time.sleep


def now_ns() -> int:
    """CLOCK_MONOTONIC, the core's clock."""
    return time.clock_gettime_ns(time.CLOCK_MONOTONIC)
