"""Anomalies on a polled line, found in the state of its port and the counters of its drives.

There are four kinds: the port is lost; a drive that has answered falls silent; a reply is damaged or
another drive's; a reply comes after its time-out. A refusal is no anomaly.
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


class AnomalyWatch:
    """Find the anomalies of one line."""

    def __init__(self, name: str, bus: Bus) -> None:
        self._name = name
        self._bus = bus
        self._drives = [_WatchedDrive(bus, drive) for drive in bus.drives]
        self._is_lost = False

    def check(self) -> Iterator[str]:
        """Yield a sentence for each anomaly since the last check."""
        port = self._bus.line.queue
        was_lost, self._is_lost = self._is_lost, port is None or port.lost
        if self._is_lost and not was_lost:
            yield f"{self._name}: the port was lost"
        for drive in self._drives:
            for anomaly in drive.check():
                yield f"{self._name}: {drive.name}: {anomaly}"


class _WatchedDrive:
    def __init__(self, bus: Bus, drive: Drive) -> None:
        self.name = drive.name
        self._peer = bus.peer(drive)
        self._exchanges = self._late = 0
        self._is_silent = True
        self._bad: dict[Status, int] = {}

    def check(self) -> Iterator[str]:
        if self._peer.exchanges == self._exchanges:
            return
        counters = self._peer.counters()
        self._exchanges = counters.exchanges
        was_silent = self._is_silent
        self._is_silent = self._peer.failures >= SILENT or not counters.answered
        if self._is_silent and not was_silent:
            yield "fell silent"
        if counters.late > self._late:
            yield "late reply"
        bad = {result: counters.ended[result] for result in _BAD if result in counters.ended}
        for result, count in bad.items():
            if count > self._bad.get(result, 0):
                yield str(result)
        self._late, self._bad = counters.late, bad
