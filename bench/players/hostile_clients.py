"""Clients that attack a gateway until standard input ends. Arguments: a key of KINDS, the gateway's port."""

from __future__ import annotations

import selectors
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from functools import partial

HELD = 300  # HTTP connections that are open at the same time
REQUESTS = b"GET /api/plant HTTP/1.1\r\nHost: localhost\r\n\r\n" * 50
READERS = 63  # Modbus clients: one less than the gateway accepts
READ = bytes.fromhex("0001 0000 0006 01 03 3000 0001")  # answered even if the register is not polled


def _connect(port: int) -> socket.socket:
    return socket.create_connection(("127.0.0.1", port), 5.0)


def pipeline(port: int, new_per_s: float) -> None:
    """Keep HELD connections that send REQUESTS and read no answers; open `new_per_s` new ones per second."""
    held: deque[socket.socket] = deque()
    while len(held) < HELD or new_per_s:
        with suppress(OSError):  # the gateway has closed the connection
            client = _connect(port)
            held.append(client)
            client.sendall(REQUESTS)
        if len(held) > HELD:
            held.popleft().close()
            time.sleep(1 / new_per_s)
    threading.Event().wait()


def read_modbus(port: int) -> None:
    """Read with READERS clients. Each sends its next request as soon as it has an answer."""
    with selectors.DefaultSelector() as waiting:
        for _ in range(READERS):
            client = _connect(port)
            waiting.register(client, selectors.EVENT_READ)
            client.sendall(READ)
        while True:
            for key, _ in waiting.select():
                client = key.fileobj  # type: ignore[assignment]
                client.recv(512)
                client.sendall(READ)


KINDS: dict[str, Callable[[int], None]] = {
    "pipelining": partial(pipeline, new_per_s=0),
    "pipelining, 20 new/s": partial(pipeline, new_per_s=20),
    "Modbus readers": read_modbus,
}

if __name__ == "__main__":
    kind, port = sys.argv[1:]
    threading.Thread(target=KINDS[kind], args=[int(port)], daemon=True).start()
    sys.stdin.read()
