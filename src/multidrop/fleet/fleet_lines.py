"""Fleet lines: those that a gateway has taken, in one Poller that sends only while it is their master."""

from __future__ import annotations

import asyncio
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from multidrop import Bus, Mastership, Plant, Poller
from multidrop.fleet.buckets import Record
from multidrop.fleet.plant_store import line_of
from multidrop.fleet.polled_units import PolledUnits

THREADS = 32


class FleetLines:
    """Takes lines into a poller and lets them go; both in threads, for both wait for ports."""

    def __init__(self, mastership: Mastership, folder: Path, units: PolledUnits) -> None:
        self.poller = Poller(Plant((), folder), mastership=mastership, audit=folder / "audit.jsonl")
        self._folder = folder / "lines"
        self._units = units
        self._threads = ThreadPoolExecutor(THREADS, "multidrop line")

    async def take(self, line: str, description: Any) -> None:
        """Open the line and poll it.

        Raises LineError where its port is not there, ValueError for a mistake in its description.
        """
        loop = asyncio.get_running_loop()
        await loop.run_in_executor(self._threads, self._take, Record(line, 0, description))

    def _take(self, record: Record) -> None:
        line = line_of(record, self._folder)
        polled = {drive.name for bus in self.poller.buses.values() for drive in bus.drives}
        if not any(one.drive.name in polled for one in line.drives):  # else `add_line` refuses it
            self._units.note(line, time.monotonic_ns())  # before the first of its rows
        self.poller.add_line(line)

    async def let_go(self, line: str) -> None:
        """Poll the line no more, and close its port."""
        loop = asyncio.get_running_loop()
        await loop.run_in_executor(self._threads, self.poller.remove_line, line)

    def bus(self, line: str) -> Bus:
        return self.poller.bus(line)

    async def close(self) -> None:
        """Stop polling; the last rows are handed out."""
        await asyncio.get_running_loop().run_in_executor(self._threads, self.poller.close)
        self._threads.shutdown(wait=False)
