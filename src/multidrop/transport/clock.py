"""The clock of polling and writing: CLOCK_MONOTONIC, as the C core reads it.

Deadlines of requests use CLOCK_BOOTTIME, which continues while the computer sleeps. Call these functions
through the module, as `clock.now_ns()`, so that tests can replace them in one place.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from multidrop.core import boottime_ns as boottime_ns
from multidrop.core import now_ns as core_now_ns
from multidrop.core import utc_minus_monotonic_ns

_speed: ContextVar[float] = ContextVar("speed", default=1.0)


def sleep(seconds: float) -> None:
    """Wait for `seconds`, or for a shorter time in the context of `at_speed`."""
    time.sleep(seconds / _speed.get())


if hasattr(time, "clock_gettime_ns"):  # faster than calling the core's function

    def now_ns() -> int:
        """Return the time of CLOCK_MONOTONIC in ns."""
        return time.clock_gettime_ns(time.CLOCK_MONOTONIC)

else:

    def now_ns() -> int:
        """Return the C core's time in ns, on a system without CLOCK_MONOTONIC in Python."""
        return int(core_now_ns())


def utc_ns() -> int:
    return int(now_ns() + utc_minus_monotonic_ns())


@contextmanager
def at_speed(speed: float) -> Iterator[None]:
    """Within the block, let `sleep` wait for only 1 / `speed` of its time, in this context and its copies.

    Other threads, which may command real drives, wait for the whole time.
    """
    token = _speed.set(speed)
    try:
        yield
    finally:
        _speed.reset(token)
