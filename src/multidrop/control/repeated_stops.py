"""RepeatedStops: repeat one stop of a drive at a time, however many clients of a server call one.

The stop of a silent drive is repeated for 30 s, and each time its line waits for the reply. If every call
were repeated, they would delay the stops of other drives, and all reads.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import NamedTuple

from multidrop.control.commands import Results, StopWork, begin_stops, stop_drive
from multidrop.drive.family import Drive

REPEATED_S = 30.0  # that each call is repeated, by its own stop or by others
BEGINNING_S = 0.25  # within which a called stop may not be under way yet

StopFuture = asyncio.Future[Results]


class LineStop(NamedTuple):
    """Drives of one line to stop; `whole` stops all of its drives, None if these are not all."""

    drives: Sequence[Drive]
    whole: StopWork | None = None


class RepeatedStops:
    """The stops under way of a server's drives, in its loop; `stop` stops one drive."""

    def __init__(
        self,
        stop: Callable[[Drive, float | None], Results] = stop_drive,
        begin: Callable[[Sequence[StopWork]], list[StopFuture]] = begin_stops,
    ) -> None:
        self._stop = stop
        self._begin = begin
        self._repeated: dict[Drive, tuple[StopFuture, float]] = {}  # the newest, and when it was called
        self._sent: dict[Drive, StopFuture] = {}  # sent once
        self._waiting: dict[Drive, StopFuture] = {}  # until the one before has its answer
        self._tasks: set[StopFuture] = set()

    def begin(self, lines: Iterable[LineStop]) -> list[StopFuture]:
        """Stop these drives side by side; of a drive whose stop is already repeated, send one more."""
        works: list[StopWork] = []
        stopped: list[list[Drive]] = []
        once: list[Drive] = []
        for line in lines:
            new, others = self.divided(line.drives)
            once += others
            if line.whole is not None and new and not others:
                works.append(line.whole)
                stopped.append(new)
            else:
                works += [partial(self._stop, drive) for drive in new]
                stopped += [[drive] for drive in new]
        begun = self._begin(works)
        for future, drives in zip(begun, stopped, strict=True):
            self.note(drives, future)
        return [*begun, *(self.send_once(drive) for drive in once)]

    def note(self, drives: Iterable[Drive], stops: StopFuture) -> None:
        """Note that a repeated stop of these drives is under way."""
        self._repeated = {drive: one for drive, one in self._repeated.items() if not one[0].done()}
        self._repeated |= dict.fromkeys(drives, (stops, _now()))

    def of(self, drive: Drive) -> StopFuture | None:
        """Return the repeated stop of this drive, if one is under way.

        A whole line's stop may be over for this drive, and go on for others alone.
        """
        stops, called = self._repeated.get(drive, (None, 0.0))
        if stops is None or stops.done():
            return None
        bus = drive.bus
        goes_on = bus is not None and drive.name in bus.stops_under_way()
        return stops if goes_on or _now() - called < BEGINNING_S else None

    def divided(self, drives: Iterable[Drive]) -> tuple[list[Drive], list[Drive]]:
        """Return the drives whose stop must be started, and those whose stop is sent once more."""
        drives = [*drives]
        again = [drive for drive in drives if self.of(drive) is not None]
        return [drive for drive in drives if drive not in again], again

    def send_once(self, drive: Drive) -> StopFuture:
        """Send a stop once more, and return the result of the repeated one.

        If that one is given up before this call's time is over, another one is repeated in its place.
        """
        task = asyncio.ensure_future(self._send_and_await(drive))
        self._tasks.add(task)  # it goes on if its caller is cancelled
        task.add_done_callback(self._tasks.discard)
        return asyncio.shield(task)

    async def _send_and_await(self, drive: Drive) -> Results:
        ends = _now() + REPEATED_S
        result = (await asyncio.shield(self._soon(drive)))[drive.name]
        if (repeated := self.of(drive)) is not None:
            result = (await asyncio.shield(repeated))[drive.name]
        if not result.is_done and _now() < ends:
            if (repeated := self.of(drive)) is None:
                (repeated,) = self._begin([partial(self._stop, drive)])
                self.note([drive], repeated)
            result = (await asyncio.shield(repeated))[drive.name]
        return {drive.name: result}

    def _soon(self, drive: Drive) -> StopFuture:
        """Send it now; or once the frame before it is answered, together with all that wait for that."""
        if drive not in self._sent:
            return self._send(drive)
        if drive not in self._waiting:
            self._waiting[drive] = asyncio.ensure_future(self._send_after(self._sent[drive], drive))
        return self._waiting[drive]

    def _send(self, drive: Drive) -> StopFuture:
        (sent,) = self._begin([lambda seconds: self._stop(drive, 0.0)])
        self._sent[drive] = sent
        sent.add_done_callback(partial(self._forget, drive))
        return sent

    async def _send_after(self, before: StopFuture, drive: Drive) -> Results:
        await asyncio.wait([before])
        del self._waiting[drive]  # later callers are sent after this one
        return await self._send(drive)

    def _forget(self, drive: Drive, sent: StopFuture) -> None:
        if self._sent.get(drive) is sent:
            del self._sent[drive]


def _now() -> float:
    return asyncio.get_running_loop().time()
