"""Exchanges: a request with its reply or failure, and a drive's statistics."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from enum import IntEnum
from itertools import count
from typing import Any, Literal, NamedTuple

from multidrop._core import ffi, lib
from multidrop.core.columns import RowLayout, number_at
from multidrop.core.frame import FrameFault, Framing, Message, build_request, from_c, settings_to_c, to_c
from multidrop.core.memory import new_beside
from multidrop.core.permissions import Permit


class Failure(IntEnum):
    """Reasons why an exchange has no reply, besides FrameFault (enum md_failure)."""

    CUT_SHORT = lib.MD_CUT_SHORT
    NO_REPLY = lib.MD_NO_REPLY
    LINE_LOST = lib.MD_LINE_LOST
    SETTINGS_REFUSED = lib.MD_SETTINGS_REFUSED
    LATE_ANSWER_DUE = lib.MD_LATE_ANSWER_DUE
    EXPIRED = lib.MD_EXPIRED
    POLL_ENDED = lib.MD_POLL_ENDED
    MAYBE_ECHO = lib.MD_MAYBE_ECHO
    NOT_MASTER = lib.MD_NOT_MASTER
    OTHER_MASTER = lib.MD_OTHER_MASTER
    POLLING_FAILED = lib.MD_POLLING_FAILED
    STALLED = lib.MD_STALLED


class Status(IntEnum):
    """A row's status: OK, or why the row has no value (enum md_status). Exception codes are not members."""

    text: str

    def __new__(cls, code: int, text: str) -> Status:
        one = int.__new__(cls, code)
        one._value_, one.text = code, text
        return one

    OK = lib.MD_OK, "ok"
    NO_START = -FrameFault.NO_START, "no frame in what was received"
    BAD_CHARACTER = -FrameFault.BAD_CHARACTER, "bad character"
    BAD_CHECKSUM = -FrameFault.BAD_CHECKSUM, "bad checksum"
    BAD_ADDRESS = -FrameFault.BAD_ADDRESS, "reply from another address"
    BAD_FUNCTION = -FrameFault.BAD_FUNCTION, "reply to another function"
    BAD_LENGTH = -FrameFault.BAD_LENGTH, "reply of another length"
    BAD_ECHO = -FrameFault.BAD_ECHO, "write confirmed with another address or value"
    BAD_REQUEST = -FrameFault.BAD_REQUEST, "request cannot be built"
    CUT_SHORT = -Failure.CUT_SHORT, "reply cut short"
    NO_REPLY = -Failure.NO_REPLY, "no reply"
    LINE_LOST = -Failure.LINE_LOST, "port lost"
    SETTINGS_REFUSED = -Failure.SETTINGS_REFUSED, "port refused its settings"
    LATE_ANSWER_DUE = -Failure.LATE_ANSWER_DUE, "not asked: late reply due"
    EXPIRED = -Failure.EXPIRED, "not sent: expired"
    NOT_ASKED = lib.MD_NOT_ASKED, "not asked: drive is silent"
    POLL_ENDED = -Failure.POLL_ENDED, "poll ended"
    MAYBE_ECHO = -Failure.MAYBE_ECHO, "maybe the adapter's echo"
    NO_VALUE = lib.MD_NO_VALUE, "no valid value"
    NOT_MASTER = -Failure.NOT_MASTER, "not sent: not master"
    OTHER_MASTER = -Failure.OTHER_MASTER, "not sent: another master"
    POLLING_FAILED = -Failure.POLLING_FAILED, "not asked: polling failed"
    STALLED = -Failure.STALLED, "not sent: port stalled"

    def __str__(self) -> str:
        return self.text


UNASKED = "not "  # the status texts of values that were not requested start with this
# the status of an exception is this number plus the exception's code
EXCEPTION_STATUS: int = lib.MD_EXCEPTION

_STATUS_OF: dict[int, Status] = {status.value: status for status in Status}
STATUSES = (
    *(_STATUS_OF[code].text if code in _STATUS_OF else "" for code in range(EXCEPTION_STATUS)),
    *(f"exception {code:02X}" for code in range(256)),
)
"""The text of every status code."""


# ---- exchanges ----


class Counters(NamedTuple):
    """Counters of a drive's exchanges (struct md_counters); all but longest_ns and timeout_ns only grow."""

    exchanges: int = 0
    answered: int = 0
    values: int = 0
    sent: int = 0  # number of requests that were sent, at least in part
    exceptions: int = 0  # exchanges that ended with an exception
    naks: int = 0  # exceptions with code 07
    busies: int = 0  # exceptions with code 06
    late: int = 0
    stray_bytes: int = 0
    ideal_ns: int = 0
    longest_ns: int = 0  # ns; longest response delay
    timeout_ns: int = 0  # ns; usual timeout of a read
    ended: Counter[Status] = Counter()  # exchanges without a reply, by status; OK: broadcasts
    missed: Counter[Status] = Counter()  # number of missing values, by status
    refused: Counter[int] = Counter()  # number of values missing because of an exception, by its code
    delays: Counter[int] = Counter()  # number of replies in each bucket of the histogram of response delays


