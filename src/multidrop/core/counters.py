"""Counters of a drive's exchanges, as the core keeps them."""

from __future__ import annotations

from collections import Counter
from typing import Any, Literal, NamedTuple

from multidrop._core import ffi, lib
from multidrop.core.result import Status


class Counters(NamedTuple):
    """Counters of exchanges (struct md_counters); all but longest_ns and timeout_ns only grow."""

    exchanges: int = 0
    answered: int = 0
    values: int = 0
    sent: int = 0  # requests that began to leave
    exceptions: int = 0  # exchanges that ended with one
    naks: int = 0  # with code 07
    busies: int = 0  # with code 06
    late: int = 0
    stray_bytes: int = 0
    ideal_ns: int = 0
    longest_ns: int = 0  # response delay
    timeout_ns: int = 0  # at present
    ended: Counter[Status] = Counter()  # exchanges without a reply; broadcasts are OK
    missed: Counter[Status] = Counter()  # values
    refused: Counter[int] = Counter()  # values, by exception code
    delays: Counter[int] = Counter()  # replies, by the bucket of their response delay


DELAY_BUCKETS: int = lib.MD_DELAY_BUCKETS
_EDGES_NS = tuple(int(lib.md_delay_edge(bucket)) for bucket in range(DELAY_BUCKETS + 1))


def delay_edge(bucket: int) -> int:
    """Return the least response delay of a bucket, in ns; it ends where the next one begins."""
    return _EDGES_NS[bucket]


def read_counters(drive: Any, timeout_ns: int, unasked: Counter[Status]) -> Counters:
    """Read what a struct md_drive counted; `unasked` are values that were due and not asked for."""
    c, history = drive.counters, drive.history
    return Counters(
        c.exchanges,
        c.answered,
        c.values,
        c.sent,
        history.exceptions,
        history.naks,
        history.busies,
        history.late,
        c.stray_bytes,
        c.ideal_ns,
        c.longest_ns,
        timeout_ns,
        _by_status(history.ended),
        _by_status(history.missed) + unasked,
        _by_place(history.refused, "I") if history.exceptions else Counter(),
        _by_place(drive.delays, "Q"),
    )


def _by_status(array: Any) -> Counter[Status]:
    return Counter({Status(code): count for code, count in _by_place(array, "Q").items()})


def _by_place(array: Any, kind: Literal["I", "Q"]) -> Counter[int]:
    """Return the numbers that are not 0, by their index."""
    numbers = memoryview(ffi.buffer(array)).cast(kind)
    return Counter({index: number for index, number in enumerate(numbers) if number})
