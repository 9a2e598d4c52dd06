"""Captures: write pcapng files that Wireshark decodes without configuration; read pcap and pcapng files.

A capture is read in pieces, because it may be larger than memory. It is not mapped into memory: a mapping
crashes the process if another program truncates the file.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from io import SEEK_END
from pathlib import Path
from typing import Self

from multidrop.core import Side, Stream, Unpacked, Unpacker, Wrappings
from multidrop.recording.format import AppendFile, RecordingError, writing

EXPORTED_PDU = 252
APPLICATION = b"multidrop"  # start of the application name in files that this library writes

SECTION, INTERFACE = 0x0A0D0D0A, 1
_END, _COMMENT = 0, 1
IF_NAME, IF_RESOLUTION = 2, 9
SHB_APPLICATION = 4
_EPB_FLAGS = 2
_NANOSECONDS = b"\x09"

_DISSECTOR, _IPV4_SOURCE, _IPV4_TARGET, _PORT_TYPE, _SOURCE_PORT, _TARGET_PORT = 12, 20, 21, 24, 25, 26
_TCP = 2


class CaptureWriter:
    """A new capture file; leaving the `with` block closes it. All methods raise RecordingError.

    `lines` are the names of the lines whose packets will be appended. Each packet is passed to the operating
    system immediately, so that a crash of the process loses no packet.
    """

    def __init__(self, path: Path | str, lines: Sequence[str] = (), comment: str = "") -> None:
        from importlib.metadata import version  # imported here because it is slow

        self.path = Path(path)
        self._lines: dict[str, int] = {}
        with writing(self.path):
            self._file = AppendFile(self.path)
        options = [(SHB_APPLICATION, APPLICATION + b" " + version("multidrop").encode())]
        if comment:
            options.insert(0, (_COMMENT, comment.encode()))
        head = struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1)
        try:
            self.append(_block(SECTION, head + _options(*options)))
            for line in lines:
                self._declare(line)
        except RecordingError:
            self.close()
            raise

    def write(self, raw: bytes, side: Side, time_ns: int, line: str) -> None:
        """Append bytes, such as a frame, that were on the line at `time_ns` (ns UTC)."""
        if line not in self._lines:
            self._declare(line)
        self.append(WRAPPINGS.packet(self._lines[line], side, time_ns, raw))

    def append(self, packets: bytes) -> None:
        """Append packets in pcapng format. A packet's interface number is an index into `lines`."""
        with writing(self.path):
            self._file.append(packets)

    def report(self, anomalies: list[str]) -> None:
        """Do nothing: a capture has all packets, with or without anomalies."""

    def _declare(self, line: str) -> None:
        self._lines[line] = len(self._lines)
        options = _options((IF_NAME, line.encode()), (IF_RESOLUTION, _NANOSECONDS))
        self.append(_block(INTERFACE, struct.pack("<HHI", EXPORTED_PDU, 0, 0) + options))

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def _padded(content: bytes) -> bytes:
    return content + bytes(-len(content) % 4)


def _block(kind: int, body: bytes) -> bytes:
    size = len(body) + 12
    return struct.pack("<II", kind, size) + body + struct.pack("<I", size)


def _options(*options: tuple[int, bytes]) -> bytes:
    return b"".join(
        struct.pack("<HH", code, len(value)) + _padded(value) for code, value in (*options, (_END, b""))
    )


def _tag(code: int, value: bytes) -> bytes:
    return struct.pack(">HH", code, len(_padded(value))) + _padded(value)


def _head(dissector: bytes, sender: tuple[bytes, int] | None, target: tuple[bytes, int]) -> bytes:
    """Return a packet's header, which names Wireshark's dissector, the sender and the receiver."""
    tags = _tag(_DISSECTOR, dissector)
    if sender:
        tags += _tag(_IPV4_SOURCE, sender[0]) + _tag(_IPV4_TARGET, target[0])
        for code, number in ((_PORT_TYPE, _TCP), (_SOURCE_PORT, sender[1]), (_TARGET_PORT, target[1])):
            tags += _tag(code, struct.pack(">I", number))
    return tags + _tag(_END, b"")


_RTU, _TCP_FRAME, _BYTES = b"mbrtu", b"mbtcp", b"data"  # names of Wireshark's dissectors
_MASTER, _DRIVE = (bytes([10, 0, 0, 1]), 50000), (bytes([10, 0, 0, 2]), 502)
_FAILED, _NOISE = (bytes([10, 0, 0, 2]), 1), (bytes([10, 0, 0, 3]), 2)
_OUTBOUND = (_EPB_FLAGS, struct.pack("<I", 2))
_INBOUND = (_EPB_FLAGS, struct.pack("<I", 1))
# how Wireshark shows bytes, by their origin: dissector, sender, receiver and packet options
_PACKETS = {
    Side.EITHER: (_BYTES, None, _MASTER, [(_COMMENT, b"no frame")]),
    Side.ASKING: (_RTU, _MASTER, _DRIVE, [_OUTBOUND]),
    Side.ANSWERING: (_RTU, _DRIVE, _MASTER, [_INBOUND]),
    Side.FAILED: (_RTU, _FAILED, _MASTER, [(_COMMENT, b"came in place of a reply"), _INBOUND]),
    Side.NOISE: (_BYTES, _NOISE, _MASTER, [(_COMMENT, b"part of no exchange"), _INBOUND]),
}


