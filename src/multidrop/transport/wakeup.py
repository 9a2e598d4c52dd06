"""Wake a thread that waits in select, poll or an asyncio loop."""

from __future__ import annotations

import socket
from contextlib import suppress


class WakeUp:
    """A descriptor that is readable from `set` to `clear`; a socket, as Windows' select needs."""

    def __init__(self) -> None:
        self._reader, self._writer = socket.socketpair()
        self._reader.setblocking(False)
        self._writer.setblocking(False)
        self._number = self._reader.fileno()
        self._closed = False

    def fileno(self) -> int:
        return self._number

    def set(self) -> None:
        if not self._closed:
            with suppress(BlockingIOError):
                self._writer.send(b"\0")

    def clear(self) -> None:
        if not self._closed:
            with suppress(BlockingIOError):
                while self._reader.recv(64):
                    pass

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self._reader.close()
            self._writer.close()
