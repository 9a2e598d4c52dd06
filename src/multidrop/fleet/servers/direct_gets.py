"""Direct gets: reads that any server can answer, and that continue to work while one server is cut off.

A server forwards such a read to a random server that has the records: to itself, or to another one. A
server that is cut off still gets its share of the reads for seconds, until the others notice. So a read
without an early answer is repeated on all paths together. Each answer may be out of date. A write that
depends on such an answer therefore names the revision that was read.

If all servers are slow, repeated reads make them even slower. So repeats have a budget, which is empty at
first. Each timely answer earns half a repeat. If a read was repeated, and its first request is answered after
all, the repeat was needless, and the budget is halved.

A client that has seen slow answers also waits proportionally longer before a repeat. Otherwise, when many
gateways start and read whole buckets, these large reads would use up the repeats that small reads have
earned.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from typing import Protocol

from multidrop.fleet.errors import NoRight, Unsure
from multidrop.fleet.servers.batch_client import DirectGet, DirectMessage, Request
from multidrop.supervisor import end_tasks

# silence before each repeat of a read; after the last silence the read fails
AGAIN_S = (0.1, 0.1, 0.2, 0.4, 1.0)
SLOW = 3.0  # silence before a repeat, as a multiple of the usual time of an answer
MOST_SILENCE_S = 1.0  # limit of the silence before a repeat, because requests time out then
FORGET = 0.97  # factor by which the usual time of an answer decays with each answer
MOST_SPARE = 300.0  # limit of the budget: twice the repeats needed until servers notice a dead route (3 s)
EARNED = 0.5  # repeats that each timely answer adds to the budget


class Way(Protocol):
    """A network connection to the servers, such as ServerPath."""

    async def gather(self, request: Request, get: DirectGet) -> None:
        """Collect the answer to a direct get. Raises FleetError."""


class Spare:
    """The budget for repeated reads of one process, and how long to wait before a repeat."""

    def __init__(self) -> None:
        self._left = 0.0
        self._took_s = MOST_SILENCE_S / SLOW  # usual time of an answer; at first an assumed value

    def note(self, *, is_late: bool) -> None:
        """Update the budget when the first request of a read was answered.

        `is_late` means that the read was repeated before the answer came.
        """
        self._left = self._left / 2 if is_late else min(self._left + EARNED, MOST_SPARE)

    def learn(self, took_s: float) -> None:
        """Update the usual time of an answer."""
        self._took_s = max(took_s, FORGET * self._took_s)

    def silence_s(self, least_s: float) -> float:
        """Return how many seconds to wait for a message: at least `least_s`, more if answers are slow."""
        return max(least_s, min(SLOW * self._took_s, MOST_SILENCE_S))

    def spend(self, ways: Sequence[Way]) -> Sequence[Way]:
        """Return as many of these paths as the budget allows; charge the budget for these repeats."""
        asked = ways[: int(self._left)]
        self._left -= len(asked)
        return asked


async def first_answer(ways: Sequence[Way], request: Request, spare: Spare) -> list[DirectMessage]:
    """Return the messages of the first complete answer. Raises FleetError if no complete answer comes.

    The request is first sent on the first path only, because that path usually answers immediately.
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
            is_refused = isinstance(failure, NoRight)  # all servers grant the same rights
            if not gets and (number or not ways[1:] or is_refused):
                break
        raise failure
    finally:
        await end_tasks(*gets)


async def _is_one_over(gets: Mapping[asyncio.Task[None], DirectGet], silence_s: float) -> bool:
    """Wait until one of the requests has ended, and return True.

    Return False after `silence_s` seconds without data, or if no request is left.
    """
    while gets:
        before = sum(get.count for get in gets.values())
        done, _ = await asyncio.wait(gets, timeout=silence_s, return_when=asyncio.FIRST_COMPLETED)
        if done or sum(get.count for get in gets.values()) == before:
            return bool(done)
    return False