DELAY_BUCKETS: int = lib.MD_DELAY_BUCKETS
_EDGES_NS = tuple(int(lib.md_delay_edge(bucket)) for bucket in range(DELAY_BUCKETS + 1))


def delay_edge(bucket: int) -> int:
    """Return the least response delay of a histogram bucket, in ns."""
    return _EDGES_NS[bucket]


def read_counters(drive: Any, timeout_ns: int, unasked: Counter[Status]) -> Counters:
    """Return the counters of a struct md_drive; `unasked` counts due values that were not requested."""
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
    return Counter({_STATUS_OF[code]: count for code, count in _by_place(array, "Q").items()})


def _by_place(array: Any, kind: Literal["I", "Q"]) -> Counter[int]:
    """Return the elements of a C array that are not 0, by their index."""
    numbers = memoryview(ffi.buffer(array)).cast(kind)
    return Counter({index: number for index, number in enumerate(numbers) if number})


_COMPLETION = ffi.typeof("struct md_completion *")
_VALUES = ffi.typeof("double[]")
_NO_NUMBERS = memoryview(b"").cast("d")


class Completion:
    """The result of an exchange (struct md_completion). Properties read the struct on access.

    Times are CLOCK_MONOTONIC, in ns. `numbers` are the values of the exchange's fields, NaN for a missing
    value. `count` is the number of values that exist; -1 without a good reply and after an exception. A
    successful read uses only `numbers` and `count`, because with cold caches each further field and call
    costs microseconds. An exchange with the same number of values (`room`) can reuse a completion.
    """

    __slots__ = ("c", "count", "numbers", "room", "values")

    def __init__(self, found: Any = None, *, room: int = 0) -> None:
        self.c = ffi.new(_COMPLETION) if found is None else found
        self.count = -1
        self.room = room
        self.values = ffi.new(_VALUES, room)
        self.numbers = memoryview(ffi.buffer(self.values)).cast("d") if room else _NO_NUMBERS

    result = number_at("c.result")  # > 0: length of the reply; 0: a broadcast; < 0: a Failure or FrameFault
    # errno if the line was lost; mask of the refused settings (REFUSALS) if the port refused any
    error = number_at("c.error")
    begun_ns = number_at("c.begun_ns")  # when the exchange's turn on the line started
    sent_ns = number_at("c.sent_ns")  # when the request was sent; 0: never
    first_ns = number_at("c.first_ns")  # when the first byte after the request arrived; 0: none came
    last_ns = number_at("c.last_ns")  # when the last byte arrived; 0: none came
    # copy of the drive's `late_until_ns` from the time when the exchange was requested
    late_until_ns = number_at("c.late_until_ns")
    stale = number_at("c.stale")  # number of bytes discarded before the request was sent
    skipped = number_at("c.skipped")  # number of bytes after the request that are not part of the reply

    @property
    def reply(self) -> Message:
        """The reply as a message: a good reply or an exception."""
        return from_c(self.c.reply)

    @property
    def data(self) -> bytes:
        """The data of the good reply; empty without a good reply."""
        reply = self.c.reply
        return bytes(ffi.buffer(reply.data, reply.data_len)) if self.count >= 0 else b""

    def values_of(self, layout: RowLayout) -> list[float | None]:
        """Return the values of this layout's fields in the good reply; None for a missing value."""
        values = ffi.new(_VALUES, layout.count)
        lib.md_values(layout.c, ffi.addressof(self.c, "reply"), values)
        return [None if value != value else value for value in ffi.unpack(values, layout.count)]

    @property
    def raw(self) -> bytes:
        """The bytes of the reply; after a failure, the last bytes received."""
        return bytes(ffi.buffer(self.c.raw, self.c.raw_len))

    def unanswered(self) -> Completion:
        """Return a copy that reports NO_REPLY, because the apparent reply was only the request's echo."""
        found = ffi.new("struct md_completion *", self.c[0])
        found.result, found.raw_len = lib.MD_NO_REPLY, 0
        return Completion(found)


MOST_PROOFS: int = lib.MD_MOST_PROOFS
PAUSE_NS: int = lib.MD_PAUSE_S * 1_000_000_000
_NUMBERS = count(1)


