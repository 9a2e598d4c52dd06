"""Exchanges: a drive's statistics, a request, and its result."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import count
from typing import Any, Literal, NamedTuple

from multidrop._core import ffi, lib
from multidrop.core.columns import RowLayout
from multidrop.core.frame import Framing, Message, build_request, from_c, to_c
from multidrop.core.memory import new_apart, new_beside
from multidrop.core.permissions import Permit
from multidrop.core.port_settings import settings_to_c
from multidrop.core.result import Status


class Counters(NamedTuple):
    """Counters of exchanges (struct md_counters); all but longest_ns and timeout_ns only grow."""

    exchanges: int = 0
    answered: int = 0
    values: int = 0
    sent: int = 0  # requests that began to leave
    exceptions: int = 0  # exchanges that ended with one
    naks: int = 0  # with code 07
    busies: int = 0  # with code 06
    late: int = 0
    stray_bytes: int = 0
    ideal_ns: int = 0
    longest_ns: int = 0  # response delay
    timeout_ns: int = 0  # at present
    ended: Counter[Status] = Counter()  # exchanges without a reply; broadcasts are OK
    missed: Counter[Status] = Counter()  # values
    refused: Counter[int] = Counter()  # values, by exception code
    delays: Counter[int] = Counter()  # replies, by the bucket of their response delay


DELAY_BUCKETS: int = lib.MD_DELAY_BUCKETS
_EDGES_NS = tuple(int(lib.md_delay_edge(bucket)) for bucket in range(DELAY_BUCKETS + 1))


def delay_edge(bucket: int) -> int:
    """Return the least response delay of a bucket, in ns; it ends where the next one begins."""
    return _EDGES_NS[bucket]


def read_counters(drive: Any, timeout_ns: int, unasked: Counter[Status]) -> Counters:
    """Read what a struct md_drive counted; `unasked` are values that were due and not asked for."""
    c, history = drive.counters, drive.history
    return Counters(
        c.exchanges,
        c.answered,
        c.values,
        c.sent,
        history.exceptions,
        history.naks,
        history.busies,
        history.late,
        c.stray_bytes,
        c.ideal_ns,
        c.longest_ns,
        timeout_ns,
        _by_status(history.ended),
        _by_status(history.missed) + unasked,
        _by_place(history.refused, "I") if history.exceptions else Counter(),
        _by_place(drive.delays, "Q"),
    )


def _by_status(array: Any) -> Counter[Status]:
    return Counter({Status(code): count for code, count in _by_place(array, "Q").items()})


def _by_place(array: Any, kind: Literal["I", "Q"]) -> Counter[int]:
    """Return the numbers that are not 0, by their index."""
    numbers = memoryview(ffi.buffer(array)).cast(kind)
    return Counter({index: number for index, number in enumerate(numbers) if number})


_COMPLETION = ffi.typeof("struct md_completion *")
_VALUES = ffi.typeof("double[]")
_NO_NUMBERS = memoryview(b"").cast("d")


class Completion:
    """The result of an exchange (struct md_completion), read where it is asked for.

    Times are CLOCK_MONOTONIC, in ns. `count` is how many values of the exchange's the good reply has; -1
    where there is no good reply, and of an exception. They are the `numbers`, NaN where there is no value:
    `room` of them, at `values`. A read that went well asks for nothing else: with caches that a sleep has
    cooled each field, and each call, takes microseconds. Where nobody looks at it any more, an exchange with
    as many values may be carried out into it.
    """

    __slots__ = ("c", "count", "numbers", "room", "values")

    def __init__(self, found: Any = None, count: int = -1, *, room: int = 0) -> None:
        self.c = ffi.new(_COMPLETION) if found is None else found
        self.count = count
        self.room = room
        self.values = ffi.new(_VALUES, room)
        self.numbers = memoryview(ffi.buffer(self.values)).cast("d") if room else _NO_NUMBERS

    @property
    def result(self) -> int:
        """The reply's length; 0 after a broadcast, else a Failure or a FrameFault."""
        return int(self.c.result)

    @property
    def error(self) -> int:
        """An errno of a line that was lost, as C numbers it; or the REFUSALS of settings."""
        return int(self.c.error)

    @property
    def begun_ns(self) -> int:
        """The time at which its turn came."""
        return int(self.c.begun_ns)

    @property
    def sent_ns(self) -> int:
        """The time at which the request began to leave; 0: it never did."""
        return int(self.c.sent_ns)

    @property
    def first_ns(self) -> int:
        """The time at which the first byte was seen after the request; 0: none came."""
        return int(self.c.first_ns)

    @property
    def last_ns(self) -> int:
        """The time at which the last byte was seen; 0: none came."""
        return int(self.c.last_ns)

    @property
    def late_until_ns(self) -> int:
        """The time until which a late reply could come, as was known when it was asked for."""
        return int(self.c.late_until_ns)

    @property
    def stale(self) -> int:
        """Bytes that were thrown away before the request left."""
        return int(self.c.stale)

    @property
    def skipped(self) -> int:
        """Bytes after the request that were no part of the reply."""
        return int(self.c.skipped)

    @property
    def reply(self) -> Message:
        """The good reply, or an exception."""
        return from_c(self.c.reply)

    @property
    def data(self) -> bytes:
        """Data of the good reply; none where there is no such reply."""
        reply = self.c.reply
        return bytes(ffi.buffer(reply.data, reply.data_len)) if self.count >= 0 else b""

    def values_of(self, layout: RowLayout) -> list[float | None]:
        """Return the values of any fields in the good reply; None where it has none."""
        values = ffi.new(_VALUES, layout.count)
        lib.md_values(layout.c, ffi.addressof(self.c, "reply"), values)
        return [None if value != value else value for value in ffi.unpack(values, layout.count)]

    @property
    def raw(self) -> bytes:
        """The reply's bytes; of a failure the end of what came."""
        return bytes(ffi.buffer(self.c.raw, self.c.raw_len))

    def unanswered(self) -> Completion:
        """Return a copy to which nothing came: the reply was the request's echo."""
        found = ffi.new("struct md_completion *", self.c[0])
        found.result, found.raw_len = lib.MD_NO_REPLY, 0
        return Completion(found)


