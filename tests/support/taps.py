"""A line with a passive listener: a third port receives what master and drives send."""

from __future__ import annotations

import os
import selectors
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from multidrop.core import set_settings


@contextmanager
def tapped(drives: str, baudrate: int, hear: Callable[[bytes], bytes] = bytes) -> Iterator[tuple[str, str]]:
    """Give the paths of the master's port and of the listener's; `drives` is the port of the drives.

    `hear(said)` returns the bytes that the listener receives for these.
    """
    behind = os.open(drives, os.O_RDWR | os.O_NOCTTY)
    set_settings(behind, baudrate, "8N1")
    (master, master_port), (tap, tap_port) = os.openpty(), os.openpty()
    for port in (master_port, tap_port):
        tty.setraw(port)
    reader, writer = os.pipe()
    thread = threading.Thread(target=_copy, args=(behind, master, tap, reader, hear), daemon=True)
    thread.start()
    try:
        yield os.ttyname(master_port), os.ttyname(tap_port)
    finally:
        os.write(writer, b"\0")
        thread.join()
        for fd in (behind, master, master_port, tap, tap_port, reader, writer):
            os.close(fd)


def _copy(behind: int, master: int, tap: int, stop: int, hear: Callable[[bytes], bytes]) -> None:
    with selectors.DefaultSelector() as ready:
        for fd in (behind, master, stop):
            ready.register(fd, selectors.EVENT_READ)
        while True:
            for key, _ in ready.select():
                if key.fd == stop:
                    return
                with suppress(OSError):
                    said = os.read(key.fd, 1024)
                    os.write(tap, hear(said))  # first, to deliver a request before its reply
                    os.write(master if key.fd == behind else behind, said)
