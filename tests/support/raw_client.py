"""A client that sends and receives raw bytes, independent of the simulator."""

from __future__ import annotations

import os
import select
import socket
from collections.abc import Iterator
from contextlib import contextmanager

from multidrop.core import set_settings

PATIENCE = 60.0  # s to wait for a required reply


@contextmanager
def opened(path: str, baudrate: int = 9600) -> Iterator[int]:
    """Give a descriptor, opened and configured like a client's."""
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