def _wrappings(binary: bytes, text: bytes) -> Wrappings:
    """Return the headers and options of a line's packets.

    Wireshark shows ASCII frames, which start with ':', with the dissector `text`. It shows all other frames
    with the dissector `binary`.
    """
    return Wrappings(
        {
            (side, is_text): (
                _head((text if is_text else binary) if dissector == _RTU else dissector, sender, target),
                _options(*options),
            )
            for side, (dissector, sender, target, options) in _PACKETS.items()
            for is_text in (False, True)
        }
    )


WRAPPINGS = _wrappings(_RTU, _BYTES)
TCP_WRAPPINGS = _wrappings(_TCP_FRAME, _TCP_FRAME)  # for tcp:// ports, which have no ASCII frames


# ---- reading ----


_OLD_PACKET, _SIMPLE_PACKET = 2, 3
_IF_OFFSET = 14
_BINARY, _MOST_DIGITS, _MOST_BITS = 0x80, 9, 32
# limit of an interface's time offset in s, because times in ns since 1970 must fit into 64 bits
_MOST_OFFSET = 1 << 33
_PCAP = {  # a file's first four bytes: (is big-endian, clock ticks per second)
    b"\xd4\xc3\xb2\xa1": (False, 10**6),
    b"\xa1\xb2\xc3\xd4": (True, 10**6),
    b"\x4d\x3c\xb2\xa1": (False, 10**9),
    b"\xa1\xb2\x3c\x4d": (True, 10**9),
}
_PCAP_HEADER, _PCAPNG_HEADER = 24, 28
_PIECE = 1 << 20  # bytes read at a time, many times the largest packet
_NO_SERIAL_LINE = {1: "Ethernet", 101: "IP", 105: "Wi-Fi", 113: "Linux cooked", 189: "USB", 220: "USB"}


class CaptureError(ValueError):
    """Raised for a file that is not a capture, or is damaged; the message has the damage's position."""


