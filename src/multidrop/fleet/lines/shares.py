"""Shares: which lines each gateway should poll, by rendezvous hashing with bounded loads. No I/O.

Each pair of line and gateway has a weight. A gateway is full when it has 110 % of the mean number of
lines. A line goes to the gateway with the highest weight among those that are not full. So when a
gateway is added or removed, few lines move besides those of its own share.

A gateway that is cut off from a line, but not from the servers, reports the line in its lease record after
some failures. The line is then assigned to a gateway that has not reported it. From time to time, a gateway
withdraws its report of one line, as a trial. The gateway then gets the line back, but cannot poll it if the
port still cannot be opened. So after each failed trial, the wait for the next trial is longer. If all
gateways have reported a line, no gateway polls it. Its trials then cost nothing, so they stay frequent.
"""

from __future__ import annotations

import asyncio
import functools
import hashlib
from array import array
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import NamedTuple

import pyarrow as pa
import pyarrow.compute as pc

from multidrop.fleet.lines.rules import SECOND

BOUND = 110  # limit of a gateway's lines, in percent of the mean
NUMBER_BITS = 16  # number of low bits of a line's hash that are replaced by a gateway's number
# a gateway in its first seconds assigns lines only if no other gateway has come or gone for this time
QUIET_NS = SECOND // 2
OPENINGS = 3  # number of failed attempts to open a line after which the line is reported to other gateways
# a line is reported to other gateways if its port is lost and no reply has come for this time
LOST_NS = 6 * SECOND
# LOST_NS counts from the newest reply. If that reply is already older than REPLY_NS when this gateway notices
# the loss, LOST_NS counts from the notice.
REPLY_NS = 3 * SECOND
# first and longest wait before a gateway again tries to open a line that it has reported
FIRST_WAIT_NS, LAST_WAIT_NS = 120 * SECOND, 24 * 3600 * SECOND
# To find out whether it can open a reported line again, a gateway stops reporting the line. It gives up if
# the line is not assigned to it within this time.
TRIAL_NS = 60 * SECOND
MOST_BYTES = 8_000  # limit, in bytes, of the names of reported lines in a lease record


def assign(lines: Sequence[str], gateways: Sequence[str]) -> dict[str, str]:
    """Return the gateway that each line is assigned to; an empty dict without gateways.

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

    `unopened` maps a gateway to the lines that it cannot open. A line that no gateway can open stays with its
    gateway. Gateways that are not keys of `unopened` get no further lines.
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
    own, place = _words([_hash(gateway), number])
    return pc.bit_wise_or(pc.bit_wise_and(pc.multiply(pc.bit_wise_xor(hashes, own), _MIXER), _WEIGHT), place)


@functools.lru_cache(1 << 16)
def _hash(name: str) -> int:
    return int.from_bytes(hashlib.blake2b(name.encode(), digest_size=8).digest(), "big")


class Sharers(NamedTuple):
    """All gateways and all lines to assign to them, and the lines that each gateway could not open."""

    gateways: tuple[str, ...]
    lines: tuple[str, ...]
    unopened: tuple[tuple[str, frozenset[str]], ...] = ()


class Shares:
    """The assignment of lines to gateways."""

    def __init__(self) -> None:
        self.wanted: dict[str, str] = {}  # the gateway that should poll each line
        self.home: dict[str, str] = {}  # the assignment if every gateway could open every line
        self._made: Sharers | None = None
        self._others: frozenset[str] = frozenset()
        self._seen_at = 0

    def reset(self) -> None:
        """Assign the lines again at the next call of `make`, because a new session has started."""
        self._made = None

    def note_others(self, others: frozenset[str], now: int) -> None:
        """Note the other gateways that poll lines now; `now` is in ns."""
        if others != self._others:
            self._others, self._seen_at = others, now

    async def make(self, sharers: Sharers, now: int, *, is_settled: bool) -> bool:
        """Assign the lines to gateways if anything has changed; return True if they were assigned now.

        The work is done in a thread, because it takes long. `is_settled` is False in the first seconds of
        this gateway's session. A whole fleet may be starting then, so lines are assigned only after QUIET_NS
        without new gateways. Otherwise the first gateway would be assigned all lines, and read their records.
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
        return {line for line, name in self.wanted.items() if name == gateway}


