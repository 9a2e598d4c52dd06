"""LineMeter: what a line and its drives did since it was opened, or since a reset."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import count
from typing import NamedTuple

from multidrop.core import Peer
from multidrop.transport import clock
from multidrop.transport.exchange import Exchanges
from multidrop.transport.statistics import LineStatistics, line_statistics

LOOKS = 3  # at counters that must be of one moment
_EPOCHS = count(1)


class Count(NamedTuple):
    """Statistics since a line was opened, and the peers by the names that their drives had."""

    statistics: LineStatistics
    peers: Mapping[str, Peer]


class LineMeter:
    """Statistics of a line since it was opened, or last reset; frozen when it is closed.

    A name may be another drive's by now: what a drive had counted at the reset is kept by its peer.
    """

    def __init__(self, exchanges: Exchanges) -> None:
        self._exchanges = exchanges
        self._opened_ns = clock.now_ns()
        self._frozen: Count | None = None
        self._reset_at = _begins(Count(line_statistics(0.0, {}, exchanges.line.overruns(), 0.0), {}))

    def read(self) -> LineStatistics:
        now, reset_at = self._now(), self._reset_at
        names = {peer: name for name, peer in reset_at.peers.items()}
        before = {
            name: reset_at.statistics.drives[names[peer]] for name, peer in now.peers.items() if peer in names
        }
        earlier = replace(reset_at.statistics, drives=before, epoch=now.statistics.epoch)
        return replace(now.statistics.since(earlier), epoch=reset_at.statistics.epoch)

    def reset(self) -> None:
        self._reset_at = _begins(self._now())

    def freeze(self, overruns: int | None) -> None:
        """Count nothing more: the line is closed, and had lost `overruns` characters until then."""
        self._frozen = self._frozen or self._count(overruns)

    def _now(self) -> Count:
        return self._frozen or self._count(self._exchanges.line.overruns())

    def _count(self, overruns: int | None) -> Count:
        peers = {drive.name: peer for drive, peer in self._exchanges.peers.items()}
        for _ in range(LOOKS):
            counters_by_drive = {name: peer.counters() for name, peer in peers.items()}
            now_ns = clock.now_ns()
            counted_ns = self._exchanges.line.counted_ns(now_ns)
            counted = sum(counters.exchanges for counters in counters_by_drive.values())
            if counted == sum(peer.exchanges for peer in peers.values()):  # none ended meanwhile
                break
        seconds, counted_s = ((at_ns - self._opened_ns) / 1e9 for at_ns in (now_ns, counted_ns))
        epochs = {name: peer.number for name, peer in peers.items()}
        return Count(line_statistics(seconds, counters_by_drive, overruns, counted_s, epochs), peers)


def _begins(reading: Count) -> Count:
    """Return a reading as the beginning of an epoch of its own."""
    return reading._replace(statistics=replace(reading.statistics, epoch=next(_EPOCHS)))
