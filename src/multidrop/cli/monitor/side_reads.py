"""Side reads: registers of one drive that are not polled, read between the polls."""

from __future__ import annotations

import threading
import time

from multidrop.cli.support.live_plant import LiveDrive
from multidrop.cli.support.values import value_text
from multidrop.errors import BusError
from multidrop.poller import Poller

SIDE_S = 0.1  # between two reads: the polling keeps nearly all of the line


class SideReader:
    """Reads one drive's other registers, one after another, in a thread of its own."""

    def __init__(self, poller: Poller) -> None:
        self._poller = poller
        self._drive: LiveDrive | None = None
        self._found: dict[str, str] = {}
        self._thread: threading.Thread | None = None

    def read(self, drive: LiveDrive) -> dict[str, str]:
        """Return the values found so far, as text by register; go on reading."""
        if self._drive is not drive:
            self._drive, self._found = drive, {}
        if self._thread is None or not self._thread.is_alive():
            self._thread = threading.Thread(target=self._read_all, args=(drive, self._found), daemon=True)
            self._thread.start()
        return self._found

    def rest(self) -> None:
        """Read no further."""
        self._drive = None

    def _read_all(self, chosen: LiveDrive, found: dict[str, str]) -> None:
        drive = chosen.polled.drive
        polled = {poll.register.name for poll in chosen.polled.polls}
        bus = self._poller.bus(chosen.line.name)
        for name, register in drive.registers.items():
            if not register.readable or name in polled:
                continue
            if self._drive is not chosen:
                return
            try:
                found[name] = value_text(register, bus.read(drive, register))
            except BusError as failure:
                found[name] = type(failure).__name__
            time.sleep(SIDE_S)
