"""The only importer of the compiled module: frames, exchanges and columns for Python."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cache, lru_cache
from itertools import accumulate
from typing import Any, Literal, NamedTuple

from multidrop._core import ffi, lib

now_ns = lib.md_now_ns
crc16 = lib.md_crc16
lrc = lib.md_lrc
sum8 = lib.md_sum


class Framing(IntEnum):
    RTU = lib.MD_RTU
    ASCII = lib.MD_ASCII
    DELIXI = lib.MD_DELIXI

    def __str__(self) -> str:
        return self.name.lower()


class Wire(IntEnum):
    """How a number lies in a reply's data; words are big-endian, SWAPPED has the low word first."""

    U16 = lib.MD_U16
    I16 = lib.MD_I16
    U32 = lib.MD_U32
    I32 = lib.MD_I32
    U32_SWAPPED = lib.MD_U32_SWAPPED
    I32_SWAPPED = lib.MD_I32_SWAPPED
    U32_EITHER = lib.MD_U32_EITHER
    F32 = lib.MD_F32
    F32_SWAPPED = lib.MD_F32_SWAPPED
    BIT = lib.MD_BIT


class Result(IntEnum):
    """Why there is no reply, or why bytes are not what was looked for (enum md_result)."""

    INCOMPLETE = lib.MD_INCOMPLETE
    NO_START = lib.MD_NO_START
    BAD_CHARACTER = lib.MD_BAD_CHARACTER
    BAD_CHECKSUM = lib.MD_BAD_CHECKSUM
    BAD_ADDRESS = lib.MD_BAD_ADDRESS
    BAD_FUNCTION = lib.MD_BAD_FUNCTION
    BAD_LENGTH = lib.MD_BAD_LENGTH
    BAD_ECHO = lib.MD_BAD_ECHO
    BAD_REQUEST = lib.MD_BAD_REQUEST
    CUT_SHORT = lib.MD_CUT_SHORT
    NO_REPLY = lib.MD_NO_REPLY
    LINE_LOST = lib.MD_LINE_LOST
    SETTINGS_REFUSED = lib.MD_SETTINGS_REFUSED
    LATE_ANSWER_DUE = lib.MD_LATE_ANSWER_DUE
    EXPIRED = lib.MD_EXPIRED
    NOT_ASKED = lib.MD_NOT_ASKED

    def __str__(self) -> str:
        return _REASONS[self]


_REASONS = {
    Result.INCOMPLETE: "ok",
    Result.NO_START: "no frame in what was received",
    Result.BAD_CHARACTER: "bad character",
    Result.BAD_CHECKSUM: "bad checksum",
    Result.BAD_ADDRESS: "reply from another address",
    Result.BAD_FUNCTION: "reply to another function",
    Result.BAD_LENGTH: "reply of another length",
    Result.BAD_ECHO: "write confirmed with another address or value",
    Result.BAD_REQUEST: "request cannot be built",
    Result.CUT_SHORT: "reply cut short",
    Result.NO_REPLY: "no reply",
    Result.LINE_LOST: "port lost",
    Result.SETTINGS_REFUSED: "port refused its settings",
    Result.LATE_ANSWER_DUE: "not asked: late reply due",
    Result.EXPIRED: "not sent: expired",
    Result.NOT_ASKED: "not asked: drive is silent",
}

EXCEPTION_STATUS = 256  # a column's status of exception code n is 256 + n


STATUSES = (
    *(_REASONS[Result(-code)] for code in range(-min(Result) + 1)),
    *([""] * (EXCEPTION_STATUS + min(Result) - 1)),  # codes that are not used
    *(f"exception {code:02X}" for code in range(256)),
)


def status_text(status: int) -> str:
    """What a status column says for the core's status code."""
    return STATUSES[status]


@dataclass(frozen=True)
class Message:
    """One frame's meaning, whatever its framing (struct md_message)."""

    address: int
    function: int
    start: int = 0
    count: int = 0
    data: bytes = b""
    exception: int = 0


