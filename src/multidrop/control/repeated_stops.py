"""Repeated stops: of however many that are called of one drive, one is repeated at a time.

The stop of a drive that is silent is repeated for 30 s, and each time its line waits for the reply. Were all
that are called repeated, the stops of other drives would wait for them, and so would all that is read. So a
server that many may call stops by this.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable
from functools import partial
from typing import Generic, Protocol, TypeVar

from multidrop.drive.family import Drive

REPEATED_S = 30.0  # that each is repeated, if not by itself, then by others
BEGINNING_S = 0.25  # in which a stop that was called need not be under way yet


class EndedStop(Protocol):
    """The end of one drive's stop."""

    @property
    def is_done(self) -> bool:
        """True where the motor was seen to stand."""


E = TypeVar("E", bound=EndedStop)

StopWork = Callable[[float | None], dict[str, E]]
"""Stops drives, and returns what became of each; takes for how many s it is repeated, None: as usual."""

EndedStops = asyncio.Future[dict[str, E]]

BeginStop = Callable[[StopWork[E]], EndedStops[E]]
"""Begins such work on a thread of its own, for one caller."""


class RepeatedStops(Generic[E]):
    """The stops under way of a server's drives, in its loop; `stop` stops one, as a StopWork does."""

    def __init__(self, stop: Callable[[Drive, float | None], dict[str, E]]) -> None:
        self._stop = stop
        # The newest, and when it was called.
        self._repeated: dict[Drive, tuple[EndedStops[E], float]] = {}
        self._sent: dict[Drive, EndedStops[E]] = {}  # once each
        self._waiting: dict[Drive, EndedStops[E]] = {}  # until the one before has its answer
        self._tasks: set[EndedStops[E]] = set()

    def note(self, drives: Iterable[Drive], stops: EndedStops[E]) -> None:
        """Note that a stop of these drives is under way, and repeated."""
        self._repeated = {drive: one for drive, one in self._repeated.items() if not one[0].done()}
        self._repeated |= dict.fromkeys(drives, (stops, _now()))

    def of(self, drive: Drive) -> EndedStops[E] | None:
        """Return the stop of this drive that is repeated; None without one.

        One of a whole line may be over for this drive, and repeated for others alone.
        """
        stops, called = self._repeated.get(drive, (None, 0.0))
        if stops is None or stops.done():
            return None
        bus = drive.bus
        goes_on = bus is not None and drive.name in bus.stops_under_way()
        return stops if goes_on or _now() - called < BEGINNING_S else None

    def divided(self, drives: Iterable[Drive]) -> tuple[list[Drive], list[Drive]]:
        """Return those whose stop is to be begun, and noted, and those whose stop is to be sent once more."""
        drives = [*drives]
        again = [drive for drive in drives if self.of(drive) is not None]
        return [drive for drive in drives if drive not in again], again

    def send_once(self, drive: Drive, begin: BeginStop[E]) -> EndedStops[E]:
        """Send a stop once more, and return what becomes of the one that is repeated.

        Should that one be given up before this one's time is over, another one is repeated in its place.
        """
        task = asyncio.ensure_future(self._send_and_await(drive, begin))
        self._tasks.add(task)  # it goes on, though its caller may be gone
        task.add_done_callback(self._tasks.discard)
        return asyncio.shield(task)

    async def _send_and_await(self, drive: Drive, begin: BeginStop[E]) -> dict[str, E]:
        ends = _now() + REPEATED_S
        told = (await asyncio.shield(self._soon(drive, begin)))[drive.name]
        if (repeated := self.of(drive)) is not None:
            told = (await asyncio.shield(repeated))[drive.name]
        if not told.is_done and _now() < ends:
            if (repeated := self.of(drive)) is None:
                repeated = begin(partial(self._stop, drive))
                self.note([drive], repeated)
            told = (await asyncio.shield(repeated))[drive.name]
        return {drive.name: told}

    def _soon(self, drive: Drive, begin: BeginStop[E]) -> EndedStops[E]:
        """Send it now, or when the one before has its answer, with all that wait for that."""
        if drive not in self._sent:
            return self._send(drive, begin)
        if drive not in self._waiting:
            self._waiting[drive] = asyncio.ensure_future(self._send_after(self._sent[drive], drive, begin))
        return self._waiting[drive]

    def _send(self, drive: Drive, begin: BeginStop[E]) -> EndedStops[E]:
        sent = begin(lambda seconds: self._stop(drive, 0.0))
        self._sent[drive] = sent
        sent.add_done_callback(partial(self._forget, drive))
        return sent

    async def _send_after(self, before: EndedStops[E], drive: Drive, begin: BeginStop[E]) -> dict[str, E]:
        await asyncio.wait([before])
        del self._waiting[drive]  # who calls from now on is sent after this one
        return await self._send(drive, begin)

    def _forget(self, drive: Drive, sent: EndedStops[E]) -> None:
        if self._sent.get(drive) is sent:
            del self._sent[drive]


def _now() -> float:
    return asyncio.get_running_loop().time()