class Peer:
    """A drive's state and statistics (struct md_drive), shared by all its exchanges.

    `least_timeout` and `most_timeout`, in s, bound the timeout, which runs from the request's last bit to the
    reply's first. Between these bounds, the C core learns the timeout from the drive's response delays. At
    least `interval`, in s, passes between the end of an exchange and the next request.
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
        self.number = next(_NUMBERS)  # identifies this record within the process
        self.proofs: tuple[Exchange, ...] = ()
        self.unasked: Counter[Status] = Counter()  # number of due values that were not requested, by status

    exchanges = number_at("c.counters.exchanges")  # number of exchanges so far

    @property
    def has_answered(self) -> bool:
        """True once any reply came, even an exception, or a reply that is late or may be late."""
        return bool(self.c.counters.answered or self.c.history.late or self.c.doubtful)

    failures = number_at("c.failures")  # number of consecutive exchanges without a reply
    late = number_at("c.history.late")  # number of replies recognised after their timeout
    late_until_ns = number_at("c.late_until_ns")  # time until which replies to earlier requests may come

    @property
    def owes(self) -> bool:
        """True while replies to earlier requests may still come through a slow gateway or network."""
        return bool(self.c.owed_count)

    answered_ns = number_at("c.answered_ns")  # ns; approximate time of the last reply; 0 before the first
    # number of replies that came PAUSE_NS or more after the previous reply
    pauses = number_at("c.history.pauses")
    ready_ns = number_at("c.ready_ns")  # ns; earliest time of the next request

    def inherit(self, before: Peer) -> None:
        """Also expect late replies to requests of `before`, the earlier drive at this drive's address."""
        lib.md_late_inherit(self.c, before.c)

    def prove_by(self, proofs: Sequence[Exchange]) -> None:
        """Set the proofs: reads whose replies show that no reply to an earlier request can still come.

        If a late reply could be mistaken for a new one, the C core sends a proof first. Only the first
        MOST_PROOFS are used; their replies must all differ. Call this once, before the first exchange: from
        then on the C core reads the list.
        """
        self.proofs = tuple(proofs[:MOST_PROOFS])
        self._c_proofs = ffi.new("struct md_exchange *[]", [proof.c for proof in self.proofs])
        for proof in self.proofs:
            proof.c.is_proof = True
        self.c.proofs, self.c.proof_count = self._c_proofs, len(self.proofs)

    def doubt_first_reply(self) -> None:
        """Do not accept the drive's first reply, which may answer another process's request.

        After that reply, the C core first sends one of the reads given to `prove_by`, and then repeats the
        request. If there are no such reads, the first reply is accepted.
        """
        self.c.is_doubted = True

    @property
    def timeout(self) -> float:
        """The usual timeout of a read, in s; after failures see `next_timeout_ns`."""
        return float(lib.md_present_timeout_ns(self.c)) / 1e9

    @property
    def response_delay(self) -> float:
        """The smoothed response delay, in s; 0 before the first reply."""
        return float(self.c.delay_ns) / 1e9

    @property
    def next_timeout_ns(self) -> int:
        """The timeout of the next read in ns, sometimes longer than `timeout` while the drive is silent."""
        return int(lib.md_next_timeout_ns(self.c))

    @property
    def silences(self) -> int:
        """Number of exchanges that ended without a reply."""
        return int(self.c.history.ended[Status.NO_REPLY])

    def counters(self) -> Counters:
        return read_counters(self.c, int(lib.md_present_timeout_ns(self.c)), self.unasked)


class Exchange:
    """A request with its drive, timing and settings; created once, carried out as often as needed.

    Times are in seconds. `character` is the duration of one character. `silence` precedes the request and
    follows its reply, `turnaround` follows a broadcast. `period` is the period of the exchange's slots (0: it
    has no slots). With `insists` the request is sent even if a late reply could be mistaken for its own. With
    `is_stop_read` the request is a read of a stop, and may precede stops of silent drives.
    `timeout` is the least timeout; 0 means the learnt one. `answer` is the least and the greatest raw value
    of the only register in the reply. `block` has the fields for rows, `values` those for the caller of
    `Port.carry_out`. The `echo_probe` is sent first while it is unknown whether the adapter echoes; its reply
    is never a copy of its request. The request is not sent once its `permit` has ended.
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
        is_stop_read: bool = False,
        timeout: float = 0.0,
        answer: tuple[int, int] | None = None,
        block: RowLayout | None = None,
        values: RowLayout | None = None,
        echo_probe: Exchange | None = None,
        permit: Permit | None = None,
    ) -> None:
        least, most = answer or (0, -1)  # (0, -1): any raw value is accepted
        frame = build_request(framing, request)
        # a longer frame is not stored: the C core builds it for each exchange
        kept = frame if len(frame) <= lib.MD_KEPT_FRAME else b""
        self.framing = framing
        self.request = request
        self.peer = peer
        self.block = block
        self.values = values
        self.room = values.count if values else 0  # number of values that its Completion must hold
        self.echo_probe = echo_probe
        self.permit = permit
        self.settings = (baudrate, format)
        self.c: Any
        fields = {
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
            "is_stop_read": is_stop_read,
            "timeout_ns": round(timeout * 1e9),
            "least": least,
            "end": most + 1,
            "drive": peer.c,
            "block": block.c if block else ffi.NULL,
            "echo_probe": echo_probe.c if echo_probe else ffi.NULL,
            "stops": permit.latch.c if permit else ffi.NULL,
            "stops_seen": permit.seen if permit else 0,
            "values": values.c if values else ffi.NULL,
        }
        if block is not None and block.count > 0:
            self.c, self._memory = new_beside("struct md_exchange", fields)
        else:  # not polled, so its place in memory matters little
            self.c = self._memory = ffi.new("struct md_exchange *", fields)
