"""Time limit of writes: until when what is called within a block may be sent."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from math import inf

_until_ns: ContextVar[float] = ContextVar("multidrop time limit", default=inf)


def present_limit_ns() -> float:
    """Return the time (CLOCK_MONOTONIC, ns) until which what is called now may be sent; inf without one."""
    return _until_ns.get()


@contextmanager
def written_before(until_ns: int) -> Iterator[None]:
    """Write nothing of what is called within the block after this time of CLOCK_MONOTONIC, in ns.

    `time.monotonic_ns()` reads that clock. A write or a verb that is late is not sent, and raises Expired.
    Time that its own reads and waits may take is not counted, as for a bus's own `expiry`; the shorter of the
    two counts. Stops are sent whenever it is. It holds for this thread and what it calls, or this task of
    asyncio and `asyncio.to_thread`. Raises TypeError for what is no whole number.
    """
    if isinstance(until_ns, bool) or not isinstance(until_ns, int):
        raise TypeError(f"until_ns = {until_ns!r} is no time of CLOCK_MONOTONIC: give time.monotonic_ns() + n")
    token = _until_ns.set(min(_until_ns.get(), until_ns))
    try:
        yield
    finally:
        _until_ns.reset(token)