def _to_c(message: Message) -> Any:
    if len(message.data) > lib.MD_MOST_DATA:
        raise ValueError(f"{len(message.data)} data bytes do not fit a frame: {lib.MD_MOST_DATA} at most")
    return ffi.new(
        "struct md_message *",
        {
            "address": message.address,
            "function": message.function,
            "exception": message.exception,
            "start": message.start,
            "count": message.count,
            "data_len": len(message.data),
            "data": list(message.data),
        },
    )


def _from_c(found: Any) -> Message:
    return Message(
        found.address,
        found.function,
        found.start,
        found.count,
        bytes(ffi.buffer(found.data, found.data_len)),
        found.exception,
    )


def _build(build: Any, framing: Framing, message: Message) -> bytes:
    room = lib.MD_MOST_FRAME
    out = ffi.new("uint8_t[]", room)
    length = build(framing, _to_c(message), out, room)
    if length < 0:
        raise ValueError(f"no {framing} frame can say {message}")
    return bytes(ffi.buffer(out, length))


def build_request(framing: Framing, message: Message) -> bytes:
    """The frame of a request; ValueError when a field is out of bounds."""
    return _build(lib.md_build_request, framing, message)


def build_reply(framing: Framing, message: Message) -> bytes:
    """The frame of a reply, for the drive's side; ValueError when a field is out of bounds."""
    return _build(lib.md_build_reply, framing, message)


def parse_request(framing: Framing, received: bytes) -> tuple[int, Message | None]:
    """The request at the beginning of `received`: bytes consumed, 0 or a Result, and its meaning."""
    found = ffi.new("struct md_message *")
    used = lib.md_parse_request(framing, received, len(received), found)
    return used, _from_c(found) if used > 0 else None


def parse_reply(framing: Framing, received: bytes, request: Message) -> tuple[int, Message | None]:
    """The reply to `request` at the beginning of `received`: as parse_request."""
    found = ffi.new("struct md_message *")
    used = lib.md_parse_reply(framing, received, len(received), _to_c(request), found)
    return used, _from_c(found) if used > 0 else None


def reply_length(framing: Framing, request: Message) -> int:
    """Length in bytes of the good reply to `request`; 0 after a broadcast."""
    return int(lib.md_reply_length(framing, _to_c(request)))


def raw_value(data: bytes, at: int, wire: Wire) -> float:
    """The number at word (BIT: bit) `at` of a reply's data; NaN where the data ends before it."""
    return float(lib.md_value(data, len(data), at, wire))


def get_settings(fd: int) -> tuple[int, str]:
    """Baud rate and format in force on a port; OSError where it has none."""
    settings = ffi.new("struct md_settings *")
    failure = lib.md_port_get(fd, settings)
    if failure:
        raise OSError(-failure, "no serial settings")
    return settings.baudrate, f"{settings.databits}{settings.parity.decode()}{settings.stopbits}"


def set_settings(fd: int, baudrate: int, format: str) -> int:
    """Make a port raw with these settings; the mask of what it did not take. OSError where it has none."""
    refused = lib.md_port_set(fd, ffi.new("struct md_settings *", _settings(baudrate, format)))
    if refused < 0:
        raise OSError(-refused, "no serial settings")
    return int(refused)


def _settings(baudrate: int, format: str) -> dict[str, object]:
    return {
        "baudrate": baudrate,
        "databits": int(format[0]),
        "parity": format[1].encode(),
        "stopbits": int(format[2]),
    }


REFUSALS = {
    lib.MD_REFUSED_BAUDRATE: "baud rate",
    lib.MD_REFUSED_DATABITS: "data bits",
    lib.MD_REFUSED_PARITY: "parity",
    lib.MD_REFUSED_STOPBITS: "stop bits",
}


class Respondent:
    """What is known of a drive as one who answers (struct md_drive): shared by all its exchanges.

    `least_timeout` and `most_timeout`, in s, bound the time-out, which runs from the request's last
    bit to the reply's first; between them it is learnt from the drive's own response delays.
    """

    def __init__(self, *, least_timeout: float, most_timeout: float) -> None:
        self.c = ffi.new(
            "struct md_drive *",
            {"least_timeout_ns": round(least_timeout * 1e9), "most_timeout_ns": round(most_timeout * 1e9)},
        )

    @property
    def failures(self) -> int:
        """Exchanges in a row without an answer."""
        return int(self.c.failures)

    @property
    def late_until_ns(self) -> int:
        """So long the answer to an earlier request may still come."""
        return int(self.c.late_until_ns)

    @property
    def response_delay(self) -> float:
        """In s, smoothed; 0 before the first reply."""
        return float(self.c.delay_ns) / 1e9

    def tally(self) -> Tally:
        """What became of its exchanges so far."""
        found = self.c.tally
        return Tally(
            found.exchanges,
            found.answered,
            found.values,
            found.exceptions,
            found.late,
            found.stray_bytes,
            found.ideal_ns,
            {Result(-code): count for code, count in enumerate(found.missed) if count},
        )


