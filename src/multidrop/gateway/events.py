"""Events: faults and silences of drives, each with its begin and end. Pure."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from multidrop.gateway.hub import FAULT, INCOMPLETE, NOT_ASKED, SILENT, UNNAMED, Shown

MOST_ENDED = 1000  # that are remembered
MOST_SHOWN = 20  # of them beside those that last


class Alarm(NamedTuple):
    """A fault or a silence of a drive; times are UTC in ms."""

    time: int
    drive: str
    text: str
    ended: int | None
    kind: str  # "fault" or "silent"


class Events:
    """Alarms that last, and the latest of those that are over.

    `since` is the time (UTC, ms) from which all are known: none is of before it, and of later ones those that
    ended first are forgotten.
    """

    def __init__(self, since: int = 0) -> None:
        self.since = since
        self._lasting: dict[tuple[str, str], Alarm] = {}  # by drive and kind, the oldest first
        self._ended: deque[Alarm] = deque(maxlen=MOST_ENDED)
        self.begun = 0  # so far

    def look(self, time: int, drive: str, shown: Shown) -> None:
        """Note what a drive shows. A fault lasts until somebody sees it go, so while its drive is silent."""
        state, words = shown
        if state == SILENT:
            self._begin(time, drive, SILENT, words or "no reply")
            return
        if words == NOT_ASKED:
            return
        self._end(time, drive, SILENT)
        if state == FAULT:
            self._begin(time, drive, FAULT, words or UNNAMED)
        elif words != INCOMPLETE:
            self._end(time, drive, FAULT)

    def forget(self, drive: str, time: int) -> None:
        """End the alarms of a drive that is no longer there."""
        self._end(time, drive, SILENT)
        self._end(time, drive, FAULT)

    def shown(self) -> list[Alarm]:
        """Return those that last and the newest that ended, by the time of their begin, the newest first."""
        ended = [*self._ended][-MOST_SHOWN:]
        return sorted([*self._lasting.values(), *ended], key=lambda alarm: -alarm.time)

    def between(self, begin: int, end: int) -> list[Alarm]:
        """Return the alarms of a span of time, the newest first."""
        found = [one for one in (*self._lasting.values(), *self._ended) if one.time <= end]
        return sorted(
            (one for one in found if one.ended is None or one.ended >= begin), key=lambda alarm: -alarm.time
        )

    @property
    def lasting(self) -> list[Alarm]:
        return list(self._lasting.values())

    def _begin(self, time: int, drive: str, kind: str, text: str) -> None:
        before = self._lasting.get((drive, kind))
        if before is not None and (text in (before.text, UNNAMED) or kind == SILENT):
            return
        if before is not None and before.text == UNNAMED:  # the same fault, which has its name now
            self._lasting[drive, kind] = Alarm(before.time, drive, text, None, kind)
            return
        self._end(time, drive, kind)
        self._lasting[drive, kind] = Alarm(time, drive, text, None, kind)
        self.begun += 1

    def _end(self, time: int, drive: str, kind: str) -> None:
        before = self._lasting.pop((drive, kind), None)
        if before is not None:
            if len(self._ended) == MOST_ENDED:
                self.since = max(self.since, self._ended[0].ended or 0)
            self._ended.append(before._replace(ended=time))
