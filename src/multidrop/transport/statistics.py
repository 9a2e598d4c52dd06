"""Statistics of a line and its drives: results of exchanges, response delays, utilisation.

All figures derive from counters that only grow. The counters of a time span are the difference of two
readings. A reading does not delay the line.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate, count
from typing import TYPE_CHECKING, Any

from multidrop.core import DELAY_BUCKETS, EXCEPTION_STATUS, STATUSES, Counters, Status, delay_edge
from multidrop.transport import clock

if TYPE_CHECKING:
    from multidrop.transport.exchange import Exchanges


# All counters must be read while no exchange ends, so that they fit together. This is the number of attempts.
LOOKS = 3
_EPOCHS = count(1)


# Statuses of exchanges in which bytes were received, but no good frame.
_DAMAGED = (Status.BAD_CHECKSUM, Status.BAD_CHARACTER, Status.CUT_SHORT, Status.NO_START)

_NOTHING = Counters()
_UNNUMBERED: Mapping[str, int] = {}


@dataclass(frozen=True)
class Diagnostics:
    """The eight counters of the MODBUS serial-line guide (V1.02, appendix A), from the client's side.

    In the guide a drive counts its input; here the client counts its exchanges with a drive, or with all
    drives of a line.
    """

    bus_messages: int
    """Good frames received: replies (also exceptions and late ones), and confirmations of another write.
    Frames from other addresses are not counted, because they may be incomplete."""

    bus_communication_errors: int
    """Exchanges that ended with damage: a bad checksum or character, a truncated reply, or bytes without a
    frame. Parity and framing errors appear as such damage. Noise that starts like a frame from another
    address cannot be distinguished from such a frame, and is not counted."""

    bus_exception_errors: int
    """Exception replies. A drive never answers a broadcast, not even with an exception."""

    server_messages: int
    """Requests sent, including broadcasts (counted for the drive whose register was written).
    It is unknown whether the drive received them."""

    server_no_responses: int
    """Broadcasts, and requests without any reply within the timeout."""

    server_naks: int
    """Exception replies with code 07, negative acknowledge."""

    server_busies: int
    """Exception replies with code 06, busy."""

    bus_character_overruns: int | None
    """Characters (not messages) that the port lost because they came too fast. Only for a line; None if the
    driver does not count them, as on pseudo-terminals and networks. Characters that a drive loses are
    unknown."""


@dataclass(frozen=True)
class Delays:
    """Response delays in s, from the last bit of a request to the first bit of its reply.

    From 0.07 ms to 4 s, quantiles are accurate to 1/16 of their value.
    """

    replies: int
    p50: float
    p90: float
    p99: float
    longest: float
    """Exact since counting started. For a later time span it is accurate to 1/8, unless it is the longest
    delay of all."""


@dataclass(frozen=True)
class Statistics:
    """Results of the exchanges with one drive, or with all drives of a line, within `seconds` s."""

    seconds: float
    counters: Counters
    overruns: int | None = None
    counted_s: float | None = None
    """Length in s of the time span of the counted exchanges; None means `seconds`. If an exchange is in
    flight at a reading, the span ends at the start of that exchange, which counts in the next span."""
    epoch: int = field(default=0, kw_only=True)
    """Number that identifies the start of counting. It differs for another line or drive of the same name,
    and changes when a line's statistics are reset."""

    @property
    def exchanges(self) -> int:
        """Number of requests sent, with any result."""
        return self.counters.sent

    @property
    def exchanges_per_second(self) -> float:
        return self.exchanges / self.seconds

    @property
    def samples(self) -> int:
        return self.counters.values

    @property
    def misses(self) -> Counter[str]:
        """Number of missing values, by reason: the status text of their rows."""
        found = Counter({STATUSES[status]: n for status, n in self.counters.missed.items()})
        found.update({STATUSES[EXCEPTION_STATUS + code]: n for code, n in self.counters.refused.items()})
        return found

    @property
    def late_replies(self) -> int:
        """Number of replies that were recognised after their timeout."""
        return self.counters.late

    @property
    def timeout(self) -> float:
        """Present timeout in s; for a line, the longest timeout of its drives.

        The timeout follows the drive's measured response delay. It grows if replies are late repeatedly.
        """
        return self.counters.timeout_ns / 1e9

    @property
    def skipped_bytes(self) -> int:
        """Number of bytes outside replies: noise, late replies, an adapter's echo."""
        return self.counters.stray_bytes

    @property
    def utilisation(self) -> float:
        """Fraction of the line's time that the answered exchanges needed.

        An exchange needs silence, request, response delay and reply, at the line's settings. A port may be
        faster than its settings, such as a network or a pseudo-terminal: then the measured time of the
        exchange counts instead. An exchange counts when it ends: see `counted_s`.
        """
        return self.used_s / (self.seconds if self.counted_s is None else self.counted_s)

    @property
    def used_s(self) -> float:
        """Time in s that the answered exchanges needed on the line; see `utilisation`."""
        return self.counters.ideal_ns / 1e9

    @property
    def delays(self) -> Delays:
        counters = self.counters
        p50, p90, p99 = _quantiles(counters, (0.5, 0.9, 0.99))
        return Delays(counters.delays.total(), p50, p90, p99, counters.longest_ns / 1e9)

    @property
    def delay_counts(self) -> list[tuple[float, int]]:
        """A histogram of the response delays: pairs of a bucket's least delay in s and its number of replies.

        Empty buckets are omitted. The width of a bucket is an eighth of its least delay.
        """
        return [(delay_edge(bucket) / 1e9, n) for bucket, n in sorted(self.counters.delays.items()) if n > 0]

    @property
    def diagnostics(self) -> Diagnostics:
        counters = self.counters
        return Diagnostics(
            bus_messages=counters.answered + counters.late + counters.ended[Status.BAD_ECHO],
            bus_communication_errors=sum(counters.ended[why] for why in _DAMAGED),
            bus_exception_errors=counters.exceptions,
            server_messages=counters.sent,
            server_no_responses=counters.ended[Status.OK] + counters.ended[Status.NO_REPLY],
            server_naks=counters.naks,
            server_busies=counters.busies,
            bus_character_overruns=self.overruns,
        )


