"""Statistics of lines and drives over the last seconds and the last hour. This module does no I/O."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

from multidrop import Plant
from multidrop.transport import LineStatistics, Statistics

USE_S = 5.0  # time, in s, over which a line's use is averaged
REFRESH_S = 5.0  # interval, in s, of computing the statistics of the last minute
MINUTE_S, MINUTES = 60.0, 60

Reading = Mapping[str, LineStatistics]


class RecentStatistics:
    """The recent statistics of a poller. `tick` adds a reading of its counters about once a second."""

    def __init__(self, plant: Plant) -> None:
        self.newest: Reading = {}
        self._recent: deque[tuple[float, Reading]] = deque()
        self._minute: dict[str, LineStatistics | None] = {}  # statistics over the last minute, by line
        self._due = 0.0  # monotonic time, in s, at which the figures of the last minute are refreshed next
        self._drives: dict[str, dict[str, Any]] = {}
        # figures from the newest reading of the counters, by line
        self._figures: dict[str, dict[str, Any]] = {}
        # one reading of the counters per minute, with its time: monotonic in s, and UTC in ms. Only the last
        # two, because readings are large.
        self._minutes: deque[tuple[float, int, Reading]] = deque(maxlen=2)
        # figures of each of the last 60 whole minutes, by line
        self._hours: dict[str, deque[dict[str, Any]]] = {}
        self.adopt(plant)

    def adopt(self, plant: Plant, planned: Mapping[str, Any] | None = None) -> None:
        """Continue with another plant, and forget the figures of lines that are not in it."""
        planned = plant.metadata()["planned"] if planned is None else planned
        self._planned = {name: float(line["utilisation"]) for name, line in planned.items()}
        self._hours = {name: minutes for name, minutes in self._hours.items() if name in self._planned}
        self.newest = {name: line for name, line in self.newest.items() if name in self._planned}
        self._due = 0.0
        self._refresh()

    def tick(self, now: float, utc_ms: int, reading: Reading) -> None:
        """Add a reading of the poller's counters at the monotonic time `now`, in s."""
        self.newest = reading
        self._recent.append((now, reading))
        while now - self._recent[0][0] > USE_S:
            self._recent.popleft()
        if not self._minutes or now - self._minutes[-1][0] >= MINUTE_S:
            for line in reading:
                self._hours.setdefault(line, deque(maxlen=MINUTES)).extend(self._this_minute(line))
            self._minutes.append((now, utc_ms, reading))
        is_complete = reading.keys() == self._minute.keys() and None not in self._minute.values()
        if now >= self._due or not is_complete:
            self._due = now + REFRESH_S
            self._refresh()
        self._figures = {line: self._line_figures(line, minute) for line, minute in self._minute.items()}

    def _refresh(self) -> None:
        self._minute = {line: self._last_minute(line) for line in self.newest}
        self._drives = {
            name: _of_minute(statistics)
            for line, minute in self._minute.items()
            for name, statistics in (minute or self.newest[line]).drives.items()
        }

    def line(self, name: str) -> dict[str, Any]:
        """Return a line's figures: measured and planned share of its time in use, exchanges per second.

        They also have two figures for the last minute: the 99th percentile of response delays in ms, and the
        number of missed values.
        """
        return self._figures.get(name) or self._line_figures(name, None)

    def _line_figures(self, name: str, minute: LineStatistics | None) -> dict[str, Any]:
        used, rate = self._use(name)
        return {
            "used": used,
            "planned": round(self._planned.get(name, 0.0), 4),
            "rate": rate,
            "p99": _p99(minute) if minute else None,
            "misses": sum(minute.misses.values()) if minute else None,
        }

    def _use(self, name: str) -> tuple[float | None, float | None]:
        """Return the used share of a line's bus time and its exchanges per second, over USE_S."""
        before = self._recent[0][1].get(name) if self._recent else None
        now = self.newest.get(name)
        if before is None or now is None or before is now or before.epoch != now.epoch:
            return None, None
        seconds = max(now.seconds - before.seconds, 1e-9)
        used_s = (now.counters.ideal_ns - before.counters.ideal_ns) / 1e9
        # negative after a reload that removed a drive with its counters
        exchanges = now.exchanges - before.exchanges
        return round(max(0.0, used_s / seconds), 4), round(max(0.0, exchanges / seconds), 1)

    def drive_figures(self, name: str) -> dict[str, Any]:
        """Return a drive's figures for the last minute.

        They are the share of missed values, and the 99th percentile of response delays in ms.
        """
        return self._drives.get(name, {"missed": None, "p99": None})

    def _last_minute(self, line: str) -> LineStatistics | None:
        """Return a line's statistics over the last one to two minutes; None without an earlier reading."""
        earlier = self._minutes[max(-2, -len(self._minutes))][2] if self._minutes else {}
        return self._since(earlier, line)

    def _since(self, earlier: Reading, name: str) -> LineStatistics | None:
        now = self.newest.get(name)
        if now is None or name not in earlier or earlier[name] is now:
            return None
        return now.since(earlier[name])

    def drive(self, line: str, name: str) -> Statistics | None:
        """Return a drive's statistics since polling started; None for an unknown drive."""
        found = self.newest.get(line)
        return found.drives.get(name) if found else None

    def hour(self, line: str) -> list[dict[str, Any]]:
        """Return the numbers of requested and missed values for each of the last 60 minutes, oldest first."""
        return [*self._hours.get(line, ()), *self._this_minute(line)][-MINUTES:]

    def _this_minute(self, line: str) -> list[dict[str, Any]]:
        """Return the figures of the current minute; an empty list if it has just started."""
        _, begin_ms, before = self._minutes[-1] if self._minutes else (0.0, 0, {})
        minute = self._since(before, line)
        return [{"time": begin_ms, "asked": asked_of(minute), "misses": misses_of(minute)}] if minute else []


def misses_of(statistics: Statistics) -> dict[str, int]:
    """Return the number of missing values by reason. Reasons without a missing value are left out."""
    return {why: n for why, n in statistics.misses.items() if n > 0}


def asked_of(statistics: Statistics) -> int:
    """Return the number of requested values, whether received or missed."""
    return statistics.samples + sum(statistics.misses.values())


def _of_minute(statistics: Statistics) -> dict[str, Any]:
    asked = asked_of(statistics)
    return {"missed": round(1 - statistics.samples / asked, 4) if asked else None, "p99": _p99(statistics)}


def _p99(statistics: Statistics) -> float | None:
    """Return the 99th percentile of the response delays in ms; None without replies."""
    delays = statistics.delays
    return round(delays.p99 * 1e3, 3) if delays.replies else None
