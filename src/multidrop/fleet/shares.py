"""Shares: which gateway each line should have, made anew where gateways or lines come or go."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import NamedTuple

from multidrop.fleet.balance import Balance
from multidrop.fleet.lease_rules import SECOND

QUIET_NS = SECOND // 2  # without a gateway that comes or goes, before shares are made anew while we settle


class Sharers(NamedTuple):
    """Those among whom lines are shared out, the buckets that each of them avoids, and the lines."""

    gateways: tuple[str, ...]
    avoided: Mapping[str, tuple[str, ...]]
    lines: tuple[str, ...]


class Shares:
    """The gateway of each line by the balance, for the sharers that were there last."""

    def __init__(self) -> None:
        self.wanted: dict[str, str] = {}  # each line's gateway
        self._balance = Balance()
        self._made: Sharers | None = None
        self._seen: Sharers | None = None
        self._seen_at = 0

    def begin_anew(self) -> None:
        """Wait for nobody the next time: a session begins."""
        self._made = None

    async def make(self, sharers: Sharers, now: int, *, is_settled: bool) -> bool:
        """Share the lines out, where that was not done; return True where it was now.

        It is done in a thread, for it takes long. Until we are settled more gateways may be about to come, as
        in a cold start, and are waited for.
        """
        if sharers != self._seen:
            self._seen, self._seen_at = sharers, now
        is_early = self._made is not None and not is_settled and now - self._seen_at < QUIET_NS
        if sharers == self._made or is_early:
            return False
        loop = asyncio.get_running_loop()
        self.wanted = await loop.run_in_executor(
            None, self._balance.assign, sharers.lines, sharers.gateways, sharers.avoided
        )
        self._made = sharers
        return True

    def of(self, gateway: str) -> set[str]:
        """Return the lines that this gateway should have."""
        return {line for line, name in self.wanted.items() if name == gateway}