class UnopenedLines:
    """The lines whose ports this gateway cannot open; it reports them so that other gateways take them.

    Only as many lines are reported as fit into a lease record. This gateway itself retries the lines beyond
    that limit. `clock` returns ns.
    """

    def __init__(self, clock: Callable[[], int]) -> None:
        self.hopeless: frozenset[str] = frozenset()  # lines whose ports no gateway could open
        # the lines that this gateway would poll if all ports could be opened; None: unknown
        self.home: frozenset[str] | None = None
        self._clock = clock
        self._failures: dict[str, int] = {}
        self._lost_since: dict[str, int] = {}
        # reported lines, in the order in which this gateway will try to open them again
        self._named: dict[str, None] = {}
        self._wait_ns = FIRST_WAIT_NS
        self._trial_at = 0
        self._tried = ""
        self._tried_since = 0

    def failed(self, line: str) -> None:
        """Count a failed attempt to open the line's port; report the line after OPENINGS failures."""
        self._failures[line] = self._failures.get(line, 0) + 1
        if self._failures[line] >= OPENINGS:
            self._name(line)

    def lost(self, line: str, silent_ns: int | None = None) -> None:
        """Note that the port of a polled line is lost; after LOST_NS, report the line to other gateways.

        `silent_ns` is the age of the newest reply on the line. LOST_NS counts from that reply, because in a
        network that drops everything, writes and connection attempts fail only after seconds. If `silent_ns`
        is None or large, LOST_NS counts from the first call.
        """
        now = self._clock()
        since = now - silent_ns if silent_ns is not None and silent_ns <= REPLY_NS else now
        if now - self._lost_since.setdefault(line, since) >= LOST_NS:
            self._name(line)

    def opened(self, line: str) -> None:
        """Stop reporting the line to other gateways, because this gateway has opened its port."""
        self._failures.pop(line, None)
        self._lost_since.pop(line, None)
        self._named.pop(line, None)
        if line == self._tried:  # the network works again: try the other reported lines immediately
            self._tried, self._wait_ns, self._trial_at = "", FIRST_WAIT_NS, self._clock()
            for other in self._named.keys() - (self._named.keys() if self.home is None else self.home):
                # without a report, this line is assigned to another gateway, which then tries to open it
                del self._named[other]

    def gone(self, line: str) -> None:
        self._failures.pop(line, None)
        self._lost_since.pop(line, None)

    def named(self) -> frozenset[str]:
        """Return the lines that other gateways should take, because this gateway cannot open them.

        Call this often. From time to time a call leaves out one line, so that the line is assigned to this
        gateway, which then tries to open it again.
        """
        now = self._clock()
        if self._tried and now - self._tried_since >= TRIAL_NS:
            self._tried = ""
        hopeless = [line for line in self._named if line in self.hopeless]
        trial_at = min(self._trial_at, self._tried_since + FIRST_WAIT_NS) if hopeless else self._trial_at
        home = [line for line in self._named if self.home is None or line in self.home]
        if self._named and not self._tried and now >= trial_at:
            self._tried, self._tried_since = next(iter(hopeless or home or self._named)), now
            del self._named[self._tried]
            self._trial_at = now + self._wait_ns
        return frozenset(self._named)

    def _name(self, line: str) -> None:
        now = self._clock()
        if line in self._named or sum(len(one) + 4 for one in (*self._named, line)) > MOST_BYTES:
            return
        if line == self._tried:
            self._tried, self._wait_ns = "", min(2 * self._wait_ns, LAST_WAIT_NS)
            self._trial_at = now + self._wait_ns
        elif not self._named and not self._tried:
            self._trial_at, self._tried_since = now + self._wait_ns, now
        self._named[line] = None
