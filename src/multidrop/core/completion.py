"""A completion: what became of an exchange."""

from __future__ import annotations

from typing import Any

from multidrop._core import ffi, lib
from multidrop.core.columns import RowLayout
from multidrop.core.frame import Message, from_c

_COMPLETION = ffi.typeof("struct md_completion *")
_VALUES = ffi.typeof("double[]")
_NO_NUMBERS = memoryview(b"").cast("d")


class Completion:
    """The result of an exchange (struct md_completion), read where it is asked for.

    Times are CLOCK_MONOTONIC, in ns. `count` is how many values of the exchange's the good reply has; -1
    where there is no good reply, and of an exception. They are the `numbers`, NaN where there is no value:
    `room` of them, at `values`. A read that went well asks for nothing else: with caches that a sleep has
    cooled each field, and each call, takes microseconds. Where nobody looks at it any more, an exchange with
    as many values may be carried out into it.
    """

    __slots__ = ("c", "count", "numbers", "room", "values")

    def __init__(self, found: Any = None, count: int = -1, *, room: int = 0) -> None:
        self.c = ffi.new(_COMPLETION) if found is None else found
        self.count = count
        self.room = room
        self.values = ffi.new(_VALUES, room)
        self.numbers = memoryview(ffi.buffer(self.values)).cast("d") if room else _NO_NUMBERS

    @property
    def result(self) -> int:
        """The reply's length; 0 after a broadcast, else a Failure or a FrameFault."""
        return int(self.c.result)

    @property
    def error(self) -> int:
        """An errno of a line that was lost, as C numbers it; or the REFUSALS of settings."""
        return int(self.c.error)

    @property
    def begun_ns(self) -> int:
        """The time at which its turn came."""
        return int(self.c.begun_ns)

    @property
    def sent_ns(self) -> int:
        """The time at which the request began to leave; 0: it never did."""
        return int(self.c.sent_ns)

    @property
    def first_ns(self) -> int:
        """The time at which the first byte was seen after the request; 0: none came."""
        return int(self.c.first_ns)

    @property
    def last_ns(self) -> int:
        """The time at which the last byte was seen; 0: none came."""
        return int(self.c.last_ns)

    @property
    def late_until_ns(self) -> int:
        """The time until which a late reply could come, as was known when it was asked for."""
        return int(self.c.late_until_ns)

    @property
    def stale(self) -> int:
        """Bytes that were thrown away before the request left."""
        return int(self.c.stale)

    @property
    def skipped(self) -> int:
        """Bytes after the request that were no part of the reply."""
        return int(self.c.skipped)

    @property
    def reply(self) -> Message:
        """The good reply, or an exception."""
        return from_c(self.c.reply)

    @property
    def data(self) -> bytes:
        """Data of the good reply; none where there is no such reply."""
        reply = self.c.reply
        return bytes(ffi.buffer(reply.data, reply.data_len)) if self.count >= 0 else b""

    def values_of(self, layout: RowLayout) -> list[float | None]:
        """Return the values of any fields in the good reply; None where it has none."""
        values = ffi.new(_VALUES, layout.count)
        lib.md_values(layout.c, ffi.addressof(self.c, "reply"), values)
        return [None if value != value else value for value in ffi.unpack(values, layout.count)]

    @property
    def raw(self) -> bytes:
        """The reply's bytes; of a failure the end of what came."""
        return bytes(ffi.buffer(self.c.raw, self.c.raw_len))

    def unanswered(self) -> Completion:
        """Return a copy to which nothing came: the reply was the request's echo."""
        found = ffi.new("struct md_completion *", self.c[0])
        found.result, found.raw_len = lib.MD_NO_REPLY, 0
        return Completion(found)
