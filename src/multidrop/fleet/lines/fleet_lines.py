"""FleetLines: the lines that a gateway polls, in one Poller that sends only while the lease is valid."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from functools import partial
from math import inf
from pathlib import Path
from typing import Any

from multidrop import Plant, Poller, PollingFailed
from multidrop.core import Mastership
from multidrop.fleet.lines.line_keeper import PortLoss
from multidrop.fleet.servers.buckets import Record
from multidrop.fleet.servers.plant_store import line_of
from multidrop.samples import PolledUnits
from multidrop.supervisor import supervisor

THREADS = 32  # limit of lines that are opened or closed at the same time


class FleetLines:
    """Adds lines to a poller and removes them, in threads, because both wait for ports."""

    def __init__(self, mastership: Mastership, folder: Path, units: PolledUnits) -> None:
        self.poller = Poller(
            Plant((), folder, totals=folder / "totals.json"),
            mastership=mastership,
            audit=folder / "audit.jsonl",
        )
        self._folder = folder / "lines"
        self._units = units
        self._free = asyncio.Semaphore(THREADS)

    async def take(self, line: str, description: Any) -> None:
        """Open the line and poll it. If that raises, the line is not polled and its port is closed.

        Raises LineError if its port does not exist, and ValueError for a mistake in its description. A user's
        own class may raise other errors.
        """
        await self._in_thread(self._take, Record(line, 0, description))

    async def _in_thread(self, act: Callable[..., object], *details: object) -> None:
        """Call `act` in a daemon thread. SystemExit, which would end the loop, becomes RuntimeError."""
        async with self._free:
            await supervisor().thread("line", inf, partial(act, *details))

    def _take(self, record: Record) -> None:
        line = line_of(record, self._folder)
        polled = {drive.name for bus in self.poller.buses.values() for drive in bus.drives}
        # a line without polled drives would be refused by `add_line`
        if not any(one.drive.name in polled for one in line.drives):
            self._units.note(line, time.monotonic_ns())  # must precede the line's first row
        before = self.poller.buses.get(line.name)
        try:
            self.poller.add_line(line)
        except BaseException:  # a half-open line must be closed: another gateway may soon be its master
            if self.poller.buses.get(line.name) is not before:
                self.poller.remove_line(line.name)
            raise

    async def let_go(self, line: str) -> None:
        """Stop polling the line, and close its port."""
        await self._in_thread(self._let_go, line)

    def _let_go(self, line: str) -> None:
        try:
            self.poller.remove_line(line)
        except PollingFailed:  # polling of all lines has ended; closing the port is enough
            self.poller.bus(line).close()

    def port_loss(self, line: str) -> PortLoss | None:
        """Return how the port of a polled line was lost; None if it is open."""
        bus = self.poller.bus(line)
        if not bus.line.is_lost:
            return None
        replied_ns = max((bus.peer(drive).answered_ns for drive in bus.drives), default=0)
        silent_ns = time.monotonic_ns() - replied_ns if replied_ns else None
        return PortLoss(bus.why_lost, silent_ns)

    async def close(self) -> None:
        """Stop polling and deliver the last rows. Raises PollingFailed if polling had failed."""
        await self._in_thread(self.poller.close)
