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
    """Begin to write nothing of what is called within the block after the time that `limit` returns.

    That is a time of CLOCK_MONOTONIC in ns, as `time.monotonic_ns()` has it; 0 is always past. It is asked
    for as each call begins, when a stop that is called from then on ends that call: so whoever notes a stop,
    and lets `limit` return 0 since, misses none. A call whose first write would leave later than that sends
    nothing, and raises Expired; the further writes of a verb have the bus's own `expiry`, and are not cut
    off. Stops are sent whenever it is. The block is that of this thread and what it calls, or of this task of
    asyncio and `asyncio.to_thread`. Raises TypeError for what is no function.
    """
    if not callable(limit):
        raise TypeError(f"limit = {limit!r} is no function that returns a time of CLOCK_MONOTONIC in ns")
    outer = _limit.get()
    token = _limit.set(lambda: min(outer(), limit()))
    try:
        yield
    finally:
        _limit.reset(token)
