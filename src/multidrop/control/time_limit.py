"""Deadlines for writes: `written_before` sets one for the calls within a block."""

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
    """Return the deadline of calls in this context (CLOCK_BOOTTIME, ns); inf if there is none."""
    return _limit.get()()


def check_expiry(expiry: float) -> None:
    """Raise ValueError unless `expiry` is a positive number of seconds."""
    is_number = isinstance(expiry, (int, float)) and not isinstance(expiry, bool)
    if not is_number or not 0 < expiry <= MOST_EXPIRY_S:
        raise ValueError(f"expiry = {expiry!r} is not a number of s above 0, at most {MOST_EXPIRY_S:.0f}")


def _called(limit: Limit) -> float:
    if not callable(limit):
        raise TypeError(f"limit = {limit!r} must be a function that returns a time of CLOCK_MONOTONIC in ns")
    at_ns = limit()
    return at_ns if at_ns == at_ns else 0  # NaN compares as never late


@contextmanager
def written_before(limit: Limit) -> Iterator[None]:
    """Within the block, raise Expired if a call's first write cannot be sent by the time of `limit`.

    `limit` is called at the start of each call. It returns a time in ns on the clock of
    `time.monotonic_ns()`; 0 is always past. A stop that is called after `limit` returned cancels the call. So
    a program whose `limit` returns 0 once it has seen a stop sends no write after a stop. Time that the
    computer sleeps within the block counts. A verb's later writes expire by the bus's own `expiry`. Stops
    are always sent.

    The block applies to this thread, or to this task and its calls of `asyncio.to_thread`. If `limit` is not
    a function, each call except a stop raises TypeError.
    """
    outer = _limit.get()
    slept_ns = clock.boottime_ns() - clock.now_ns()  # read in this order, the difference is never too large
    token = _limit.set(lambda: min(outer(), _called(limit) + slept_ns))
    try:
        yield
    finally:
        _limit.reset(token)
