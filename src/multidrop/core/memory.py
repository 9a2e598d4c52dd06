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


class Chunks:
    """Allocates structs in one chunk of memory after another."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._owner, self._next, self._end = _new_chunk(0)

    def take(self, kind: str) -> tuple[Any, Any]:
        """Return a pointer to a new struct of this C type, all zero, and the object that owns its memory."""
        size = -(-ffi.sizeof(kind) // CACHE_LINE) * CACHE_LINE
        # the lock is held by another thread, or by code that a signal has interrupted
        if not self._lock.acquire(blocking=False):
            owner, at, _ = _new_chunk(size)
            return ffi.cast(f"{kind} *", at), owner
        try:
            if self._next + size > self._end:
                self._owner, self._next, self._end = _new_chunk(max(size, CHUNK_BYTES))
            at, self._next = self._next, self._next + size
            return ffi.cast(f"{kind} *", at), self._owner
        finally:
            self._lock.release()


def _new_chunk(size: int) -> tuple[Any, int, int]:
    """Return the owner of a new chunk of memory, and the addresses of its start and its end."""
    owner = ffi.new("uint8_t[]", size + CACHE_LINE)
    start = int(ffi.cast("uintptr_t", owner))
    start += -start % CACHE_LINE
    return owner, start, start + size


_chunks = Chunks()


def new_beside(kind: str, fields: dict[str, Any]) -> tuple[Any, Any]:
    """Return a pointer to a new struct, placed after the previous one, and the object that owns its memory.

    Keep a reference to the owner: without it, the struct's memory is freed.
    """
    made, owner = _chunks.take(kind)
    made[0] = fields
    return made, owner
