"""A relay to a server on this machine with a limited rate in bytes per second, in each direction."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

PIECE = 64  # most bytes that are forwarded at once


class SlowWay:
    """Forward connections to `port` to the server's port, at `rate` bytes per second (None: unlimited)."""

    def __init__(self, server: int) -> None:
        self.rate: float | None = None
        self._server = server
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        self._listener.close()

    def _accept(self) -> None:
        with suppress(OSError):  # the listener was closed
            while True:
                client, _ = self._listener.accept()
                server = socket.create_connection(("127.0.0.1", self._server))
                for one in (client, server):
                    one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                for ends in ((client, server), (server, client)):
                    threading.Thread(target=self._pass_on, args=ends, daemon=True).start()

    def _pass_on(self, source: socket.socket, sink: socket.socket) -> None:
        free = 0.0  # time at which all earlier bytes are forwarded
        with suppress(OSError):
            while piece := source.recv(PIECE if self.rate else 1 << 16):
                if self.rate:
                    free = max(free, time.monotonic()) + len(piece) / self.rate
                    time.sleep(max(0.0, free - time.monotonic()))
                sink.sendall(piece)
        for one in (source, sink):
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)


@contextmanager
def slow_way(server: int) -> Iterator[SlowWay]:
    way = SlowWay(server)
    try:
        yield way
    finally:
        way.close()
