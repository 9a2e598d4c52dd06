"""Capture the bytes on a line, cut them into frames, and decode the frames into rows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from enum import IntEnum
from typing import Any, NamedTuple

from multidrop._core import ffi, lib
from multidrop.core.columns import Columns, RowLayout
from multidrop.core.frame import Framing, Message, from_c


class Side(IntEnum):
    """The sender of captured bytes; FAILED and NOISE mark bytes that are not a frame (enum md_side)."""

    EITHER = lib.MD_EITHER_SIDE  # unknown
    ASKING = lib.MD_ASKING
    ANSWERING = lib.MD_ANSWERING
    FAILED = lib.MD_FAILED  # bytes that came instead of a good reply, as marked by the capturing master
    NOISE = lib.MD_NOISE  # stray bytes, echoes and late replies, as marked by the capturing master


class Kind(IntEnum):
    """What a run of sniffed bytes is: a request, a reply or junk (enum md_kind)."""

    JUNK = lib.MD_JUNK
    REQUEST = lib.MD_REQUEST
    EITHER = lib.MD_EITHER  # a request, or a reply that is a copy of its request
    REPLY = lib.MD_REPLY
    STRAY = lib.MD_STRAY  # a reply whose request was not captured


class FrameSpan(NamedTuple):
    """A frame, or junk bytes between frames; for junk, `message` and `framing` are invalid."""

    kind: Kind
    framing: Framing
    time_ns: int
    message: Message
    raw: bytes


STREAM_ROOM = 1 << 20
_MOST_PIECES = 1 << 15


class Stream:
    """The bytes captured on one line, with the time and sender of each piece (struct md_stream)."""

    def __init__(self, place: Any = None) -> None:
        self.c = ffi.new("struct md_stream *") if place is None else place
        self._bytes = ffi.new("uint8_t[]", STREAM_ROOM)
        self._pieces = ffi.new("struct md_piece[]", _MOST_PIECES)
        self.c.bytes, self.c.room = self._bytes, STREAM_ROOM
        self.c.pieces, self.c.most = self._pieces, _MOST_PIECES

    def put(
        self, received: bytes, time_ns: int, *, side: Side = Side.EITHER, after_pause: bool = False
    ) -> None:
        """Append bytes received at `time_ns`. If `after_pause` is True, a frame probably starts here."""
        piece = {"time_ns": time_ns, "side": side, "is_after_pause": after_pause}
        if not lib.md_stream_put(self.c, received, len(received), ffi.new("struct md_piece *", piece)[0]):
            raise BufferError("the stream is full: take its frames with Splitter.spans first")

    def end(self, is_end: bool) -> None:
        """Set whether the stream is complete; if it is, an incomplete frame at its end becomes junk."""
        self.c.is_all = is_end


class Splitter:
    """Cuts a stream into frames and junk between frames, called spans (struct md_splitter)."""

    def __init__(self) -> None:
        self._c = ffi.new("struct md_splitter *")
        self._span = ffi.new("struct md_span *")

    def spans(self, stream: Stream) -> Iterator[FrameSpan]:
        """Yield all complete spans, and remove their bytes from the stream. Every byte is part of a span."""
        span = self._span
        while lib.md_split(self._c, stream.c, span):
            raw = bytes(ffi.buffer(stream.c.bytes + span.at, span.len))
            yield FrameSpan(Kind(span.kind), Framing(span.framing), span.time_ns, from_c(span.message), raw)
        lib.md_stream_forget(stream.c, self._c)


class Decoder:
    """Decodes the exchanges sniffed on one line into rows (struct md_decoder)."""

    _PLACES = 1 << 14

    def __init__(self) -> None:
        self._c = ffi.new("struct md_decoder *")
        self._known = ffi.new("struct md_known[]", self._PLACES)
        self._blocks: list[RowLayout] = []
        self._c.known, self._c.places = self._known, self._PLACES

    def forget(self) -> None:
        """Forget all requests and the layouts of their replies."""
        self._c.block = ffi.NULL
        ffi.buffer(self._known)[:] = bytes(ffi.sizeof(self._known))
        self._c.taken = 0
        self._blocks.clear()  # cleared last: until `known` is reset, the C core uses these layouts

    @property
    def asked(self) -> tuple[Framing, Message]:
        """The framing and content of the request at which `decode` stopped with UNKNOWN.

        Call `know` with its layout, then `decode` again.
        """
        return Framing(self._c.span.framing), from_c(self._c.span.message)

    def know(self, block: RowLayout | None) -> bool:
        """Store the layout of the replies to the request that `asked` returns.

        Replies without a layout (None) make no rows. Return False if the table of layouts is full.
        """
        if block:
            self._blocks.append(block)
        c = block.c if block else ffi.NULL
        return bool(lib.md_know(self._c, self._c.span.framing, ffi.addressof(self._c.span, "message"), c))

    def decode(self, stream: Stream, columns: Columns) -> Decoded:
        """Append the stream's rows to `columns`; discard the stream's bytes once all are decoded."""
        done = Decoded(lib.md_decode(self._c, stream.c, columns.c))
        if done is Decoded.ALL:
            lib.md_stream_forget(stream.c, ffi.addressof(self._c, "splitter"))
        return done

    def counts(self) -> dict[str, int]:
        """Return the numbers of frames, exchanges, replies without a request, and bytes outside frames."""
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
    """Reads packets from the bytes of a capture file (struct md_capture).

    `at` is the position in the file of the next byte to read.
    """

    MOST_CHANNELS = 64

    def __init__(self, at: int, *, is_pcapng: bool, is_big_endian: bool) -> None:
        self._channels = ffi.new("struct md_channel[]", self.MOST_CHANNELS)
        self.streams: list[Stream] = []
        self._c = ffi.new(
            "struct md_capture *",
            {"is_pcapng": is_pcapng, "is_big_endian": is_big_endian, "channels": self._channels},
        )
        self.look_at(b"", at)

    def look_at(self, piece: bytes, at: int) -> None:
        """Continue with this piece of the file, which starts at byte `at` of the file."""
        # the next assignment frees the previous piece, so first the struct is emptied
        self._c.len = self._c.at = 0
        self._piece, self._begin = ffi.from_buffer("uint8_t[]", piece), at
        self._c.bytes, self._c.len = self._piece, len(piece)

    @property
    def at(self) -> int:
        return self._begin + int(self._c.at)

    @at.setter
    def at(self, at: int) -> None:
        self._c.at = at - self._begin

    def add_channel(self, link: int, *, has_sides: bool, ticks_per_s: int, offset_ns: int) -> None:
        """Add the capture file's next interface: one recorded line.

        `has_sides` is True if each packet states which side sent it.
        """
        channel = self._channels[self._c.count]
        channel.link, channel.has_sides = link, has_sides
        channel.ticks_per_s, channel.offset_ns = ticks_per_s, offset_ns
        self.streams.append(Stream(ffi.addressof(channel, "stream")))
        self._c.count += 1

    def unpack(self) -> Unpacked:
        """Append packets to the streams of their channels; return why unpacking stopped."""
        return Unpacked(lib.md_unpack(self._c))


_RING = 1 << 18  # size of the ring in bytes; enough for some seconds of a fast line
_TAKEN = 1 << 16  # limit of the bytes read from the ring in one call


class Wrappings:
    """Headers and trailers of a capture file's packets.

    Each key of `wrappings` is a pair: the sender of a frame, and True if the frame starts with ':'.
    """

    def __init__(self, wrappings: Mapping[tuple[Side, bool], tuple[bytes, bytes]]) -> None:
        self._kept: list[Any] = []
        self.c = ffi.new("struct md_wrapping[]", 2 * lib.MD_SIDES)
        for (side, is_text), (head, tail) in wrappings.items():
            place = self.c[2 * side + is_text]
            place.head, place.head_len = self._keep(head), len(head)
            place.tail, place.tail_len = self._keep(tail), len(tail)

    def _keep(self, content: bytes) -> Any:
        self._kept.append(ffi.new("uint8_t[]", content))
        return self._kept[-1]

    def packet(self, interface: int, side: Side, time_ns: int, raw: bytes) -> bytes:
        """Return a packet of the capture file: a header, these bytes of a line, and a trailer."""
        length = lib.md_packet_length(self.c, side, raw[0] if raw else 0, len(raw))
        out = ffi.new("uint8_t[]", length)
        lib.md_put_packet(self.c, interface, side, time_ns, raw, len(raw), out)
        return bytes(ffi.buffer(out, length))


class Tap:
    """A ring buffer of all bytes on one line (struct md_tap), to be read as packets of a pcapng file."""

    def __init__(self) -> None:
        self._ring = ffi.new("uint8_t[]", _RING)
        self.c = ffi.new("struct md_tap *", {"ring": self._ring, "room": _RING})
        self._out: Any = None

    @property
    def lost(self) -> int:
        """Number of bytes that were lost because the ring buffer was full."""
        return int(self.c.lost)

    def take(self, wrappings: Wrappings, interface: int, utc_minus_monotonic_ns: int) -> Iterator[bytes]:
        """Yield all bytes of the ring as pcapng packets of this interface, many packets at a time."""
        if self.c.put == self.c.taken:
            return
        out = self._out = self._out or ffi.new("uint8_t[]", _TAKEN)
        while used := lib.md_tap_take(self.c, wrappings.c, interface, utc_minus_monotonic_ns, out, _TAKEN):
            yield bytes(ffi.buffer(out, used))
