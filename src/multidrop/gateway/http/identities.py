"""Identities: each drive is asked what it is beforehand, so that its first stop is sent at once."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from functools import partial

from multidrop import Bus, BusError, Drive, Plant, WriteForbidden
from multidrop.supervisor import supervisor

PAUSE_S = 0.2  # between two drives that are asked: the polling keeps the line
ROUND_S = 2.0  # between two looks for drives that are not known
ASKED_S = 30.0  # that the answers of one drive may take

_log = logging.getLogger("multidrop.gateway")


class Identities:
    """Asks the drives of the present plant one by one, each once while its port is open.

    `fail` is called while any other exception is handled.
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
        self._refused: dict[str, str] = {}  # by drive, as it was logged

    async def run(self) -> None:
        """Ask again and again: a drive may answer again, and a port may be opened again."""
        while True:
            drives = [(line.name, polled.drive) for line in self._plant().lines for polled in line.drives]
            for line, drive in drives:
                try:
                    if self._is_there(drive.name) and not self._knows(line, drive):
                        await supervisor().within("identities", ASKED_S, partial(self._ask, line, drive))
                        await asyncio.sleep(PAUSE_S)
                except Exception:  # whatever it is, polling and stops go on
                    self._fail()
            await asyncio.sleep(ROUND_S)

    def _knows(self, line: str, drive: Drive) -> bool:
        """Return True if a drive need not be asked, or has been removed."""
        try:
            return self._bus(line).knows_identity(drive)
        except ValueError:
            return True

    def _ask(self, line: str, drive: Drive) -> None:
        try:
            self._bus(line).check_identity(drive)
        except WriteForbidden as refusal:
            if self._refused.get(drive.name) != str(refusal):
                _log.warning("%s", refusal)
            self._refused[drive.name] = str(refusal)
        except (BusError, ValueError):  # it will be asked again, or it is no longer there
            pass
