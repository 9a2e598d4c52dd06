"""A thread for each command, so that none waits for another; and what is done where the system gives none."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from math import inf
from typing import TypeVar

from multidrop.fleet.commands.words import CommandAnswer
from multidrop.supervisor import supervisor

AGAIN_S = 0.2  # between turns of stops that have no thread
TURN_S = 0.2  # of such a stop: nothing else is done meanwhile
STOP_S = 30.0  # for which such a stop is repeated

R = TypeVar("R")
Answers = dict[str, CommandAnswer]
StopWork = Callable[[float | None], Answers]  # takes for how many s the stop is repeated; None: as is usual


def in_own_thread(work: Callable[[], R]) -> asyncio.Future[R]:
    """Begin work in a thread of its own, or here and now where the system gives none."""
    try:
        return _in_thread(work)
    except (RuntimeError, MemoryError):
        future: asyncio.Future[R] = asyncio.get_running_loop().create_future()
        future.set_result(work())
        return future


def begin_stops(works: Sequence[StopWork]) -> list[asyncio.Future[Answers]]:
    """Begin stops, each in a thread of its own.

    Where the system gives no more threads, those that are left are carried out in the loop.
    """
    begun: list[asyncio.Future[Answers]] = []
    try:
        for work in works:
            future = _in_thread(partial(work, None))
            begun.append(future)
    except (RuntimeError, MemoryError):
        begun.append(asyncio.ensure_future(_without_threads(works[len(begun) :])))
    return begun


async def _without_threads(works: Sequence[StopWork]) -> Answers:
    """Send all stops before any motor is waited for; then repeat them in turns, or in threads that come free.

    The loop goes on between them: it renews the lease, without which no stop may be sent.
    """
    loop = asyncio.get_running_loop()
    found: Answers = {}
    for work in works:
        found |= work(0.0)
        await asyncio.sleep(0)
    left, waited = deque(works), []
    ends = loop.time() + STOP_S
    while left and loop.time() < ends:
        await asyncio.sleep(AGAIN_S)
        work = left.popleft()
        try:
            waited.append(_in_thread(partial(work, None)))
        except (RuntimeError, MemoryError):
            told = work(TURN_S)
            found |= told
            if not all(answer.is_done for answer in told.values()):
                left.append(work)
    for answers in await asyncio.gather(*waited):
        found |= answers
    return found


def _in_thread(work: Callable[[], R]) -> asyncio.Future[R]:
    """Begin work in a thread of its own. Raises RuntimeError or MemoryError where the system gives none."""
    return supervisor().thread("command", inf, work)
