"""Releases: which lines may be let go for another gateway now: those that it can claim at once.

A line is closed before it is given away, and is nobody's until that is stored. While its bucket has no leader
nothing is stored, so it is better polled where it is.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Set

from multidrop.fleet.leaders import has_leader
from multidrop.fleet.names import owner_bucket
from multidrop.fleet.servers import ServerPath

LOOK_S = 0.05  # between looks while lines are to be released


class Releases:
    """The lines that should be others', and which of their buckets had a leader a moment ago.

    `on_change` is called when more or fewer of them may be let go.
    """

    def __init__(self, path: Callable[[], ServerPath], on_change: Callable[[], object]) -> None:
        self._path = path
        self._on_change = on_change
        self._lines: Set[str] = frozenset()
        self._led: set[str] = set()

    def due(self, lines: Set[str]) -> set[str]:
        """Return those of these lines that may be let go now; the others are waited for."""
        self._lines = lines
        return {line for line in lines if owner_bucket(line) in self._led}

    async def watch(self) -> None:
        """Look at the buckets of the lines that are to be released, for ever."""
        while True:
            await self.look()
            await asyncio.sleep(LOOK_S)

    async def look(self) -> None:
        """Ask for the leaders once; nothing is asked where no line is to be released."""
        buckets = sorted({owner_bucket(line) for line in self._lines})
        answers = await asyncio.gather(*(has_leader(self._path(), bucket) for bucket in buckets))
        led = {bucket for bucket, is_led in zip(buckets, answers, strict=True) if is_led}
        if led != self._led:
            self._led = led
            self._on_change()
