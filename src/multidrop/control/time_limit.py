"""Time limit of writes: until when what is called within a block may be sent."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from math import inf

from multidrop.transport import clock

Limit = Callable[[], float]

MOST_EXPIRY_S = 1e6


def _none() -> float:
    return inf


_limit: ContextVar[Limit] = ContextVar("multidrop time limit", default=_none)


def present_limit_ns() -> float:
    """Return the time (CLOCK_BOOTTIME, ns) until which what is called now may be sent; inf without one."""
    return _limit.get()()


def checked_expiry(expiry: float, what: str) -> float:
    """Return it, if it is a time in s that a write's or a read's turn may take; else raise ValueError."""
    is_number = isinstance(expiry, (int, float)) and not isinstance(expiry, bool)
    if not is_number or not 0 < expiry <= MOST_EXPIRY_S:
        raise ValueError(
            f"expiry = {expiry!r} is not a number of seconds above 0 for {what}'s turn to come, "
            f"{MOST_EXPIRY_S:.0f} at most"
        )
    return expiry


def _called(limit: Limit) -> float:
    if not callable(limit):
        raise TypeError(f"limit = {limit!r} is no function that returns a time of CLOCK_MONOTONIC in ns")
    at_ns = limit()
    return at_ns if at_ns == at_ns else 0  # NaN is later than nothing, and no call would be too late


@contextmanager
def written_before(limit: Limit) -> Iterator[None]:
    """Send nothing of a call within the block whose first write would leave after the time of `limit`.

    `limit` returns a time of CLOCK_MONOTONIC in ns, as `time.monotonic_ns()` does; 0 is always past. It is
    called when a call begins; from then on a stop ends that call. So whoever notes a stop, and has `limit`
    return 0 from then on, misses none. A call that is too late sends nothing and raises Expired; time for
    which the machine sleeps within the block counts. The later writes of a verb have the bus's own `expiry`,
    and are not cut off. Stops are sent at any time. The block is that of this thread and what it calls, or of
    this task of asyncio and `asyncio.to_thread`. With what is no function each call raises TypeError, but
    for stops.
    """
    outer = _limit.get()
    slept_ns = clock.boottime_ns() - clock.now_ns()  # so far; read in this order, it is never too long
    token = _limit.set(lambda: min(outer(), _called(limit) + slept_ns))
    try:
        yield
    finally:
        _limit.reset(token)
