"""Direct gets: reads that any of the servers answers, and that go on while one of them is cut off.

A server hands such a question to any server that has the records: itself, or one behind a route, by chance.
One that is cut off gets its share of them until the others notice, which takes them some seconds. So what is
not answered soon is asked again, by all paths at once. Each answer may be old, as ever: whoever writes upon
it names the revision that he read.

Where all are slow, asking again makes them slower, until nobody has an answer in time. So there are so many
questions to spare and no more: at first none, and a read that is answered in time earns a part of one. An
answer that comes to the first question after all, which was late and not lost, halves what is left.

And who saw answers take long of late waits in proportion before he asks again. Where many gateways begin at
once, each reads whole buckets, and what their small questions earn would be spent on large ones.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from typing import Protocol

from multidrop.fleet.errors import NoRight, Unsure
from multidrop.fleet.servers.batch_client import DirectGet, DirectMessage, Request
from multidrop.supervisor import end_tasks

AGAIN_S = (0.1, 0.1, 0.2, 0.4, 1.0)  # without a message, before it is asked again; then it is given up
SLOW = 3.0  # so often what answers take of late is waited, before a question is asked again,
MOST_SILENCE_S = 1.0  # and no longer: a path gives up then
FORGET = 0.97  # of what they took, with each answer
MOST_SPARE = 300.0  # questions: twice what a gateway asks again in the 3 s until servers leave a dead route
EARNED = 0.5  # of a question, by an answer in time


class Way(Protocol):
    """A path to servers that may be asked."""

    async def gather(self, request: Request, get: DirectGet) -> None:
        """Gather what a direct get gives. Raises FleetError."""


class Spare:
    """The number of questions that one process may ask again, and how long it waits before that."""

    def __init__(self) -> None:
        self._left = 0.0
        self._took_s = MOST_SILENCE_S / SLOW  # by the slowest answers of late; at first it is not known

    def note(self, *, is_late: bool) -> None:
        """Learn that the first question was answered."""
        self._left = self._left / 2 if is_late else min(self._left + EARNED, MOST_SPARE)

    def learn(self, took_s: float) -> None:
        """Learn how long an answer took."""
        self._took_s = max(took_s, FORGET * self._took_s)

    def silence_s(self, least_s: float) -> float:
        """Return how long to wait for a message: this at least, and longer where answers take long."""
        return max(least_s, min(SLOW * self._took_s, MOST_SILENCE_S))

    def spend(self, ways: Sequence[Way]) -> Sequence[Way]:
        """Return those of the ways that may be asked again."""
        asked = ways[: int(self._left)]
        self._left -= len(asked)
        return asked


async def first_answer(ways: Sequence[Way], request: Request, spare: Spare) -> list[DirectMessage]:
    """Return the messages of the first whole answer. Raises FleetError where there is none.

    The first of the ways is asked alone: at rest it answers in an instant.
    """
    loop = asyncio.get_running_loop()
    gets: dict[asyncio.Task[None], DirectGet] = {}
    asked_at: dict[DirectGet, float] = {}
    first: DirectGet | None = None
    failure: BaseException = Unsure(f"nothing came to {request.subject}")
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
            is_refused = isinstance(failure, NoRight)  # by each of the servers, then
            if not gets and (number or not ways[1:] or is_refused):
                break
        raise failure
    finally:
        await end_tasks(*gets)


async def _is_one_over(gets: Mapping[asyncio.Task[None], DirectGet], silence_s: float) -> bool:
    """Wait until one of them is over. Return False where nothing comes for so long, or none is left."""
    while gets:
        before = sum(get.count for get in gets.values())
        done, _ = await asyncio.wait(gets, timeout=silence_s, return_when=asyncio.FIRST_COMPLETED)
        if done or sum(get.count for get in gets.values()) == before:
            return bool(done)
    return False
