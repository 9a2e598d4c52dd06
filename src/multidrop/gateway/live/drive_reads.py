"""Reads in addition to polling: identities, and registers and parameters of drives that a user views."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from math import isfinite
from typing import Any

from multidrop import Bus, BusError, Drive, NoReply, Plant, WriteForbidden, params
from multidrop.supervisor import Hung, supervisor

PAUSE_S = 0.2  # shortest pause, in s, between two reads on a line, which leaves time for polling
SHARE = 20  # the pause after a read is at least this many times the duration of the read
LOOKED_S = 3.0  # a drive is read until this many seconds after a page last requested its values
MOST_DRIVES = 4  # limit of drives whose registers are read concurrently
READ_S = 30.0  # time limit, in s, of reading one register
UNANSWERED = "no reply"

ROUND_S = 2.0  # pause, in s, between two rounds in which all unknown identities are checked
ASKED_S = 30.0  # time limit, in s, of one identity check
REST_S = 0.1  # pause before each read of an identity check, which leaves time for polling

MOST_READS = 2  # limit of drives whose parameters are read concurrently
PARAMETERS_S = 3600.0  # time limit, in s, of reading all parameters of a drive
PARAMETER_SHARE = 3  # the pause after a block of parameters is this many times the duration of its read
MOST_PAUSE_S = 1.0  # limit of that pause, in s

# by register: a value or None, the time of its read (UTC, ms), and "ok" or the reason of the failure
ReadValues = dict[str, list[Any]]
_log = logging.getLogger("multidrop.gateway")


class SideReads:
    """Reads registers that are not polled, for the web page of a drive. Each line has one read at a time.

    `is_there` returns whether a drive answers.
    """

    def __init__(
        self,
        bus: Callable[[str], Bus],
        is_there: Callable[[str], bool],
        clock: Callable[[], float],
        utc_ms: Callable[[], int],
    ) -> None:
        self._bus = bus
        self._is_there = is_there
        # locks that make the reads on one line wait for each other, by line
        self._turns: dict[str, asyncio.Lock] = {}
        self._clock = clock
        self._utc_ms = utc_ms
        self._looked: dict[str, float] = {}
        self._found: dict[str, ReadValues] = {}
        self._tasks: dict[str, asyncio.Task[None]] = {}

    def look(self, plant: Plant, name: str) -> ReadValues:
        """Return the values read so far, and continue reading in the background for LOOKED_S seconds.

        Raises ValueError for an unknown drive.
        """
        line, drive = plant.find_drive(name)
        self._looked[name] = self._clock()
        found = self._found.setdefault(name, {})
        if name not in self._tasks and len(self._tasks) < MOST_DRIVES and self._can_read(line.name):
            polled = next(one for one in line.drives if one.drive is drive)
            others = set(drive.registers) - {poll.register.name for poll in polled.polls}
            names = [one for one in drive.registers if one in others and drive.registers[one].readable]
            self._tasks[name] = supervisor().start("side reads", self._read(line.name, drive, names))
        return found

    def _can_read(self, line: str) -> bool:
        """Return True if the gateway has a bus for this line."""
        try:
            return self._bus(line) is not None
        except ValueError:
            return False

    @property
    def under_way(self) -> int:
        return len(self._tasks)

    def cancel(self) -> None:
        """Cancel all reads. Called after a reload, because a drive's name may mean another drive now."""
        for task in self._tasks.values():
            task.cancel()
        self._tasks.clear()
        self._found.clear()

    async def close(self) -> None:
        tasks = [*self._tasks.values()]
        self.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _read(self, line: str, drive: Drive, registers: list[str]) -> None:
        turn = self._turns.setdefault(line, asyncio.Lock())
        found = self._found[drive.name]
        try:
            while registers:
                for register in [*registers]:
                    if self._clock() - self._looked[drive.name] > LOOKED_S:
                        return
                    async with turn:
                        await self._read_in_turn(line, drive, register)
                    if found.get(register, ["", 0, ""])[2].startswith(UNANSWERED):
                        # a register without a reply is not read again, because each attempt costs a timeout
                        registers.remove(register)
        finally:
            if self._tasks.get(drive.name) is asyncio.current_task():
                del self._tasks[drive.name]
                self._found.pop(drive.name, None)  # pages must not get values that are no longer updated

    async def _read_in_turn(self, line: str, drive: Drive, register: str) -> None:
        begun = self._clock()
        if self._is_there(drive.name):
            reading = partial(self._read_one, drive, register)
            self._found[drive.name][register] = await supervisor().within("side reads", READ_S, reading)
        await asyncio.sleep(max(PAUSE_S, SHARE * (self._clock() - begun)))

    def _read_one(self, drive: Drive, register: str) -> list[Any]:
        try:
            value = drive.read(drive.registers[register])
        except NoReply:
            return [None, self._utc_ms(), UNANSWERED]
        except (BusError, ValueError) as failure:
            return [None, self._utc_ms(), str(failure)]
        return [float(value) if isfinite(value) else None, self._utc_ms(), "ok"]


