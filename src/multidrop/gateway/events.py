"""Events: faults and silence of drives, from when to when. Pure."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from multidrop.gateway.hub import FAULT, NOT_ASKED, SILENT, Shown

MOST_ENDED = 200  # that are remembered


class Alarm(NamedTuple):
    """A fault or a silence of a drive; times are UTC in ms."""

    time: int
    drive: str
    kind: str  # "fault" or "silent"
    text: str
    ended: int | None


class Events:
    """Alarms that last, and the latest of those that are over."""

    def __init__(self) -> None:
        self._lasting: dict[tuple[str, str], Alarm] = {}  # by drive and kind, the oldest first
        self._ended: deque[Alarm] = deque(maxlen=MOST_ENDED)
        self.begun = 0  # so far

    def look(self, time: int, drive: str, shown: Shown) -> None:
        """Note what a drive shows. A fault lasts while the drive is silent: nobody saw it go."""
        state, words = shown
        if state == SILENT:
            self._begin(time, drive, SILENT, words or "no reply")
            return
        if words == NOT_ASKED:
            return
        self._end(time, drive, SILENT)
        if state == FAULT:
            self._begin(time, drive, FAULT, words or "it shows a fault")
        else:
            self._end(time, drive, FAULT)

    def forget(self, drive: str, time: int) -> None:
        """End what lasts of a drive that is no longer there."""
        self._end(time, drive, SILENT)
        self._end(time, drive, FAULT)

    def newest_first(self) -> list[Alarm]:
        """Return all alarms by the time of their begin."""
        return sorted([*self._lasting.values(), *self._ended], key=lambda alarm: -alarm.time)

    @property
    def lasting(self) -> list[Alarm]:
        return list(self._lasting.values())

    def _begin(self, time: int, drive: str, kind: str, text: str) -> None:
        before = self._lasting.get((drive, kind))
        if before is not None and (before.text == text or kind == SILENT):
            return
        self._end(time, drive, kind)
        self._lasting[drive, kind] = Alarm(time, drive, kind, text, None)
        self.begun += 1

    def _end(self, time: int, drive: str, kind: str) -> None:
        before = self._lasting.pop((drive, kind), None)
        if before is not None:
            self._ended.append(before._replace(ended=time))
