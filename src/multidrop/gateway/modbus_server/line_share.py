"""LineShare: the share of a line's time that reads of Modbus clients and vendors' tools may use.

Such reads are sent to the drives one at a time, before polls. Their time is measured, so timeouts of a silent
drive count too.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any

from multidrop.supervisor import supervisor

SHARE = 0.2  # default share of a line's time
BURST_S = 0.2  # limit of the unused line time, in s, that clients save up
MOST_WAITING = 8  # limit of waiting requests per line
EXPIRY_S = 1.0  # a request that has waited for this long is dropped
CLOSED = "the gateway is shutting down, or has read its plant file again"


class PassingBusy(Exception):
    """A request was dropped: the queue was full, or the line was not free in time."""


@dataclass(eq=False)
class _WaitingAsk:
    client: object
    work: Callable[[float], Awaitable[Any]]
    answer: asyncio.Future[Any]
    expires: float  # time of the event loop's clock in s
    timer: asyncio.TimerHandle | None = None


class LineShare:
    """Sends all clients' requests on one line: one at a time, in order, within a share of the line's time."""

    def __init__(self, share: float = SHARE) -> None:
        self._loop = asyncio.get_running_loop()
        self.share = share
        self._waiting: list[_WaitingAsk] = []
        self._running: asyncio.Task[None] | None = None
        self._left_s = BURST_S  # line time available now; negative after a long request
        self._filled = self._loop.time()
        self._timer: asyncio.TimerHandle | None = None

    def ask(self, client: object, work: Callable[[float], Awaitable[Any]]) -> asyncio.Future[Any]:
        """Queue work, and return a future of its result; `work` is called with the seconds until its expiry.

        If the work is dropped, this call or the future raises PassingBusy. If the queue is full and another
        client has at least two more waiting requests, the last request of that client is dropped instead.
        """
        if len(self._waiting) >= MOST_WAITING:
            self._make_place(client)
        now = self._loop.time()
        asked = _WaitingAsk(client, work, self._loop.create_future(), now + EXPIRY_S)
        asked.timer = self._loop.call_at(asked.expires, self._expire, asked)
        asked.answer.add_done_callback(lambda _: self._forget(asked))
        self._waiting.append(asked)
        self._step()
        return asked.answer

    def _make_place(self, client: object) -> None:
        waiting = Counter(id(asked.client) for asked in self._waiting)
        greediest, most = waiting.most_common(1)[0]
        if most <= waiting[id(client)] + 1:
            raise PassingBusy(f"{len(self._waiting)} requests are waiting for this line already")
        last = next(asked for asked in reversed(self._waiting) if id(asked.client) == greediest)
        self._refuse(last, "other clients with fewer requests wait for this line")

    def _expire(self, asked: _WaitingAsk) -> None:
        if asked in self._waiting:
            self._refuse(asked, f"the line was not free for it within {EXPIRY_S:g} s")

    def _refuse(self, asked: _WaitingAsk, why: str) -> None:
        self._waiting.remove(asked)
        if not asked.answer.done():
            asked.answer.set_exception(PassingBusy(why))

    def _forget(self, asked: _WaitingAsk) -> None:
        """Remove a request that is answered, or whose client has disconnected, from the queue."""
        if asked.timer is not None:
            asked.timer.cancel()
        if asked in self._waiting:
            self._waiting.remove(asked)

    # ---- turns ----

    def _step(self) -> None:
        """Start the next request now, or as soon as line time is available."""
        if self._running is not None or not self._waiting:
            return
        now = self._loop.time()
        self._fill(now)
        if self._left_s <= 0:
            if self._timer is None:
                self._timer = self._loop.call_at(now - self._left_s / self.share + 1e-4, self._wake)
            return
        asked = self._waiting.pop(0)
        self._running = supervisor().start("passed request", self._run(asked))

    def _wake(self) -> None:
        self._timer = None
        self._step()

    def _fill(self, now: float) -> None:
        self._left_s = min(BURST_S, self._left_s + (now - self._filled) * self.share)
        self._filled = now

    async def _run(self, asked: _WaitingAsk) -> None:
        """Carry out a request to its end, even if its client disconnects, because the line stays in use."""
        begun = self._loop.time()
        try:
            result = await asked.work(asked.expires - begun)
            if not asked.answer.done():
                asked.answer.set_result(result)
        except asyncio.CancelledError:
            if not asked.answer.done():
                asked.answer.set_exception(PassingBusy(CLOSED))
            raise
        except Exception as failure:
            if not asked.answer.done():
                asked.answer.set_exception(failure)
        finally:
            ended = self._loop.time()
            self._fill(ended)
            self._left_s -= ended - begun
            self._running = None
            self._step()

    def close(self) -> None:
        """Drop all waiting requests, and cancel the current one."""
        for asked in list(self._waiting):
            self._refuse(asked, CLOSED)
        if self._timer is not None:
            self._timer.cancel()
        if self._running is not None:
            self._running.cancel()
