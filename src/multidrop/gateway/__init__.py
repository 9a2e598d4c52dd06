"""The gateway: one process that polls the lines and serves the values to browsers and other programs."""

import time


def utc_ms() -> int:
    """Return the time of day, in ms since 1970."""
    return time.time_ns() // 1_000_000
