"""Lately: what the lines did in the last seconds and in the last hour, from readings of their statistics.

Pure: readings and times come in.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

from multidrop import LineStatistics, Plant, Statistics

SECONDS = 5.0  # over which the use of a line is taken
MINUTES = 60

Reading = Mapping[str, LineStatistics]


class Lately:
    """Readings of a poller's statistics, about one a second."""

    def __init__(self, plant: Plant) -> None:
        self.newest: Reading = {}
        self._recent: deque[tuple[float, Reading]] = deque()
        self._minutes: deque[tuple[int, Reading]] = deque(maxlen=MINUTES + 1)
        self.adopt(plant)

    def adopt(self, plant: Plant) -> None:
        """Take what is planned from another plant."""
        planned = plant.metadata()["planned"]
        self._planned = {name: float(line["utilisation"]) for name, line in planned.items()}

    def tick(self, now: float, utc_ms: int, reading: Reading) -> None:
        """Take a reading; `now` is of the monotonic clock, in s."""
        self.newest = reading
        self._recent.append((now, reading))
        while now - self._recent[0][0] > SECONDS:
            self._recent.popleft()
        if not self._minutes or utc_ms - self._minutes[-1][0] >= 60_000:
            self._minutes.append((utc_ms, reading))

    def line(self, name: str) -> dict[str, Any]:
        """Return how much of a line is used and planned, and the misses of the last minute."""
        used = 0.0
        lately = self._since(self._recent[0][1] if self._recent else {}, name)
        if lately is not None:
            used = lately.utilisation
        misses = self._since(self._minutes[max(-2, -len(self._minutes))][1] if self._minutes else {}, name)
        return {
            "used": round(used, 4),
            "planned": round(self._planned.get(name, 0.0), 4),
            "misses": sum(misses.misses.values()) if misses else 0,
        }

    def _since(self, earlier: Reading, name: str) -> LineStatistics | None:
        now = self.newest.get(name)
        if now is None or name not in earlier or earlier[name] is now:
            return None
        return now.since(earlier[name])

    def drive(self, line: str, name: str) -> Statistics | None:
        """Return a drive's statistics since polling began; None for one that is not there."""
        found = self.newest.get(line)
        return found.drives.get(name) if found else None

    def hour(self, line: str) -> list[dict[str, Any]]:
        """Return misses by reason in each of the last 60 minutes, the oldest first."""
        readings = [*self._minutes, *([(0, self.newest)] if self.newest else [])]
        found = []
        for (begin_ms, before), (_, after) in pairwise(readings):
            if line in before and line in after and before[line] is not after[line]:
                misses: Counter[str] = after[line].since(before[line]).misses
                found.append({"time": begin_ms, "misses": {why: n for why, n in misses.items() if n > 0}})
        return found
