"""Join two ptys like a null-modem cable; open a pty as a client for raw bytes."""

from __future__ import annotations

import os
import select
import selectors
import socket
import threading
import tty
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from multidrop.core import set_settings


@contextmanager
def linked_ptys() -> Iterator[tuple[str, str]]:
    """Yield the paths of two ports, each of which receives the bytes written to the other."""
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


PATIENCE = 60.0  # s to wait for a required reply


@contextmanager
def opened(path: str, baudrate: int = 9600) -> Iterator[int]:
    """Yield a descriptor of the port, opened and configured as by a client."""
    if path.startswith("socket://"):
        host, _, port = path.removeprefix("socket://").partition(":")
        with socket.create_connection((host, int(port))) as client:
            yield client.fileno()
        return
    fd = os.open(path, os.O_RDWR | os.O_NOCTTY)
    try:
        set_settings(fd, baudrate, "8N1")
        yield fd
    finally:
        os.close(fd)


def receive(fd: int, length: int, patience: float = PATIENCE) -> bytes:
    received = b""
    while len(received) < length and select.select([fd], [], [], patience)[0]:
        received += os.read(fd, 1024)
    return received
