"""Reads in addition to polling: all registers of a viewed drive, and each drive's identity."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from functools import partial
from math import isfinite
from typing import Any

from multidrop import Bus, BusError, Drive, NoReply, Plant, WriteForbidden
from multidrop.supervisor import supervisor

PAUSE_S = 0.2  # least pause between two reads on a line, which leaves time for polling
SHARE = 20  # the pause is at least this many times the duration of the last read
LOOKED_S = 3.0  # a drive is read until this many seconds after its last view
MOST_DRIVES = 4  # limit of drives that are read concurrently
READ_S = 30.0  # time limit of one read

UNANSWERED = "no reply"

Found = dict[str, list[Any]]  # by register: value or None, time (UTC, ms), "ok" or the failure
ROUND_S = 2.0  # pause between two rounds of identity checks
ASKED_S = 30.0  # time limit of one identity check
REST_S = 0.1  # pause before each read of an identity check, which leaves time for polling
_log = logging.getLogger("multidrop.gateway")


class SideReads:
    """Reads all registers of viewed drives, one read at a time per line.

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
        self._turns: dict[str, asyncio.Lock] = {}  # by line: a lock that is held during a read
        self._clock = clock
        self._utc_ms = utc_ms
        self._looked: dict[str, float] = {}
        self._found: dict[str, Found] = {}
        self._tasks: dict[str, asyncio.Task[None]] = {}

    def look(self, plant: Plant, name: str) -> Found:
        """Return the values read so far, and read on for LOOKED_S. Raises ValueError for an unknown drive."""
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
        """Return True if this process has a bus for the line."""
        try:
            return self._bus(line) is not None
        except ValueError:
            return False

    @property
    def under_way(self) -> int:
        """The number of drives being read."""
        return len(self._tasks)

    def cancel(self) -> None:
        """Cancel all reads after a reload, because names may mean other drives now."""
        for task in self._tasks.values():
            task.cancel()
        self._tasks.clear()
        self._found.clear()

    async def close(self) -> None:
        """Cancel all reads, and wait for their end."""
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
                        registers.remove(register)  # not read again: each attempt would cost a timeout
        finally:
            if self._tasks.get(drive.name) is asyncio.current_task():
                del self._tasks[drive.name]
                self._found.pop(drive.name, None)  # values that are no longer updated must not be shown

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
    """Checks each drive's identity once while its port is open, so that the drive's first stop need not
    wait for the check.

    `fail` is called in the `except` block of an unexpected exception, so it can log the exception.
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
        self._refused: dict[str, str] = {}  # the refusal that was logged last, by drive

    async def run(self) -> None:
        """Check all drives in rounds, forever: a drive may answer again, and a port may be reopened."""
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
        except (BusError, ValueError):  # checked again in a later round, unless the drive was removed
            pass