class Capture:
    """A reader of a capture file; leaving the `with` block closes it. Raises CaptureError and OSError.

    `lines` has the name of every interface found so far, and `streams` the bytes of each. `truncated` is the
    number of bytes of an incomplete packet at the file's end: its writer was killed, or the disk was full.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.lines: list[str] = []
        self.truncated = 0
        self._is_ours = False
        self._file = self.path.open("rb", buffering=0)
        self._order = "<"
        self._unpacker: Unpacker  # set by `_begin`, which raises otherwise
        try:
            self._begin()
        except BaseException:
            self.close()
            raise

    @property
    def streams(self) -> list[Stream]:
        return self._unpacker.streams

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _begin(self) -> None:
        if not self._file.seekable():  # the path is a serial port or a pipe
            raise CaptureError(f"{self.path} is not a capture: it is not a regular file")
        # bytes that are appended later are not read
        self._size = self._file.seek(0, SEEK_END)
        if not self._size:
            raise CaptureError(f"{self.path} is not a capture: it is empty")
        magic = self._piece(0, 4)
        if magic in _PCAP:
            if self._size < _PCAP_HEADER:
                raise CaptureError(f"{self.path} is not a capture: it ends within its header")
            is_big_endian, ticks_per_s = _PCAP[magic]
            self._order = ">" if is_big_endian else "<"
            self._unpacker = Unpacker(_PCAP_HEADER, is_pcapng=False, is_big_endian=is_big_endian)
            link = self._read("I", 20)
            self._add(link & 0xFFFF, self.path.stem, ticks_per_s, 0)
        elif magic == struct.pack("<I", SECTION):
            if self._size < _PCAPNG_HEADER:
                raise CaptureError(f"{self.path} is not a capture: it ends within its header")
            self._order = self._order_at(0)
            self._unpacker = Unpacker(0, is_pcapng=True, is_big_endian=self._order == ">")
        else:
            raise CaptureError(f"{self.path} is not a capture: it does not start like a pcap or pcapng file")

    def __iter__(self) -> Iterator[None]:
        """Fill `streams` from the file. At each yield the caller must empty them."""
        unpacker = self._unpacker
        seen = unpacker.at  # position in the file after the last byte read so far
        while True:
            state = unpacker.unpack()
            if state is Unpacked.NONSENSE:
                raise self._damaged(unpacker.at)
            if state is Unpacked.OTHER_BLOCK:
                if not self._read_block():
                    break
            elif state is Unpacked.FULL:
                yield
            elif seen < self._size:
                piece = self._piece(unpacker.at, _PIECE)
                seen = unpacker.at + len(piece)
                unpacker.look_at(piece, unpacker.at)
            else:
                break
        self.truncated = self._size - unpacker.at
        for stream in self.streams:
            stream.end(True)
        yield

    def _piece(self, at: int, most: int) -> bytes:
        """Return at most `most` bytes of the file, starting at position `at`."""
        self._file.seek(at)
        piece = self._file.read(most)
        if len(piece) < min(most, self._size - at):
            raise CaptureError(
                f"{self.path} became shorter while it was read: it had {self._size} bytes, and now ends at "
                f"byte {at + len(piece)}"
            )
        return piece

    def _read_block(self) -> bool:
        """Read a block other than an enhanced packet; return False if the file ends within it."""
        at = self._unpacker.at
        kind = self._read("I", at)
        if kind == SECTION and self._size - at >= _PCAPNG_HEADER and self._order_at(at) != self._order:
            raise CaptureError(
                f"{self.path}: byte {at}: a section has another byte order than the first one; such a file "
                f"cannot be read"
            )
        size = self._read("I", at + 4)
        if size < 12 or size % 4:
            raise self._damaged(at)
        if at + size > self._size:
            return False
        body = self._piece(at + 8, min(size - 12, _PIECE)) if kind in (SECTION, INTERFACE) else b""
        if kind == SECTION:
            if at and self.lines:
                raise CaptureError(
                    f"{self.path}: byte {at}: a second section starts here, and only the first one can be "
                    f"read"
                )
            self._is_ours = dict(self._options(body[16:])).get(SHB_APPLICATION, b"").startswith(APPLICATION)
        elif kind == INTERFACE:
            self._read_interface(body, at)
        elif kind in (_SIMPLE_PACKET, _OLD_PACKET):
            raise CaptureError(
                f"{self.path}: byte {at}: simple and obsolete packet blocks cannot be read; `editcap` "
                f"converts them to enhanced packet blocks"
            )
        self._unpacker.at = at + size
        return True

    def _read_interface(self, body: bytes, at: int) -> None:
        if len(body) < 8:
            raise self._damaged(at)
        options = dict(self._options(body[8:]))
        resolution = (options.get(IF_RESOLUTION) or b"\x06")[0]
        power = resolution & ~_BINARY
        if power > (_MOST_BITS if resolution & _BINARY else _MOST_DIGITS):
            raise CaptureError(f"{self.path}: byte {at}: time stamps finer than a nanosecond cannot be read")
        ticks_per_s = 2**power if resolution & _BINARY else 10**power
        offset = options.get(_IF_OFFSET, bytes(8))
        seconds: int = struct.unpack(f"{self._order}q", offset)[0] if len(offset) == 8 else 0
        if abs(seconds) > _MOST_OFFSET:
            raise CaptureError(f"{self.path}: byte {at}: the time offset of {seconds} s is too large")
        name = options.get(IF_NAME, b"").rstrip(b"\0").decode(errors="replace")
        link: int = struct.unpack_from(f"{self._order}H", body)[0]
        self._add(link, name or f"{self.path.stem}-{len(self.lines)}", ticks_per_s, seconds * 10**9)

    def _add(self, link: int, name: str, ticks_per_s: int, offset_ns: int) -> None:
        if link in _NO_SERIAL_LINE:
            raise CaptureError(
                f"{self.path}: {name} is {_NO_SERIAL_LINE[link]} (link type {link}), not a serial line"
            )
        if len(self.lines) == Unpacker.MOST_CHANNELS:
            raise CaptureError(f"{self.path}: more than {Unpacker.MOST_CHANNELS} interfaces")
        self.lines.append(name)
        self._unpacker.add_channel(
            link, has_sides=self._is_ours, ticks_per_s=ticks_per_s, offset_ns=offset_ns
        )

    def _options(self, options: bytes) -> Iterator[tuple[int, bytes]]:
        at = 0
        while at + 4 <= len(options):
            code, size = struct.unpack_from(f"{self._order}HH", options, at)
            if code == 0:
                return
            yield code, options[at + 4 : at + 4 + size]
            at += 4 + size + -size % 4

    def _order_at(self, at: int) -> str:
        """Return the byte order ("<" or ">") of the pcapng section that starts at position `at`."""
        magic = self._piece(at + 8, 4)
        if magic not in (b"\x1a\x2b\x3c\x4d", b"\x4d\x3c\x2b\x1a"):
            raise self._damaged(at)
        return ">" if magic == b"\x1a\x2b\x3c\x4d" else "<"

    def _read(self, format: str, at: int) -> int:
        number: int = struct.unpack(self._order + format, self._piece(at, 4))[0]
        return number

    def _damaged(self, at: int) -> CaptureError:
        return CaptureError(f"{self.path} is damaged: at byte {at} a packet should start")
