"""Messages to the service manager by sd_notify(3): ready, alive, reloading, stopping."""

from __future__ import annotations

import os
import socket
import time
from contextlib import suppress


class Notifier:
    """Sends messages to the service manager's socket; without a socket, all calls are ignored."""

    def __init__(self, address: str | None = None) -> None:
        self._address = os.environ.get("NOTIFY_SOCKET", "") if address is None else address

    @property
    def watchdog_s(self) -> float | None:
        """The service manager's limit of the time between WATCHDOG=1 messages, in s; None: no limit."""
        asked = os.environ.get("WATCHDOG_USEC", "")
        mine = os.environ.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        return int(asked) / 1e6 if asked.isdigit() and int(asked) > 0 and mine else None

    def send_reloading(self) -> None:
        """Report the start of a reload, with its time. A later READY=1 reports the end of the reload."""
        self.send("RELOADING=1", f"MONOTONIC_USEC={time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000}")

    def send(self, *lines: str) -> None:
        """Send lines such as READY=1, without waiting; they are lost if the manager's queue is full."""
        if not self._address:
            return
        abstract = self._address.startswith("@")
        address = "\0" + self._address[1:] if abstract else self._address
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
            manager.setblocking(False)
            manager.sendto("\n".join(lines).encode(), address)
