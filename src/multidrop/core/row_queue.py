"""Rows and calls from the core's thread to a client."""

from __future__ import annotations

from functools import partial

from multidrop._core import ffi, lib
from multidrop.core.columns import Columns, RowLayout
from multidrop.core.fork import only_here, register_at_fork
from multidrop.core.result import Status

CHUNK_ROWS = 1 << 12
MOST_CHUNKS = 256  # waiting to be taken; further rows are dropped, and counted


class RowQueue:
    """Rows that nobody has taken yet, and the numbers of ports that need attention (struct md_row_queue)."""

    _MOST_AT_ONCE = 1024

    def __init__(self, chunk_rows: int = CHUNK_ROWS, most_chunks: int = MOST_CHUNKS) -> None:
        self._room = (chunk_rows, most_chunks)
        self._called = ffi.new("uint32_t[]", self._MOST_AT_ONCE)
        self._begin()
        register_at_fork(self)

    def _begin(self) -> None:
        made = lib.md_row_queue_new(*self._room)
        if made == ffi.NULL:
            raise OSError(ffi.errno, "no room for what the core leaves")
        self.c = ffi.gc(made, only_here(lib.md_row_queue_free))
        self._give_back = only_here(partial(lib.md_row_queue_give_back, self.c))

    def forked(self) -> None:
        """Be empty, in the child: the rows that wait are the parent's to take."""
        self._begin()

    def take(self) -> Columns | None:
        """Return the oldest rows that wait; None when there are none."""
        made = lib.md_row_queue_take(self.c)
        return None if made == ffi.NULL else Columns.lent(made, self._give_back)

    def add_miss(self, block: RowLayout, status: Status, due_ns: int) -> None:
        """Add rows for values that were due at `due_ns` and not asked for."""
        lib.md_row_queue_miss(self.c, block.c, status, due_ns)

    @property
    def chunks(self) -> int:
        """Columns that wait to be taken; the newest are still being filled."""
        return int(lib.md_row_queue_chunks(self.c))

    @property
    def dropped(self) -> int:
        """Rows for which there was no room."""
        return int(lib.md_row_queue_dropped(self.c))

    def call(self, number: int) -> None:
        """Wake whoever waits, as if the port of this number needed attention."""
        lib.md_row_queue_call(self.c, number)

    def await_calls(self, seconds: float) -> list[int]:
        """Wait for calls, at most so long; return the numbers of the ports that need attention."""
        count = lib.md_row_queue_await(self.c, round(seconds * 1e9), self._called, self._MOST_AT_ONCE)
        return ffi.unpack(self._called, count) if count else []