class Tally(NamedTuple):
    """What became of a drive's exchanges, by number (struct md_tally)."""

    exchanges: int
    answered: int
    values: int
    exceptions: int  # values that the drive refused
    late: int
    stray_bytes: int
    ideal_ns: int
    missed: dict[Result, int]  # values, by reason


class Exchange:
    """One request and all that is needed to carry it out; made once, run as often as wanted.

    Times are in seconds: `character` of one character, `silence` before the request and after
    its reply, `turnaround` after a broadcast. `block` is what rows are made of.
    """

    __slots__ = ("block", "c", "framing", "request", "respondent", "settings")

    def __init__(
        self,
        framing: Framing,
        request: Message,
        respondent: Respondent,
        *,
        baudrate: int,
        format: str,
        character: float,
        silence: float,
        turnaround: float = 0.1,
        block: Block | None = None,
    ) -> None:
        build_request(framing, request)  # raises for what no frame can say
        self.framing = framing
        self.request = request
        self.respondent = respondent
        self.block = block
        self.settings = (baudrate, format)
        self.c = ffi.new(
            "struct md_exchange *",
            {
                "framing": framing,
                "request": _to_c(request)[0],
                "settings": _settings(baudrate, format),
                "character_ns": round(character * 1e9),
                "silence_ns": round(silence * 1e9),
                "turnaround_ns": round(turnaround * 1e9),
                "drive": respondent.c,
                "block": block.c if block else ffi.NULL,
            },
        )


@dataclass(frozen=True)
class Completion:
    """What became of an exchange (struct md_completion). Times are CLOCK_MONOTONIC, in ns."""

    result: int
    error: int
    begun_ns: int
    sent_ns: int
    first_ns: int
    last_ns: int
    stale: int
    skipped: int
    reply: Message
    raw: bytes

    @property
    def status(self) -> int:
        """As a column has it: 0, the reason's number, or EXCEPTION_STATUS + exception code."""
        if self.result <= 0:
            return -self.result
        return EXCEPTION_STATUS + self.reply.exception if self.reply.exception else 0


def new_completion() -> Any:
    """The core's own memory for what becomes of one exchange (struct md_completion)."""
    return ffi.new("struct md_completion *")


def completion(found: Any) -> Completion:
    """What the core's memory says."""
    return Completion(
        found.result,
        found.error,
        found.begun_ns,
        found.sent_ns,
        found.first_ns,
        found.last_ns,
        found.stale,
        found.skipped,
        _from_c(found.reply),
        bytes(ffi.buffer(found.raw, found.raw_len)),
    )


class _Engine:
    """The core's thread, started when the first port is opened; there is one in a process."""

    def __init__(self) -> None:
        self.c = lib.md_engine_start()
        if self.c == ffi.NULL:
            raise OSError(ffi.errno, "the core's thread cannot be started")


@cache
def _engine() -> _Engine:
    return _Engine()


def notice_fd() -> int:
    """A descriptor that is readable when a port wants more exchanges; one client reads it empty."""
    return int(lib.md_engine_notice(_engine().c))


