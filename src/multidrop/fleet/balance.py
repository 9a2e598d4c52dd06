"""Balance: which gateway each line belongs to, by rendezvous hashing with a bound. Pure.

Each line goes to the gateway with the highest weight for this pair that is not full yet; full is 110 % of the
mean. So a gateway that comes or goes moves its own share of the lines and few others.

A gateway may avoid a bucket of lines' masters, because the server that leads it dies with this gateway. It
gets lines of that bucket only where nobody else has room.
"""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import partial

from multidrop.fleet.names import owner_bucket

BOUND = 110  # percent of the mean
NOTHING_AVOIDED: Mapping[str, Collection[str]] = {}
NUMBER_BITS = 16  # the low bits of an entry: its gateway's number; the others are its weight


class Balance:
    """Ranks of all gateways for each line, kept between calls: only what came is weighed.

    20 gateways and 10,000 lines take 0.1 s the first time, and 20 ms when one came or went. Call `assign`
    outside of an event loop.
    """

    def __init__(self) -> None:
        self._gateways: list[str] = []  # by number
        self._ranks: dict[str, list[int]] = {}  # of each line, the best one last
        self._hashes: dict[str, int] = {}  # of each line

    def assign(
        self,
        lines: Sequence[str],
        gateways: Sequence[str],
        avoided: Mapping[str, Collection[str]] = NOTHING_AVOIDED,
    ) -> dict[str, str]:
        """Return the gateway of each line; empty where there is no gateway.

        `avoided` has the buckets that each gateway avoids, by its name.
        """
        if not gateways:
            return {}
        self._forget(lines, gateways)
        self._weigh(lines, gateways)
        most = -(-len(lines) * BOUND // (100 * len(gateways)))
        places = _Places(dict.fromkeys(sorted(gateways), most), avoided)
        for line in sorted(lines):
            places.add(line, partial(self._names, self._ranks[line]))
        return places.found

    def _names(self, rank: Sequence[int]) -> Iterator[str]:
        return (self._gateways[entry & _NUMBER] for entry in reversed(rank))

    def _forget(self, lines: Sequence[str], gateways: Sequence[str]) -> None:
        """Drop lines that went, and all where most of the gateways went."""
        if len(self._gateways) > 2 * len(gateways):
            self._gateways, self._ranks = [], {}
        if len(self._ranks) > len(lines):
            self._ranks = {line: self._ranks[line] for line in lines if line in self._ranks}
            self._hashes = {line: self._hashes[line] for line in self._ranks}

    def _weigh(self, lines: Sequence[str], gateways: Sequence[str]) -> None:
        known = set(self._gateways)
        came = [name for name in gateways if name not in known]
        numbers = {name: number for number, name in enumerate([*self._gateways, *came])}
        all_of_them = [(_hash(name), number) for name, number in numbers.items()]
        new_ones = all_of_them[len(self._gateways) :]
        for line in lines:
            rank = self._ranks.setdefault(line, [])
            if news := new_ones if rank else all_of_them:
                own = self._hashes.get(line) or self._hashes.setdefault(line, _hash(line))
                rank += [((own ^ other) * _MIXER & _WEIGHT) | number for other, number in news]
                rank.sort()
        self._gateways += came


class _Places:
    """The lines that have a gateway by now, and the room that is left."""

    def __init__(self, room: dict[str, int], avoided: Mapping[str, Collection[str]]) -> None:
        self.found: dict[str, str] = {}
        self._room = room  # by gateway, in order of name
        self._avoided = avoided
        self._added: defaultdict[tuple[str, str], list[str]] = defaultdict(list)  # by gateway and bucket
        self._is_hopeless: set[str] = set()  # buckets for which no room can be made

    def add(self, line: str, ranked: Callable[[], Iterator[str]]) -> None:
        """Give a line to the first of these that has room and does not avoid it, or else to the first."""
        bucket = owner_bucket(line)
        gateway = ""
        if bucket not in self._is_hopeless:
            suiting = (name for name in ranked() if self._has_room(name, bucket))
            gateway = next(suiting, "") or self._make_room(bucket)
        self._give(line, bucket, gateway or next(name for name in ranked() if self._room.get(name)))

    def _suits(self, gateway: str, bucket: str) -> bool:
        return bucket not in self._avoided.get(gateway, ())

    def _has_room(self, gateway: str, bucket: str) -> bool:
        return bool(self._room.get(gateway)) and self._suits(gateway, bucket)

    def _make_room(self, bucket: str) -> str:
        """Move a line on from a full gateway that suits this bucket, and return that one; "" for none."""
        for (gateway, other), lines in self._added.items():
            if lines and gateway in self._room and self._suits(gateway, bucket):
                to = next((name for name in self._room if self._has_room(name, other)), "")
                if to:
                    self._room[gateway] += 1
                    self._give(lines.pop(), other, to)
                    return gateway
        self._is_hopeless.add(bucket)
        return ""

    def _give(self, line: str, bucket: str, gateway: str) -> None:
        self._room[gateway] -= 1
        self._added[gateway, bucket].append(line)
        self.found[line] = gateway


_NUMBER = (1 << NUMBER_BITS) - 1
_WEIGHT = (1 << 64) - 1 - _NUMBER
_MIXER = 0x9E3779B97F4A7C15  # odd: the upper bits of a product depend on all bits of the other number


def _hash(name: str) -> int:
    return int.from_bytes(hashlib.blake2b(name.encode(), digest_size=8).digest(), "big")
