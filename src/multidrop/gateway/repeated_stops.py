"""Repeated stops: of however many that are called of one drive, one is repeated at a time.

The stop of a drive that is silent is repeated for 30 s, and each time its line waits for the reply. Were all
that are called repeated, the stops of other drives would wait for them, and so would all that is read.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from functools import partial
from time import monotonic

from multidrop import Drive
from multidrop.gateway.command_threads import begin_stops
from multidrop.gateway.rights import Caller
from multidrop.gateway.told import Told, failed

REPEATED_S = 30.0  # that each is repeated, if not by itself, then by others
BEGINNING_S = 0.25  # in which a stop that was called need not be under way yet

Stops = dict[str, Told]  # what became of each, by drive
FutureStops = asyncio.Future[Stops]


class RepeatedStops:
    """The stops under way, by drive."""

    def __init__(self) -> None:
        self._repeated: dict[Drive, tuple[FutureStops, float]] = {}  # the newest, and when it was called
        self._sent: dict[Drive, FutureStops] = {}  # once each
        self._waiting: dict[Drive, FutureStops] = {}  # to be sent when the one before has its answer
        self._tasks: set[FutureStops] = set()

    def note(self, drives: Iterable[Drive], stops: FutureStops) -> None:
        """Note that a stop of these drives is under way, and repeated."""
        self._repeated = {drive: one for drive, one in self._repeated.items() if not one[0].done()}
        self._repeated |= dict.fromkeys(drives, (stops, monotonic()))

    def of(self, drive: Drive) -> FutureStops | None:
        """Return the stop of this drive that is repeated; None without one.

        One of a whole line may be over for this drive, and repeated for others alone.
        """
        stops, called = self._repeated.get(drive, (None, 0.0))
        if stops is None or stops.done():
            return None
        bus = drive.bus
        goes_on = bus is not None and drive.name in bus.stops_under_way()
        return stops if goes_on or monotonic() - called < BEGINNING_S else None

    def send_once(self, drive: Drive, caller: Caller) -> FutureStops:
        """Send a stop once more, and return what becomes of the one that is repeated.

        Should that one be given up before this one's time is over, another one is repeated in its place.
        """
        task = asyncio.ensure_future(self._send_and_await(drive, caller))
        self._tasks.add(task)  # it goes on, though its caller may be gone
        task.add_done_callback(self._tasks.discard)
        return asyncio.shield(task)

    async def _send_and_await(self, drive: Drive, caller: Caller) -> Stops:
        ends = monotonic() + REPEATED_S
        told = (await asyncio.shield(self._soon(drive, caller)))[drive.name]
        if (repeated := self.of(drive)) is not None:
            told = (await asyncio.shield(repeated))[drive.name]
        if not told.is_done and monotonic() < ends:
            if (repeated := self.of(drive)) is None:
                (repeated,) = begin_stops([partial(stop_one, drive)], caller)
                self.note([drive], repeated)
            told = (await asyncio.shield(repeated))[drive.name]
        return {drive.name: told}

    def _soon(self, drive: Drive, caller: Caller) -> FutureStops:
        """Send it now, or when the one before has its answer, with all that wait for that."""
        if drive not in self._sent:
            return self._send(drive, caller)
        if drive not in self._waiting:
            self._waiting[drive] = asyncio.ensure_future(self._send_after(self._sent[drive], drive, caller))
        return self._waiting[drive]

    def _send(self, drive: Drive, caller: Caller) -> FutureStops:
        (sent,) = begin_stops([lambda seconds: stop_one(drive, 0.0)], caller)
        self._sent[drive] = sent
        sent.add_done_callback(partial(self._forget, drive))
        return sent

    async def _send_after(self, before: FutureStops, drive: Drive, caller: Caller) -> Stops:
        await asyncio.wait([before])
        del self._waiting[drive]  # who calls from now on is sent after this one
        return await self._send(drive, caller)

    def _forget(self, drive: Drive, sent: FutureStops) -> None:
        if self._sent.get(drive) is sent:
            del self._sent[drive]


def stop_one(drive: Drive, seconds: float | None) -> Stops:
    """Stop a drive; return what became of it, whatever that is."""
    try:
        drive.stop(seconds=seconds)
    except Exception as failure:  # whatever it is: everybody must see it
        return {drive.name: failed(failure)}
    return {drive.name: Told(True, "stopped: seen to stand")}