class Port:
    """A line driven on a descriptor by the core's thread (struct md_port).

    `must_take` is the mask of REFUSALS that are failures; -1 for a port without settings. `room` is
    how many exchanges may be queued, a power of two. OSError where the descriptor cannot be waited for.
    """

    def __init__(self, fd: int, must_take: int, room: int = 256) -> None:
        self.c = lib.md_port_open(_engine().c, fd, must_take, room)
        if self.c == ffi.NULL:
            raise OSError(ffi.errno, "the port cannot be waited for")
        self.room = room
        # Read in place: a call of the core would let go of the interpreter, and wait to have it back.
        self._progress = lib.md_port_progress(self.c)
        self._stopped = False
        self._respondents: set[Respondent] = set()

    def stop(self) -> None:
        """Nothing more is carried out, and the descriptor is the caller's; what was can be reaped."""
        if not self._stopped:
            lib.md_port_stop(self.c)
            self._stopped = True

    def close(self) -> None:
        """Stop, and forget what was not reaped."""
        self.stop()
        lib.md_port_free(self.c)
        self.c = self._progress = None

    def submit(self, exchanges: Sequence[Exchange], not_before_ns: Sequence[int]) -> int:
        """Queue exchanges, none to be sent before its time; how many there was room for."""
        todo = ffi.new("struct md_exchange *[]", [exchange.c for exchange in exchanges])
        times = ffi.new("int64_t[]", not_before_ns)
        return int(lib.md_port_submit(self.c, todo, times, len(exchanges)))

    @property
    def pending(self) -> int:
        """How many queued exchanges are not carried out yet."""
        return int(self._progress.submitted - self._progress.done) & 0xFFFF_FFFF

    @property
    def lost(self) -> bool:
        """The descriptor failed, and nothing more is carried out on it."""
        return bool(self._progress.lost)

    def reap(self, columns: Columns, utc_minus_monotonic_ns: int) -> int:
        """Make rows of what was carried out; how many exchanges, fewer when the columns are full."""
        return int(lib.md_port_reap(self.c, columns.c, utc_minus_monotonic_ns))

    def carry_out(self, exchange: Exchange, *, not_before_ns: int = 0, expires_ns: int = 0) -> Completion:
        """Carry one out ahead of the queue and wait for it; after `expires_ns` it is not sent."""
        self._respondents.add(exchange.respondent)  # the core still looks at it when a late answer comes
        found = ffi.new("struct md_completion *")
        lib.md_port_carry_out(self.c, exchange.c, not_before_ns, expires_ns, found)
        return completion(found)


class Field(NamedTuple):
    """Where a register lies in a block's reply, its scale, and the codes of its names."""

    at: int
    wire: Wire
    drive: int
    register: int
    multiplier: float
    divisor: float


class Block:
    """The fields that one exchange's reply holds (struct md_block)."""

    def __init__(self, fields: Sequence[Field]) -> None:
        self._fields = ffi.new("struct md_field[]", [tuple(field) for field in fields])
        self.c = ffi.new("struct md_block *", {"fields": self._fields, "count": len(fields)})
        self.count = len(fields)

    @property
    def refusals(self) -> int:
        """Exceptions in a row, among the replies that were made rows of."""
        return int(self.c.refusals)


COLUMNS = {
    "time": "int64_t[]",
    "sent": "int64_t[]",
    "uncertainty": "int64_t[]",
    "drive": "uint16_t[]",
    "reg": "uint16_t[]",
    "status": "uint16_t[]",
    "value": "double[]",
}
_ITEMS: dict[str, tuple[int, Literal["q", "H", "d"]]] = {
    "int64_t[]": (8, "q"),
    "uint16_t[]": (2, "H"),
    "double[]": (8, "d"),
}


