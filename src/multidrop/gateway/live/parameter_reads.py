"""Reads of all parameters of single drives, for the page and its export. No parameter is written."""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass
from functools import partial
from typing import Any

from multidrop import BusError, Drive, Plant, params
from multidrop.supervisor import Hung, supervisor

MOST_READS = 2  # limit of drives whose parameters are read concurrently
READ_S = 3600.0  # time limit of one read
MOST_PAUSE_S = 1.0
SHARE = 3  # pause after a block, which leaves time for polling: this many times the block's duration


@dataclass
class ParameterRead:
    """One read of a drive's parameters: its progress, its result, or its error."""

    drive: Drive
    done: int = 0
    total: int = 0
    found: params.ParameterSet | None = None
    error: str = ""
    task: asyncio.Task[None] | None = None

    def as_json(self) -> dict[str, Any]:
        if self.error:
            return {"state": "failed", "error": self.error}
        if self.found is None:
            return {"state": "reading", "done": self.done, "total": self.total}
        rows = params.rows(type(self.drive), self.found)
        return {"state": "read", "saved": self.found.saved, "parameters": rows}


class ParameterReads:
    """The newest ParameterRead of each drive, kept until the drive's next one or a reload."""

    def __init__(self) -> None:
        self._reads: dict[str, ParameterRead] = {}

    def of(self, plant: Plant, name: str) -> ParameterRead | None:
        """Return the newest read of this drive, or None. Raises ValueError for an unknown drive."""
        drive = plant.find_drive(name)[1]
        read = self._reads.get(name)
        return read if read is not None and read.drive is drive else None

    def begin(self, plant: Plant, name: str) -> ParameterRead:
        """Start a read of this drive, unless one is in progress. Raises ValueError for an unknown drive."""
        read = self.of(plant, name)
        if read is not None and read.task is not None and not read.task.done():
            return read
        read = self._reads[name] = ParameterRead(plant.find_drive(name)[1])
        if read.drive.bus is None:
            read.error = "parameters are read only by the gateway that polls the drive"
            return read
        read.task = supervisor().start("parameter reads", self._read(read))
        return read

    async def close(self) -> None:
        """Cancel all reads, and wait for their end."""
        tasks = [read.task for read in self._reads.values() if read.task is not None]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _read(self, read: ParameterRead) -> None:
        work = partial(params.read, read.drive, progress=_Paced(read))
        try:
            read.found = await supervisor().within("parameter reads", READ_S, work, most=MOST_READS)
        except (Hung, OSError, ValueError, BusError) as failure:
            read.error = str(failure)


class _Paced:
    """Progress callback: counts the parameters that were read, and pauses after each block."""

    def __init__(self, read: ParameterRead) -> None:
        self._read = read
        self._at = time.monotonic()

    def __call__(self, done: int, total: int) -> None:
        self._read.done, self._read.total = done, total
        time.sleep(min(MOST_PAUSE_S, SHARE * (time.monotonic() - self._at)))
        self._at = time.monotonic()
