"""Shares: which gateway each line should have, made anew where gateways or lines come or go."""

from __future__ import annotations

import asyncio
from typing import NamedTuple

from multidrop.fleet.leases.rules import SECOND
from multidrop.fleet.lines import balance

QUIET_NS = SECOND // 2  # without a gateway that comes or goes, before shares are made anew while we settle


class Sharers(NamedTuple):
    """Those among whom lines are shared out, the lines, and which of them may be handed over."""

    gateways: tuple[str, ...]
    lines: tuple[str, ...]
    unopened: tuple[tuple[str, frozenset[str]], ...] = ()  # lines that these gateways could not open


class Shares:
    """The gateway of each line by the balance, for the sharers that were there last."""

    def __init__(self) -> None:
        self.wanted: dict[str, str] = {}  # each line's gateway
        self.home: dict[str, str] = {}  # the same if each gateway could open all lines
        self._made: Sharers | None = None
        self._others: frozenset[str] = frozenset()
        self._seen_at = 0

    def begin_anew(self) -> None:
        """Make them the next time, whatever was made: a session begins."""
        self._made = None

    def see(self, others: frozenset[str], now: int) -> None:
        """Note the other gateways that are there."""
        if others != self._others:
            self._others, self._seen_at = others, now

    async def make(self, sharers: Sharers, now: int, *, is_settled: bool) -> bool:
        """Share the lines out, where that was not done; return True where it was now.

        It is done in a thread, for it takes long. Until we are settled more gateways may be about to come, as
        in a cold start, and are waited for: else the first one would read the records of all lines.
        """
        is_early = not is_settled and now - self._seen_at < QUIET_NS
        if sharers == self._made or is_early:
            return False
        loop = asyncio.get_running_loop()
        self.home = await loop.run_in_executor(None, balance.assign, sharers.lines, sharers.gateways)
        self.wanted = balance.hand_over(self.home, dict(sharers.unopened))
        self._made = sharers
        return True

    def of(self, gateway: str) -> set[str]:
        """Return the lines that this gateway should have."""
        return {line for line, name in self.wanted.items() if name == gateway}
