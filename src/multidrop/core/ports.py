"""Lines driven on descriptors by the core's own thread: exchanges are queued, and reaped."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

from multidrop._core import ffi, lib
from multidrop.core.columns import Columns
from multidrop.core.exchanges import Completion, Exchange, Respondent, completion
from multidrop.core.taps import Tap

now_ns = lib.md_now_ns


class _Engine:
    """The core's thread, started when the first port is opened; there is one in a process."""

    def __init__(self) -> None:
        self.c = lib.md_engine_start()
        if self.c == ffi.NULL:
            raise OSError(ffi.errno, "the core's thread cannot be started")


@cache
def _engine() -> _Engine:
    return _Engine()


def notice_fd() -> int:
    """A descriptor that is readable when a port wants more exchanges; one client reads it empty."""
    return int(lib.md_engine_notice(_engine().c))


class Port:
    """A line driven on a descriptor by the core's thread (struct md_port).

    `must_take` is the mask of REFUSALS that are failures; -1 for a port without settings. `room` is
    how many exchanges may be queued, a power of two. OSError where the descriptor cannot be waited for.
    """

    def __init__(self, fd: int, must_take: int, room: int = 256) -> None:
        self.c = lib.md_port_open(_engine().c, fd, must_take, room)
        if self.c == ffi.NULL:
            raise OSError(ffi.errno, "the port cannot be waited for")
        self.room = room
        # Read in place: a call of the core would let go of the interpreter, and wait to have it back.
        self._progress = lib.md_port_progress(self.c)
        self._stopped = False
        self._respondents: set[Respondent] = set()

    def tap(self, tap: Tap) -> None:
        """Tell this tap, and no other any more, of all that goes over the line."""
        lib.md_port_tap(self.c, tap.c)
        self._tap = tap

    def end(self) -> bool:
        """Nothing more of the queue is begun; whether one of it is under way. Urgent exchanges still are."""
        return bool(lib.md_port_end(self.c))

    def stop(self) -> None:
        """Nothing more is carried out, and the descriptor is the caller's; what was can be reaped."""
        if not self._stopped:
            lib.md_port_stop(self.c)
            self._stopped = True

    def close(self) -> None:
        """Stop, and forget what was not reaped."""
        self.stop()
        lib.md_port_free(self.c)
        self.c = self._progress = None

    def submit(self, exchanges: Sequence[Exchange], not_before_ns: Sequence[int]) -> int:
        """Queue exchanges, none to be sent before its time; how many there was room for."""
        todo = ffi.new("struct md_exchange *[]", [exchange.c for exchange in exchanges])
        times = ffi.new("int64_t[]", not_before_ns)
        return int(lib.md_port_submit(self.c, todo, times, len(exchanges)))

    @property
    def pending(self) -> int:
        """How many queued exchanges are not carried out yet."""
        return int(self._progress.submitted - self._progress.done) & 0xFFFF_FFFF

    @property
    def lost(self) -> bool:
        """The descriptor failed, and nothing more is carried out on it."""
        return bool(self._progress.lost)

    def reap(self, columns: Columns, utc_minus_monotonic_ns: int) -> int:
        """Make rows of what was carried out; how many exchanges, fewer when the columns are full."""
        return int(lib.md_port_reap(self.c, columns.c, utc_minus_monotonic_ns))

    def carry_out(self, exchange: Exchange, *, not_before_ns: int = 0, expires_ns: int = 0) -> Completion:
        """Carry one out ahead of the queue and wait for it; after `expires_ns` it is not sent."""
        self._respondents.add(exchange.respondent)  # the core still looks at it when a late answer comes
        found = ffi.new("struct md_completion *")
        lib.md_port_carry_out(self.c, exchange.c, not_before_ns, expires_ns, found)
        return completion(found)