@dataclass(frozen=True)
class LineStatistics(Statistics):
    """Statistics of a line, and of each drive on it by name."""

    drives: Mapping[str, Statistics] = field(default_factory=dict)

    def since(self, earlier: LineStatistics) -> LineStatistics:
        """Return the statistics of the time since `earlier`, an earlier reading of this line.

        An epoch is a number that changes at each reset. If the line's epoch differs from that in `earlier`,
        the line was reset or replaced: it counts from zero. So does a drive whose epoch is not in `earlier`.
        Drives without an epoch are identified by their names.
        """
        if self.epoch != earlier.epoch:
            return self
        seconds = max(self.seconds - earlier.seconds, 1e-9)
        lost = None
        if self.overruns is not None and earlier.overruns is not None:
            lost = self.overruns - earlier.overruns
        epochs = {name: drive.epoch for name, drive in self.drives.items()}
        before = {drive.epoch or name: drive.counters for name, drive in earlier.drives.items()}
        counters_by_drive = {
            name: _difference(drive.counters, before.get(drive.epoch or name, _NOTHING))
            for name, drive in self.drives.items()
        }
        counted_s = None
        if self.counted_s is not None and earlier.counted_s is not None:
            counted_s = max(self.counted_s - earlier.counted_s, 1e-9)
        return line_statistics(seconds, counters_by_drive, lost, counted_s, epochs)


def line_statistics(
    seconds: float,
    counters_by_drive: Mapping[str, Counters],
    overruns: int | None,
    counted_s: float | None = None,
    epochs: Mapping[str, int] = _UNNUMBERED,
) -> LineStatistics:
    """Return the statistics of a line and its drives from counters over `seconds` s, given by drive name.

    `epochs` has a number for each drive name, which changes when the drive's counts restart at zero.
    """
    drives = {
        name: Statistics(seconds, counters, counted_s=counted_s, epoch=epochs.get(name, 0))
        for name, counters in counters_by_drive.items()
    }
    return LineStatistics(seconds, _sum(counters_by_drive.values()), overruns, counted_s, drives)


