"""Latch: raised by a stop, so that no write that was begun before it is sent after it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from multidrop._core import ffi, lib


class Latch:
    """The stops of one drive, counted; the core compares the count right before a request begins to leave.

    `rise` takes no lock: a signal handler may call it.
    """

    def __init__(self) -> None:
        self.c: Any = ffi.new("uint32_t *")
        self.why = ""  # of the last rise, or of its shutting
        self._is_shut = False
        self._holds: set[object] = set()  # stops under way

    def rise(self, why: str) -> None:
        """End every permit that there is."""
        if not self._is_shut:
            self.why = why
        lib.md_count_stop(self.c)

    def shut(self, why: str) -> None:
        """Rise for good: no permit is good any more."""
        if not self._is_shut:
            self.why = why
        self._is_shut = True
        self.rise(why)

    def hold(self, stop: object, why: str) -> None:
        """Rise, and stay so until it is let go: no permit that is asked for meanwhile is good."""
        self._holds.add(stop)
        self.rise(why)

    def let_go(self, stop: object) -> None:
        """End this stop's hold, if there is one."""
        self._holds.discard(stop)

    def permit(self, seen: int | None = None) -> Permit:
        """Return a permit that is good until the latch rises; while a stop is under way it never is.

        `seen`: what `c[0]` was when the call began that needs it.
        """
        if seen is None:
            seen = int(self.c[0])
        if self._is_shut or self._holds:  # read after `seen`: a rise between the two ends this permit
            seen = (seen - 1) & 0xFFFF_FFFF
        return Permit(self, seen)


@dataclass(frozen=True)
class Permit:
    """The permission to write what may move a motor, until a stop is called."""

    latch: Latch
    seen: int

    @property
    def is_good(self) -> bool:
        return int(self.latch.c[0]) == self.seen
