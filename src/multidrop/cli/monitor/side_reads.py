"""Reads what is not polled of one drive, one register after another, beside the polling."""

from __future__ import annotations

import threading
import time

from multidrop.cli.monitor.watched import Watched, told
from multidrop.errors import BusError
from multidrop.poller import Poller

SIDE_S = 0.1  # between two reads: the polling keeps nearly all of the line


class SideReader:
    """For as long as the drive is looked at."""

    def __init__(self, poller: Poller) -> None:
        self._poller = poller
        self._drive: Watched | None = None
        self._found: dict[str, str] = {}
        self._thread: threading.Thread | None = None

    def read(self, it: Watched) -> dict[str, str]:
        """What was found so far; goes on reading."""
        if self._drive is not it:
            self._drive, self._found = it, {}
        if self._thread is None or not self._thread.is_alive():
            self._thread = threading.Thread(target=self._go_on, args=(it, self._found), daemon=True)
            self._thread.start()
        return self._found

    def rest(self) -> None:
        self._drive = None

    def _go_on(self, it: Watched, found: dict[str, str]) -> None:
        drive = it.polled.drive
        polled = {poll.register.name for poll in it.polled.polls}
        others = [reg for name, reg in drive.registers.items() if reg.readable and name not in polled]
        bus = self._poller.bus(it.line.name)
        for register in others:
            if self._drive is not it:
                return
            try:
                found[register.name] = told(register, bus.read(drive, register))
            except BusError as failure:
                found[register.name] = type(failure).__name__
            time.sleep(SIDE_S)
