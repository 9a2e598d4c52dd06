"""What goes wrong on a polled line, as it shows in what is known of its port and its drives.

There are four kinds: the port is lost; a drive that has answered falls silent; what came in place of a
reply was none; a reply came after its time-out. That a drive refuses is none of them.
"""

from __future__ import annotations

from collections.abc import Iterator

from multidrop.bus import Bus
from multidrop.core import Status
from multidrop.drive.family import Drive

SILENT = 3  # exchanges in a row without a reply
_BAD = (
    Status.NO_START,
    Status.BAD_CHARACTER,
    Status.BAD_CHECKSUM,
    Status.BAD_ADDRESS,
    Status.BAD_FUNCTION,
    Status.BAD_LENGTH,
    Status.BAD_ECHO,
    Status.CUT_SHORT,
)


class Watch:
    """Watches one line."""

    def __init__(self, name: str, bus: Bus) -> None:
        self._name = name
        self._bus = bus
        self._drives = [_WatchedDrive(bus, drive) for drive in bus.drives]
        self._is_lost = False

    def look(self) -> Iterator[str]:
        """What went wrong since the last look, in words."""
        port = self._bus.line.queue
        was_lost, self._is_lost = self._is_lost, port is None or port.lost
        if self._is_lost and not was_lost:
            yield f"{self._name}: the port was lost"
        for drive in self._drives:
            for what in drive.look():
                yield f"{self._name}: {drive.name}: {what}"


class _WatchedDrive:
    def __init__(self, bus: Bus, drive: Drive) -> None:
        self.name = drive.name
        self._peer = bus.peer(drive)
        self._exchanges = self._late = 0
        self._is_silent = True
        self._bad: dict[Status, int] = {}

    def look(self) -> Iterator[str]:
        if self._peer.exchanges == self._exchanges:
            return
        counters = self._peer.counters()
        self._exchanges = counters.exchanges
        was_silent, self._is_silent = (
            self._is_silent,
            self._peer.failures >= SILENT or not counters.answered,
        )
        if self._is_silent and not was_silent:
            yield "fell silent"
        if counters.late > self._late:
            yield "late reply"
        bad = {why: counters.ended[why] for why in _BAD if why in counters.ended}
        for why, count in bad.items():
            if count > self._bad.get(why, 0):
                yield str(why)
        self._late, self._bad = counters.late, bad
