"""WakeUp: tells select, poll or an asyncio loop that something waits."""

from __future__ import annotations

import os
from contextlib import suppress


class WakeUp:
    """A descriptor that is readable from `set` to `clear`."""

    def __init__(self) -> None:
        self._reader, self._writer = os.pipe()
        os.set_blocking(self._reader, False)
        os.set_blocking(self._writer, False)
        self._closed = False

    def fileno(self) -> int:
        return self._reader

    def set(self) -> None:
        if not self._closed:
            with suppress(BlockingIOError):
                os.write(self._writer, b"\0")

    def clear(self) -> None:
        if not self._closed:
            with suppress(BlockingIOError):
                while os.read(self._reader, 64):
                    pass

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            os.close(self._reader)
            os.close(self._writer)
