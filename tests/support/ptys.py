"""Two ptys joined like serial ports with a null-modem cable."""

from __future__ import annotations

import os
import selectors
import threading
import tty
from collections.abc import Iterator
from contextlib import contextmanager, suppress


@contextmanager
def linked_ptys() -> Iterator[tuple[str, str]]:
    """Give the paths of two ports, each of which receives what is written to the other."""
    masters, slaves = zip(*(os.openpty() for _ in range(2)), strict=True)
    for slave in slaves:
        tty.setraw(slave)
    reader, writer = os.pipe()
    thread = threading.Thread(target=_copy, args=(masters, reader), daemon=True)
    thread.start()
    try:
        yield os.ttyname(slaves[0]), os.ttyname(slaves[1])
    finally:
        os.write(writer, b"\0")
        thread.join()
        for fd in (*masters, *slaves, reader, writer):
            os.close(fd)


def _copy(masters: tuple[int, ...], stop: int) -> None:
    with selectors.DefaultSelector() as ready:
        for fd in (*masters, stop):
            ready.register(fd, selectors.EVENT_READ)
        while True:
            for key, _ in ready.select():
                if key.fd == stop:
                    return
                with suppress(OSError):
                    os.write(masters[1 - masters.index(key.fd)], os.read(key.fd, 1024))
