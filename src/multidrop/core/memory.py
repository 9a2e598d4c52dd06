"""Allocate adjacent memory, in whole cache lines, for the structs that the C core uses at every exchange.

With many lines, a line's structs and their page translations are no longer cached when its next exchange
starts. So the structs of a drive are placed side by side, and share a page or two.
"""

from __future__ import annotations

from threading import Lock
from typing import Any

from multidrop._core import ffi

CACHE_LINE = 64
CHUNK_BYTES = 1 << 14


class Chunk:
    """A piece of memory for several structs of the C core."""

    def __init__(self, size: int) -> None:
        self.owner = ffi.new("uint8_t[]", size + CACHE_LINE)
        self._next = int(ffi.cast("uintptr_t", self.owner))
        self._next += -self._next % CACHE_LINE
        self._end = self._next + size

    def has_room(self, size: int) -> bool:
        return self._next + size <= self._end

    def take(self, kind: str, size: int) -> Any:
        made = ffi.cast(f"{kind} *", self._next)
        self._next += size
        return made


class Chunks:
    """Allocates structs in one chunk of memory after another."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._present = Chunk(0)

    def take(self, kind: str) -> tuple[Any, Any]:
        """Return a pointer to a new struct of this C type, all zero, and the object that owns its memory."""
        size = -(-ffi.sizeof(kind) // CACHE_LINE) * CACHE_LINE
        # the lock is held by another thread, or by code that a signal has interrupted
        if not self._lock.acquire(blocking=False):
            chunk = Chunk(size)
            return chunk.take(kind, size), chunk.owner
        try:
            if not self._present.has_room(size):
                self._present = Chunk(max(size, CHUNK_BYTES))
            return self._present.take(kind, size), self._present.owner
        finally:
            self._lock.release()


_chunks = Chunks()


def new_beside(kind: str, fields: dict[str, Any]) -> tuple[Any, Any]:
    """Return a pointer to a new struct, placed after the previous one, and the object that owns its memory.

    Keep a reference to the owner: without it, the struct's memory is freed.
    """
    made, owner = _chunks.take(kind)
    made[0] = fields
    return made, owner
