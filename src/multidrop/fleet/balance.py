"""Balance: which gateway each line belongs to, by rendezvous hashing with a bound. Pure.

Each line goes to the gateway with the highest weight for this pair that is not full yet; full is 110 % of the
mean. So a gateway that comes or goes moves its own share of the lines and few others.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

BOUND = 110  # percent of the mean


class Balance:
    """Weights, kept between calls: only those of gateways and lines that came are made.

    20 gateways and 10,000 lines take 0.2 s the first time. Call `assign` outside of an event loop.
    """

    def __init__(self) -> None:
        self._weights: dict[str, dict[str, bytes]] = {}

    def assign(self, lines: Sequence[str], gateways: Sequence[str]) -> dict[str, str]:
        """Return the gateway of each line; empty where there is no gateway."""
        if not gateways:
            return {}
        self._weights = {name: self._weights_of(name, lines) for name in sorted(gateways)}
        most = -(-len(lines) * BOUND // (100 * len(gateways)))
        room = dict.fromkeys(self._weights, most)
        found: dict[str, str] = {}
        for line in sorted(lines):
            weights = {name: one[line] for name, one in self._weights.items()}
            first = max(weights, key=weights.__getitem__)
            if not room[first]:
                first = max((name for name in weights if room[name]), key=weights.__getitem__)
            room[first] -= 1
            found[line] = first
        return found

    def _weights_of(self, gateway: str, lines: Sequence[str]) -> dict[str, bytes]:
        before = self._weights.get(gateway, {})
        return {line: before.get(line) or _weight(gateway, line) for line in lines}


def _weight(gateway: str, line: str) -> bytes:
    return hashlib.blake2b(f"{gateway}/{line}".encode(), digest_size=8).digest()
