"""Direct gets: reads that any server can answer, and that continue while one server is cut off.

A server passes such a read to a random server that has the records: to itself, or over a route. A server that
is cut off still gets its share of the reads until the others notice, which takes seconds. So a read without
an early answer is repeated on all paths together. Each answer may be out of date: a write that builds on it
names the revision that was read.

If all servers are slow, repeated reads make them even slower. So repeats have a budget: it is empty at first,
and each timely answer earns half a repeat. If the first request of a read is answered late, it was not lost,
and the budget is halved.

A client that has seen slow answers also waits proportionally longer before a repeat. Otherwise, when many
gateways start together and read whole buckets, the repeats that small reads have earned would be spent on
large reads.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from typing import Protocol

from multidrop.fleet.errors import NoRight, Unsure
from multidrop.fleet.servers.batch_client import DirectGet, DirectMessage, Request
from multidrop.supervisor import end_tasks

AGAIN_S = (0.1, 0.1, 0.2, 0.4, 1.0)  # silence before each repeat; after the last one the read fails
SLOW = 3.0  # wait this multiple of the usual time of an answer before a repeat,
MOST_SILENCE_S = 1.0  # but at most this long, because a path gives up then
FORGET = 0.97  # decay of the usual time with each answer
MOST_SPARE = 300.0  # limit of the budget: twice the need of the 3 s until servers leave a dead route
EARNED = 0.5  # repeats that a timely answer earns


class Way(Protocol):
    """A path to servers."""

    async def gather(self, request: Request, get: DirectGet) -> None:
        """Collect the result of a direct get. Raises FleetError."""


class Spare:
    """The budget of repeats of one process, and how long to wait before a repeat."""

    def __init__(self) -> None:
        self._left = 0.0
        self._took_s = MOST_SILENCE_S / SLOW  # usual time of an answer; assumed at first

    def note(self, *, is_late: bool) -> None:
        """Update the budget after an answer to the first request of a read."""
        self._left = self._left / 2 if is_late else min(self._left + EARNED, MOST_SPARE)

    def learn(self, took_s: float) -> None:
        """Update the usual time of an answer."""
        self._took_s = max(took_s, FORGET * self._took_s)

    def silence_s(self, least_s: float) -> float:
        """Return how long to wait for a message: at least `least_s`, longer if answers are slow."""
        return max(least_s, min(SLOW * self._took_s, MOST_SILENCE_S))

    def spend(self, ways: Sequence[Way]) -> Sequence[Way]:
        """Return the paths on which the budget allows a repeat, and charge it for them."""
        asked = ways[: int(self._left)]
        self._left -= len(asked)
        return asked


async def first_answer(ways: Sequence[Way], request: Request, spare: Spare) -> list[DirectMessage]:
    """Return the messages of the first complete answer. Raises FleetError if there is none.

    The first path is asked alone at first, because it usually answers immediately.
    """
    loop = asyncio.get_running_loop()
    gets: dict[asyncio.Task[None], DirectGet] = {}
    asked_at: dict[DirectGet, float] = {}
    first: DirectGet | None = None
    failure: BaseException = Unsure(f"no answer to {request.subject}")
    try:
        for number, least_s in enumerate(AGAIN_S):
            again = ways[1:] if number == 1 and ways[1:] else ways
            for way in spare.spend(again) if number else ways[:1]:
                get = DirectGet()
                first = first or get
                asked_at[get] = loop.time()
                gets[asyncio.create_task(way.gather(request, get))] = get
            while await _is_one_over(gets, spare.silence_s(least_s)):
                for task in [task for task in gets if task.done()]:
                    get = gets.pop(task)
                    if not (failed := task.exception()):
                        spare.learn(loop.time() - asked_at[get])
                        if get is first:
                            spare.note(is_late=number > 0)
                        return get.messages
                    failure = failed
            is_refused = isinstance(failure, NoRight)  # one server speaks for all: all have the same rights
            if not gets and (number or not ways[1:] or is_refused):
                break
        raise failure
    finally:
        await end_tasks(*gets)


async def _is_one_over(gets: Mapping[asyncio.Task[None], DirectGet], silence_s: float) -> bool:
    """Wait until one request ends. Return False after `silence_s` without data, or if none is left."""
    while gets:
        before = sum(get.count for get in gets.values())
        done, _ = await asyncio.wait(gets, timeout=silence_s, return_when=asyncio.FIRST_COMPLETED)
        if done or sum(get.count for get in gets.values()) == before:
            return bool(done)
    return False