class Identities:
    """Checks each drive's identity in advance, so that its first stop need not wait for the check.

    `fail` is called in the `except` block of an unexpected exception, so that it can log the exception.
    """

    def __init__(
        self,
        plant: Callable[[], Plant],
        bus: Callable[[str], Bus],
        is_there: Callable[[str], bool],
        fail: Callable[[], object],
    ) -> None:
        self._plant = plant
        self._bus = bus
        self._is_there = is_there
        self._fail = fail
        self._refused: dict[str, str] = {}  # reason of the failed check that was logged last, by drive

    async def run(self) -> None:
        """Check the identities of all drives again and again, because a silent drive may answer later."""
        while True:
            drives = [(line.name, polled.drive) for line in self._plant().lines for polled in line.drives]
            for line, drive in drives:
                try:
                    if self._is_there(drive.name) and not self._knows(line, drive):
                        await supervisor().within("identities", ASKED_S, partial(self._ask, line, drive))
                        await asyncio.sleep(PAUSE_S)
                except Exception:  # polling and stops continue after any failure
                    self._fail()
            await asyncio.sleep(ROUND_S)

    def _knows(self, line: str, drive: Drive) -> bool:
        """Return True if the identity is known or the drive was removed."""
        try:
            return self._bus(line).knows_identity(drive)
        except ValueError:
            return True

    def _ask(self, line: str, drive: Drive) -> None:
        try:
            self._bus(line).check_identity(drive, rest_s=REST_S)
        except WriteForbidden as refusal:
            if self._refused.get(drive.name) != str(refusal):
                _log.warning("%s", refusal)
            self._refused[drive.name] = str(refusal)
        except (BusError, ValueError):  # retried in a later round, unless the drive was removed
            pass


# ---- reads of all parameters of a drive; no parameter is written ----


@dataclass
class ParameterRead:
    """One read of all parameters of a drive: its progress, and its result or error."""

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
    """The newest ParameterRead of each drive. It is kept until the drive's next one, or until a reload."""

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
        tasks = [read.task for read in self._reads.values() if read.task is not None]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _read(self, read: ParameterRead) -> None:
        work = partial(params.read, read.drive, progress=_Paced(read))
        try:
            read.found = await supervisor().within("parameter reads", PARAMETERS_S, work, most=MOST_READS)
        except (Hung, OSError, ValueError, BusError) as failure:
            read.error = str(failure)


class _Paced:
    """Progress callback of a parameter read: counts the parameters, and pauses after each block."""

    def __init__(self, read: ParameterRead) -> None:
        self._read = read
        self._at = time.monotonic()

    def __call__(self, done: int, total: int) -> None:
        self._read.done, self._read.total = done, total
        time.sleep(min(MOST_PAUSE_S, PARAMETER_SHARE * (time.monotonic() - self._at)))
        self._at = time.monotonic()