MOST_PROOFS: int = lib.MD_MOST_PROOFS
PAUSE_NS: int = lib.MD_PAUSE_S * 1_000_000_000
_NUMBERS = count(1)


class Peer:
    """The knowledge of one drive's replies (struct md_drive), shared by all its exchanges.

    `least_timeout` and `most_timeout`, in s, bound the time-out, which runs from the request's last
    bit to the reply's first; between them it is learnt from the drive's own response delays. No request
    leaves sooner than `interval`, in s, after the end of an exchange.
    """

    def __init__(self, *, least_timeout: float, most_timeout: float, interval: float = 0.0) -> None:
        self._history = ffi.new("struct md_history *")
        self.c, self._memory = new_beside(
            "struct md_drive",
            {
                "least_timeout_ns": round(least_timeout * 1e9),
                "most_timeout_ns": round(most_timeout * 1e9),
                "interval_ns": round(interval * 1e9),
                "history": self._history,
            },
        )
        self.number = next(_NUMBERS)  # no other peer of this process has it
        self.proofs: tuple[Exchange, ...] = ()
        self.unasked: Counter[Status] = Counter()  # values that were due and not asked for

    @property
    def exchanges(self) -> int:
        """Exchanges so far."""
        return int(self.c.counters.exchanges)

    @property
    def has_answered(self) -> bool:
        """True once a reply came, be it an exception, late or in doubt."""
        return bool(self.c.counters.answered or self.c.history.late or self.c.doubtful)

    @property
    def failures(self) -> int:
        """Exchanges in a row without an answer."""
        return int(self.c.failures)

    @property
    def late(self) -> int:
        """Replies that came after their time-out and were recognised."""
        return int(self.c.history.late)

    @property
    def late_until_ns(self) -> int:
        """The time until which the reply to an earlier request may still come."""
        return int(self.c.late_until_ns)

    @property
    def owes(self) -> bool:
        """True while replies to earlier requests may still come, on however slow a path."""
        return bool(self.c.owed_count)

    @property
    def answered_ns(self) -> int:
        """About the time of its newest reply; 0 before the first one."""
        return int(self.c.answered_ns)

    @property
    def pauses(self) -> int:
        """Replies that came PAUSE_NS or more after the one before."""
        return int(self.c.history.pauses)

    @property
    def ready_ns(self) -> int:
        """The time before which no request leaves for it."""
        return int(self.c.ready_ns)

    def inherit(self, before: Peer) -> None:
        """Take the place of another at its address, whose replies may still come."""
        lib.md_late_inherit(self.c, before.c)

    def prove_by(self, proofs: Sequence[Exchange]) -> None:
        """Send one of these, at most MOST_PROOFS, first where a late reply could be taken for another.

        No reply to one of them may pass for the reply to another. Call it once, before the first exchange:
        the core reads them from then on.
        """
        self.proofs = tuple(proofs[:MOST_PROOFS])
        self._c_proofs = ffi.new("struct md_exchange *[]", [proof.c for proof in self.proofs])
        for proof in self.proofs:
            proof.c.is_proof = True
        self.c.proofs, self.c.proof_count = self._c_proofs, len(self.proofs)

    def doubt_first_reply(self) -> None:
        """Have a proof sent after its first reply, which may answer what another process asked.

        Its first read is asked again then. Without proofs it goes as it comes.
        """
        self.c.is_doubted = True

    @property
    def timeout(self) -> float:
        """The present time-out, in s."""
        return float(lib.md_present_timeout_ns(self.c)) / 1e9

    @property
    def response_delay(self) -> float:
        """The smoothed response delay, in s; 0 before the first reply."""
        return float(self.c.delay_ns) / 1e9

    @property
    def vain_ns(self) -> int:
        """The time-out of its next read, if it stays silent."""
        return int(lib.md_vain_ns(self.c))

    @property
    def silences(self) -> int:
        """Exchanges that ended without a reply."""
        return int(self.c.history.ended[Status.NO_REPLY])

    def counters(self) -> Counters:
        """Count its exchanges so far, and values that were due and not asked for."""
        return read_counters(self.c, int(lib.md_present_timeout_ns(self.c)), self.unasked)


