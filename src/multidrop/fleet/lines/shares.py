"""Shares: assigns each line to a gateway, by rendezvous hashing with bounded loads.

Each pair of line and gateway has a weight. A gateway is full when it has 110 % of the mean number of
lines. A line goes to the gateway with the highest weight among those that are not full. So when a
gateway is added or removed, few lines move besides those of its own share.
"""

from __future__ import annotations

import asyncio
import functools
import hashlib
from array import array
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import NamedTuple

import pyarrow as pa
import pyarrow.compute as pc

from multidrop.fleet.leases.rules import SECOND

BOUND = 110  # limit of a gateway's lines, in percent of the mean
NUMBER_BITS = 16  # the low bits of a weight hold its gateway's number


def assign(lines: Sequence[str], gateways: Sequence[str]) -> dict[str, str]:
    """Return the gateway of each line; an empty dict without gateways.

    Assigning 10,000 lines to 20 gateways takes 20 ms, so do not call this in an event loop.
    """
    if not gateways:
        return {}
    lines, gateways = sorted(lines), sorted(gateways)
    hashes = _words(map(_hash, lines))
    weights = [_weigh(hashes, name, number) for number, name in enumerate(gateways)]
    highest = pc.max_element_wise(*weights).to_pylist()
    room = [-(-len(lines) * BOUND // (100 * len(gateways)))] * len(gateways)
    found = {}
    for at, line in enumerate(lines):
        number = highest[at] & _NUMBER
        if not room[number]:
            number = max(one[at].as_py() for one in weights if room[one[at].as_py() & _NUMBER]) & _NUMBER
        room[number] -= 1
        found[line] = gateways[number]
    return found


def hand_over(wanted: Mapping[str, str], unopened: Mapping[str, Collection[str]]) -> dict[str, str]:
    """Return each line's gateway after moving lines away from gateways that cannot open them.

    `unopened` maps a gateway to the lines that it cannot open. A line that no gateway can open stays with
    its gateway. Gateways that are not keys of `unopened` get no lines.
    """
    found = dict(wanted)
    for line in {line for lines in unopened.values() for line in lines} & wanted.keys():
        able = [name for name, lines in unopened.items() if line not in lines]
        if able and line in unopened.get(wanted[line], ()):
            found[line] = max(able, key=lambda name: _hash(f"{line}/{name}"))
    return found


def _words(values: Iterable[int]) -> pa.UInt64Array:
    """Return the values as an array of 64-bit words.

    `pa.array` would take far longer, because it imports pandas if pandas is installed.
    """
    words = array("Q", values)
    return pa.Array.from_buffers(pa.uint64(), len(words), [None, pa.py_buffer(words)])


_NUMBER = (1 << NUMBER_BITS) - 1
_WEIGHT = _words([(1 << 64) - 1 - _NUMBER])[0]
# An odd factor spreads every bit of a number into the upper bits of the product.
_MIXER = _words([0x9E3779B97F4A7C15])[0]


def _weigh(hashes: pa.UInt64Array, gateway: str, number: int) -> pa.UInt64Array:
    """Return the weight of a gateway for each line."""
    own, place = _words([_hash(gateway), number])
    return pc.bit_wise_or(pc.bit_wise_and(pc.multiply(pc.bit_wise_xor(hashes, own), _MIXER), _WEIGHT), place)


@functools.lru_cache(1 << 16)
def _hash(name: str) -> int:
    return int.from_bytes(hashlib.blake2b(name.encode(), digest_size=8).digest(), "big")


QUIET_NS = SECOND // 2  # while settling, assign lines only after this time without new or lost gateways


class Sharers(NamedTuple):
    """The gateways that share the lines, the lines, and the lines that some gateways could not open."""

    gateways: tuple[str, ...]
    lines: tuple[str, ...]
    # each gateway with the lines that it could not open
    unopened: tuple[tuple[str, frozenset[str]], ...] = ()


class Shares:
    """The gateway that each line is assigned to, for the latest set of sharers."""

    def __init__(self) -> None:
        self.wanted: dict[str, str] = {}  # each line's gateway
        self.home: dict[str, str] = {}  # how lines would be assigned if every gateway could open every line
        self._made: Sharers | None = None
        self._others: frozenset[str] = frozenset()
        self._seen_at = 0

    def reset(self) -> None:
        """Force a new assignment at the next `make`, because a new session has started."""
        self._made = None

    def see(self, others: frozenset[str], now: int) -> None:
        """Note the other gateways that take lines now; `now` is in ns."""
        if others != self._others:
            self._others, self._seen_at = others, now

    async def make(self, sharers: Sharers, now: int, *, is_settled: bool) -> bool:
        """Assign the lines to gateways if anything has changed; return True if they were assigned now.

        The work is done in a thread, because it takes long. Until `is_settled`, lines are not assigned while
        further gateways appear, as in a cold start. Otherwise the first gateway would read the records of all
        lines.
        """
        is_early = not is_settled and now - self._seen_at < QUIET_NS
        if sharers == self._made or is_early:
            return False
        loop = asyncio.get_running_loop()
        self.home = await loop.run_in_executor(None, assign, sharers.lines, sharers.gateways)
        self.wanted = hand_over(self.home, dict(sharers.unopened))
        self._made = sharers
        return True

    def of(self, gateway: str) -> set[str]:
        """Return the lines assigned to this gateway."""
        return {line for line, name in self.wanted.items() if name == gateway}
