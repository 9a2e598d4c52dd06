"""Side reads: registers of one drive that are not polled, read between the polls."""

from __future__ import annotations

import re
import threading
import time
from typing import NamedTuple

from multidrop.cli.support.live_plant import LiveDrive
from multidrop.cli.support.values import value_text
from multidrop.errors import BusError
from multidrop.poller import Poller

LEAST_PAUSE_S = 0.1  # between two reads
MOST_SHARE, LEAST_SHARE = 0.05, 0.01  # of a line's time: with spare time, and on a full line


class SideRead(NamedTuple):
    """One read of a register: its value as text, or why there is none."""

    text: str
    time: int  # UTC, ns: the read was over


class SideReader:
    """Reads one drive's other registers, one after another, in a thread of its own.

    The reads use the time that the polls leave, at most MOST_SHARE of it; on a full line LEAST_SHARE.
    """

    def __init__(self, poller: Poller) -> None:
        self._poller = poller
        self._drive: LiveDrive | None = None
        self._found: dict[str, SideRead] = {}
        self._thread: threading.Thread | None = None

    def read(self, drive: LiveDrive) -> dict[str, SideRead]:
        """Return what was found so far, by register; go on reading."""
        if self._drive is not drive:
            self._drive, self._found = drive, {}
        if self._thread is None or not self._thread.is_alive():
            self._thread = threading.Thread(target=self._read_all, args=(drive, self._found), daemon=True)
            self._thread.start()
        return self._found

    def rest(self) -> None:
        """Read no further."""
        self._drive = None

    def _read_all(self, chosen: LiveDrive, found: dict[str, SideRead]) -> None:
        drive = chosen.polled.drive
        polled = {poll.register.name for poll in chosen.polled.polls}
        bus = self._poller.bus(chosen.line.name)
        for name, register in drive.registers.items():
            if not register.readable or name in polled:
                continue
            if self._drive is not chosen:
                return
            asked = time.monotonic()
            try:
                text = value_text(register, bus.read(drive, register))
            except BusError as failure:
                text = _in_words(failure)
            found[name] = SideRead(text, time.time_ns())
            time.sleep(pause_s(time.monotonic() - asked, chosen.line_utilisation))


def pause_s(read_s: float, utilisation: float) -> float:
    """Return how long to wait, in s, after a read that took `read_s` on a line with this utilisation."""
    share = min(MOST_SHARE, max(LEAST_SHARE, 1.0 - utilisation))
    return max(LEAST_PAUSE_S, read_s * (1.0 / share - 1.0))


def _in_words(failure: BusError) -> str:
    """Return the kind of a failure in a few words, such as "no reply"."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", type(failure).__name__).lower()
