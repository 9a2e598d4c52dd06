"""Time limit of writes: until when what is called within a block may be sent."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from math import inf

Limit = Callable[[], float]


def _none() -> float:
    return inf


_limit: ContextVar[Limit] = ContextVar("multidrop time limit", default=_none)


def present_limit_ns() -> float:
    """Return the time (CLOCK_MONOTONIC, ns) until which what is called now may be sent; inf without one."""
    return _limit.get()()


@contextmanager
def written_before(limit: Limit) -> Iterator[None]:
    """Write nothing of what is called within the block after the time that `limit` returns.

    That is a time of CLOCK_MONOTONIC in ns, as `time.monotonic_ns()` has it; 0 is always past. It is asked
    for as each call begins, when a stop that is called from then on ends that call: so whoever notes a stop,
    and lets `limit` return 0 since, misses none. What is late is not sent, and raises Expired. Time that its
    own reads and waits may take is not counted, as for a bus's own `expiry`; the earlier one counts. Stops
    are sent whenever it is. It holds for this thread and what it calls, or this task of asyncio and
    `asyncio.to_thread`. Raises TypeError for what is no function.
    """
    if not callable(limit):
        raise TypeError(f"limit = {limit!r} is no function that returns a time of CLOCK_MONOTONIC in ns")
    outer = _limit.get()
    token = _limit.set(lambda: min(outer(), limit()))
    try:
        yield
    finally:
        _limit.reset(token)