def _sum(counters_by_drive: Iterable[Counters]) -> Counters:
    drives = [Counters(), *counters_by_drive]
    totals = Counters._make(_total(column) for column in zip(*drives, strict=True))
    longest = max(counters.longest_ns for counters in drives)
    return totals._replace(longest_ns=longest, timeout_ns=max(counters.timeout_ns for counters in drives))


def _total(column: Sequence[Any]) -> Any:
    """Return the sum of numbers, or of Counter objects key by key."""
    if not isinstance(column[0], Counter):
        return sum(column)
    found: Counter[Any] = Counter()
    for counts in filter(None, column):
        found.update(counts)
    return found


def _difference(now: Counters, earlier: Counters) -> Counters:
    if earlier == _NOTHING:
        return now
    found = Counters._make(map(_minus, now, earlier))
    longest = now.longest_ns
    if longest == earlier.longest_ns:  # the longest delay may have been measured before the time span
        longest = min(longest, delay_edge(max(found.delays, default=-1) + 1))
    return found._replace(longest_ns=longest, timeout_ns=now.timeout_ns)


def _minus(now: Any, earlier: Any) -> Any:
    """Return the difference of two numbers, or key by key of two Counter objects."""
    return now - earlier if earlier else now


def _quantiles(counters: Counters, parts: Iterable[float]) -> list[float]:
    """Return quantiles of the response delay in s, each as the middle of its bucket; 0.0 without replies."""
    buckets = sorted(counters.delays)
    seen = list(accumulate(counters.delays[bucket] for bucket in buckets))
    if not seen:
        return [0.0 for _ in parts]
    return [_middle(counters, buckets[bisect_left(seen, part * seen[-1])]) for part in parts]


def _middle(counters: Counters, bucket: int) -> float:
    most = counters.longest_ns if bucket == DELAY_BUCKETS - 1 else delay_edge(bucket + 1)
    return min((delay_edge(bucket) + most) / 2, counters.longest_ns) / 1e9


class LineMeter:
    """Statistics of a line since it was opened or last reset; frozen when the line is closed."""

    def __init__(self, exchanges: Exchanges) -> None:
        self._exchanges = exchanges
        self._opened_ns = clock.now_ns()
        self._frozen: LineStatistics | None = None
        # the reading at the last reset, with an epoch of its own; all other readings have epoch 0
        self._reset_at = _numbered(line_statistics(0.0, {}, exchanges.line.overruns(), 0.0))

    def read(self) -> LineStatistics:
        reset_at = self._reset_at
        return replace(self._now().since(replace(reset_at, epoch=0)), epoch=reset_at.epoch)

    def reset(self) -> None:
        self._reset_at = _numbered(self._now())

    def freeze(self, overruns: int | None) -> None:
        """Stop counting, because the line is closed; `overruns` is the final number of lost characters."""
        self._frozen = self._frozen or self._count(overruns)

    def _now(self) -> LineStatistics:
        return self._frozen or self._count(self._exchanges.line.overruns())

    def _count(self, overruns: int | None) -> LineStatistics:
        peers = {drive.name: peer for drive, peer in dict(self._exchanges.peers.present).items()}
        for _ in range(LOOKS):
            counters_by_drive = {name: peer.counters() for name, peer in peers.items()}
            now_ns = clock.now_ns()
            counted_ns = self._exchanges.line.counted_ns(now_ns)
            counted = sum(counters.exchanges for counters in counters_by_drive.values())
            # no exchange with a drive ended between the two readings
            if counted == sum(peer.exchanges for peer in peers.values()):
                break
        seconds, counted_s = ((at_ns - self._opened_ns) / 1e9 for at_ns in (now_ns, counted_ns))
        epochs = {name: peer.number for name, peer in peers.items()}
        return line_statistics(seconds, counters_by_drive, overruns, counted_s, epochs)


def _numbered(reading: LineStatistics) -> LineStatistics:
    """Return these statistics with a new epoch number, which shows that a line was opened or reset."""
    return replace(reading, epoch=next(_EPOCHS))