class Columns:
    """Rows in the core's own memory: one array a column (struct md_columns)."""

    def __init__(self, room: int) -> None:
        self._arrays = {name: ffi.new(kind, room) for name, kind in COLUMNS.items()}
        self._arrays["valid"] = ffi.new("uint8_t[]", (room + 7) // 8)
        self.c = ffi.new("struct md_columns *", {**self._arrays, "rows": 0, "room": room})

    def __len__(self) -> int:
        return int(self.c.rows)

    def add(self, block: Block, found: Any, utc_minus_monotonic_ns: int) -> bool:
        """Append the rows of one struct md_completion; False when there is no room for all of them."""
        return bool(lib.md_columns_add(self.c, block.c, found, utc_minus_monotonic_ns))

    def add_miss(self, block: Block, result: Result, due_ns: int, utc_minus_monotonic_ns: int) -> bool:
        """Append rows for values that were due at `due_ns` but never asked for."""
        missed = ffi.new("struct md_completion *", {"result": result, "sent_ns": due_ns})
        return bool(lib.md_columns_add(self.c, block.c, missed, utc_minus_monotonic_ns))

    def clear(self) -> None:
        """Forget all rows."""
        self.c.rows = 0

    def array(self, name: str) -> memoryview[Any]:
        """A column's numbers, without a copy; `valid` is a bitmap, least significant bit first."""
        rows = len(self)
        if name == "valid":
            return memoryview(ffi.buffer(self._arrays[name], (rows + 7) // 8))
        size, kind = _ITEMS[COLUMNS[name]]
        return memoryview(ffi.buffer(self._arrays[name], rows * size)).cast(kind)


@lru_cache(maxsize=64)
def _spelling(names: tuple[str, ...]) -> tuple[bytes, Any, int]:
    """All names as one text, where each begins and the last ends, and the longest one's length."""
    encoded = [name.encode() for name in names]
    ends = [0, *accumulate(map(len, encoded))]
    return b"".join(encoded), ffi.new("int32_t[]", ends), max(map(len, encoded), default=0)


def spell(codes: memoryview[Any], names: tuple[str, ...]) -> tuple[memoryview[Any], memoryview[Any]]:
    """Offsets (int32) and text of an Arrow utf8 column that has names[code] for each of `codes`."""
    known, ends, longest = _spelling(names)
    rows = len(codes)
    room = rows * longest
    offsets, text = ffi.new("int32_t[]", rows + 1), ffi.new("uint8_t[]", max(room, 1))
    used = lib.md_spell(
        ffi.from_buffer("uint16_t[]", codes), rows, known, ends, len(names), offsets, text, room
    )
    if used < 0:
        raise ValueError("a code without a name, or more than 2 GiB of names in one batch")
    return memoryview(ffi.buffer(offsets)).cast("i"), memoryview(ffi.buffer(text, used))


# ---- what was overheard ----


class Side(IntEnum):
    """Who sent what was overheard, where that is known."""

    EITHER = lib.MD_EITHER_SIDE
    ASKING = lib.MD_ASKING
    ANSWERING = lib.MD_ANSWERING


class Kind(IntEnum):
    """What a span of overheard bytes is (enum md_kind)."""

    JUNK = lib.MD_JUNK
    REQUEST = lib.MD_REQUEST
    EITHER = lib.MD_EITHER  # a request, or its copy that confirms it
    REPLY = lib.MD_REPLY
    STRAY = lib.MD_STRAY  # a reply whose request was not heard


class Span(NamedTuple):
    """Overheard bytes that belong together; `message` and `framing` mean nothing of junk."""

    kind: Kind
    framing: Framing
    time_ns: int
    message: Message
    raw: bytes


HEARD_ROOM = 1 << 20
_MOST_PIECES = 1 << 15


class Heard:
    """Bytes of one line in the pieces in which they came (struct md_heard)."""

    def __init__(self, place: Any = None) -> None:
        self.c = ffi.new("struct md_heard *") if place is None else place
        self._bytes = ffi.new("uint8_t[]", HEARD_ROOM)
        self._pieces = ffi.new("struct md_piece[]", _MOST_PIECES)
        self.c.bytes, self.c.room = self._bytes, HEARD_ROOM
        self.c.pieces, self.c.most = self._pieces, _MOST_PIECES

    def put(
        self, received: bytes, time_ns: int, *, side: Side = Side.EITHER, after_pause: bool = False
    ) -> None:
        """Append what came at this time; after a pause it is a hint where frames begin."""
        piece = {"time_ns": time_ns, "side": side, "is_after_pause": after_pause}
        if not lib.md_hear(self.c, received, len(received), ffi.new("struct md_piece *", piece)[0]):
            raise BufferError("more was heard than fits: split it first")

    def end(self, is_end: bool) -> None:
        """Whether nothing more is to be waited for, as when the line has long been silent."""
        self.c.is_all = is_end


class Splitter:
    """Cuts what was heard into spans (struct md_splitter)."""

    def __init__(self) -> None:
        self._c = ffi.new("struct md_splitter *")
        self._span = ffi.new("struct md_span *")

    def spans(self, heard: Heard) -> Iterator[Span]:
        """All that is understood so far; then it is forgotten. Every byte is part of one span."""
        span = self._span
        while lib.md_split(self._c, heard.c, span):
            raw = bytes(ffi.buffer(heard.c.bytes + span.at, span.len))
            yield Span(Kind(span.kind), Framing(span.framing), span.time_ns, _from_c(span.message), raw)
        lib.md_forget(heard.c, self._c)


class Decoder:
    """Makes rows of the exchanges that were heard on one line (struct md_decoder)."""

    _PLACES = 1 << 14

    def __init__(self) -> None:
        self._c = ffi.new("struct md_decoder *")
        self.forget()

    def forget(self) -> None:
        """Know no request any more."""
        self._known = ffi.new("struct md_known[]", self._PLACES)
        self._blocks: list[Block] = []
        self._c.known, self._c.places, self._c.taken = self._known, self._PLACES, 0
        self._c.block = ffi.NULL

    @property
    def asked(self) -> tuple[Framing, Message]:
        """The request of which it is to be said what its reply holds."""
        return Framing(self._c.span.framing), _from_c(self._c.span.message)

    def know(self, block: Block | None) -> bool:
        """What the reply to `asked` holds, None: no rows; False when it knows too much already."""
        if block:
            self._blocks.append(block)
        c = block.c if block else ffi.NULL
        return bool(lib.md_know(self._c, self._c.span.framing, ffi.addressof(self._c.span, "message"), c))

    def decode(self, heard: Heard, columns: Columns) -> Decoded:
        """Make rows, and forget what they were made of."""
        done = Decoded(lib.md_decode(self._c, heard.c, columns.c))
        if done is Decoded.ALL:
            lib.md_forget(heard.c, ffi.addressof(self._c, "splitter"))
        return done

    def counts(self) -> dict[str, int]:
        """So far: frames, exchanges, replies without a request, bytes that are part of no frame."""
        c = self._c
        return {"frames": c.frames, "exchanges": c.exchanges, "strays": c.strays, "unknown_bytes": c.junk}


class Decoded(IntEnum):
    ALL = lib.MD_ALL_DECODED
    NO_ROOM = lib.MD_NO_ROOM
    UNKNOWN = lib.MD_UNKNOWN


class Unpacked(IntEnum):
    ALL = lib.MD_UNPACKED
    FULL = lib.MD_CHANNEL_FULL
    OTHER_BLOCK = lib.MD_OTHER_BLOCK
    CUT = lib.MD_CUT
    NONSENSE = lib.MD_NONSENSE


class Unpacker:
    """Takes packets out of a capture file's bytes (struct md_capture); `at` is how far it is."""

    MOST_CHANNELS = 64

    def __init__(self, capture: Any, at: int, *, is_pcapng: bool, is_big_endian: bool) -> None:
        self._bytes = ffi.from_buffer("uint8_t[]", capture)
        self._channels = ffi.new("struct md_channel[]", self.MOST_CHANNELS)
        self.heard: list[Heard] = []
        self._c = ffi.new(
            "struct md_capture *",
            {
                "bytes": self._bytes,
                "len": len(self._bytes),
                "at": at,
                "is_pcapng": is_pcapng,
                "is_big_endian": is_big_endian,
                "channels": self._channels,
            },
        )

    def close(self) -> None:
        ffi.release(self._bytes)

    @property
    def at(self) -> int:
        return int(self._c.at)

    @at.setter
    def at(self, at: int) -> None:
        self._c.at = at

    @property
    def packets(self) -> int:
        return int(self._c.packets)

    def add_channel(self, link: int, *, has_sides: bool, ticks_per_s: int, offset_ns: int) -> None:
        """The next interface of the file: its link type, whose sent what, and its clock."""
        channel = self._channels[self._c.count]
        channel.link, channel.has_sides = link, has_sides
        channel.ticks_per_s, channel.offset_ns = ticks_per_s, offset_ns
        self.heard.append(Heard(ffi.addressof(channel, "heard")))
        self._c.count += 1

    def unpack(self) -> Unpacked:
        """Append packets to what was heard on their channels, until something is to be done."""
        return Unpacked(lib.md_unpack(self._c))
