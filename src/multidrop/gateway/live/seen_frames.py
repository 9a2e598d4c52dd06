"""Seen frames: commands that come over HTTP, which a network may hold up, and deliver twice.

A write, or a verb that may move a motor, names the newest frame that its sender had seen. It is carried out
only within some seconds of that frame, once, and only where no stop of its drive was called since, nor the
plant read anew. No clock of another machine is looked at, and no frame of an earlier process has a number of
one of ours. Pure.
"""

from __future__ import annotations

from collections.abc import Callable

from multidrop import WriteForbidden
from multidrop.gateway.commands import MOST_AGE_S

MOST_AGE_NS = round(MOST_AGE_S * 1e9)
TOO_LATE, OVERTAKEN, DOUBLED = "too late", "a stop was called", "it came before"  # rules of a WriteForbidden
ANOTHER_PLANT = "the plant was read anew"


class SeenFrames:
    """The frames of the last seconds, and the commands that named them.

    `clock` gives ns, and runs on while the machine sleeps. `stopped_ns` returns when the latest stop of a
    drive was called, by that clock; None without one.
    """

    def __init__(self, clock: Callable[[], int], stopped_ns: Callable[[str], int | None]) -> None:
        self.clock = clock
        self._stopped_ns = stopped_ns
        self._made: dict[int, int] = {}  # when, by the frame's number
        self._came: dict[int, set[object]] = {}  # commands, by the frame that they named
        self._newest = -1
        self._newest_before = -1  # the last one that showed another plant

    def note(self, n: int) -> None:
        """Note that a frame of this number is made now."""
        now_ns = self.clock()
        self._newest, self._made[n] = n, now_ns
        for old in [one for one, made_ns in self._made.items() if now_ns - made_ns > MOST_AGE_NS]:
            del self._made[old]
            self._came.pop(old, None)

    def begin_anew(self) -> None:
        """Note that there is another plant: a name of a frame before may be another drive's now."""
        self._newest_before = self._newest

    def admit(self, drive: str, what: str, command: object, seen: int) -> int:
        """Return until when a command may be sent whose sender had seen this frame, by the clock.

        Raises WriteForbidden where it may not, and when the same command names the same frame again.
        """
        made_ns = self._made.get(seen)
        until_ns = 0 if made_ns is None else made_ns + MOST_AGE_NS
        if made_ns is None or self.clock() > until_ns:
            last = f"frame {seen} is none of the last {MOST_AGE_S:g} s"
            raise WriteForbidden(
                f"{what} was not sent: {last}: look again, and confirm it anew", rule=TOO_LATE
            )
        if seen <= self._newest_before:
            since = f"the plant was read anew after frame {seen}"
            raise WriteForbidden(
                f"{what} was not sent: {since}: look again, and confirm it anew", rule=ANOTHER_PLANT
            )
        if (self._stopped_ns(drive) or 0) >= made_ns:
            since = f"a stop was called after frame {seen}"
            raise WriteForbidden(
                f"{what} was not sent: {since}: look again, and confirm it anew", rule=OVERTAKEN
            )
        came = self._came.setdefault(seen, set())
        if command in came:
            first = "the first answer says what became of it"
            raise WriteForbidden(f"{what} was not sent again: it came a second time; {first}", rule=DOUBLED)
        came.add(command)
        return until_ns
