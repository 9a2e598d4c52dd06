"""Watching: a fleet looked at again and again, always with the age of what is told of it."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from typing import Any

from multidrop.fleet.overview import FleetView
from multidrop.printable import masked

EVERY_S = 1.0  # between looks


class FleetWatch:
    """The newest look at a fleet that came to its end, its age, and why there is no newer one."""

    def __init__(self, view: FleetView, clock: Callable[[], float] = time.monotonic) -> None:
        self._view = view
        self._clock = clock
        self._looked: float | None = None
        self.trouble: str | None = None  # with the newest look

    async def look(self) -> None:
        """Look anew; where that fails, what was seen before is kept, and grows old."""
        begun = self._clock()
        try:
            await self._view.look()
        except OSError as failure:
            self.trouble = masked(str(failure))
        else:
            self._looked, self.trouble = begun, None

    async def run(self) -> None:
        """Look for ever, once a second."""
        while True:
            await self.look()
            await asyncio.sleep(EVERY_S)

    @property
    def age_s(self) -> float | None:
        """Return how old the newest look is; None before there is one."""
        return None if self._looked is None else round(self._clock() - self._looked, 3)

    def told(self) -> dict[str, Any]:
        """Return what `fleet watch --json` prints and the gateway's page shows."""
        about = {"at_ms": time.time_ns() // 1_000_000, "age_s": self.age_s, "trouble": self.trouble}
        return {**about, **self._view.fleet()}