class Exchange:
    """One request with all that is needed to carry it out; made once, run as often as wanted.

    Times are in seconds: `character` of one character, `silence` before the request and after
    its reply, `turnaround` after a broadcast, `period` between its slots in a queue, if it has any.
    One that `insists` is sent even where a late reply may pass for its own. `timeout` is the least
    time-out; 0: as learnt. `answer` is the least and the greatest raw count of the reply's one register.
    `block` has the fields for rows, `values` those whose values its caller gets. `echo_probe` is sent first
    while it is unknown whether the adapter echoes: its reply is never a copy of its request. Once a stop was
    called, `permit` keeps the request from being sent.
    """

    __slots__ = (
        "_memory",
        "block",
        "c",
        "echo_probe",
        "framing",
        "peer",
        "permit",
        "request",
        "room",
        "settings",
        "values",
    )

    def __init__(
        self,
        framing: Framing,
        request: Message,
        peer: Peer,
        *,
        baudrate: int,
        format: str,
        character: float,
        silence: float,
        turnaround: float = 0.1,
        period: float = 0.0,
        insists: bool = False,
        timeout: float = 0.0,
        answer: tuple[int, int] | None = None,
        block: RowLayout | None = None,
        values: RowLayout | None = None,
        echo_probe: Exchange | None = None,
        permit: Permit | None = None,
    ) -> None:
        least, most = answer or (0, -1)  # the core takes the first count above them; 0: none is
        frame = build_request(framing, request)
        kept = frame if len(frame) <= lib.MD_KEPT_FRAME else b""  # the core builds a longer one again
        self.framing = framing
        self.request = request
        self.peer = peer
        self.block = block
        self.values = values
        self.room = values.count if values else 0  # for them, in a completion
        self.echo_probe = echo_probe
        self.permit = permit
        self.settings = (baudrate, format)
        self.c: Any
        is_polled = block is not None and block.count > 0
        self.c, self._memory = (new_beside if is_polled else new_apart)(
            "struct md_exchange",
            {
                "framing": framing,
                "request": to_c(request)[0],
                "frame_len": len(kept),
                "frame": list(kept),
                "settings": settings_to_c(baudrate, format),
                "character_ns": round(character * 1e9),
                "silence_ns": round(silence * 1e9),
                "turnaround_ns": round(turnaround * 1e9),
                "period_ns": round(period * 1e9),
                "insists": insists,
                "timeout_ns": round(timeout * 1e9),
                "least": least,
                "end": most + 1,
                "drive": peer.c,
                "block": block.c if block else ffi.NULL,
                "echo_probe": echo_probe.c if echo_probe else ffi.NULL,
                "stops": permit.latch.c if permit else ffi.NULL,
                "stops_seen": permit.seen if permit else 0,
                "values": values.c if values else ffi.NULL,
            },
        )
