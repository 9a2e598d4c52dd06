"""Write captures: pcapng files in which Wireshark decodes Modbus RTU and TCP without configuration."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Self

from multidrop.core import Side, Wrappings
from multidrop.recording.format import AppendFile, RecordingError, writing

EXPORTED_PDU = 252
APPLICATION = b"multidrop"  # start of the application name in captures of this library

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
        from importlib.metadata import version  # imported here: it is slow, and few commands write captures

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
        """Append packets that are already in pcapng format; interface n is the n-th of `lines`."""
        with writing(self.path):
            self._file.append(packets)

    def report(self, anomalies: list[str]) -> None:
        """Ignore anomalies: a capture has all packets anyway."""

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
    """Return the header of a packet: Wireshark's dissector for its bytes, their sender and receiver."""
    tags = _tag(_DISSECTOR, dissector)
    if sender:
        tags += _tag(_IPV4_SOURCE, sender[0]) + _tag(_IPV4_TARGET, target[0])
        for code, number in ((_PORT_TYPE, _TCP), (_SOURCE_PORT, sender[1]), (_TARGET_PORT, target[1])):
            tags += _tag(code, struct.pack(">I", number))
    return tags + _tag(_END, b"")


_RTU, _TCP_FRAME, _BYTES = b"mbrtu", b"mbtcp", b"data"  # Wireshark's dissectors
_MASTER, _DRIVE = (bytes([10, 0, 0, 1]), 50000), (bytes([10, 0, 0, 2]), 502)
_FAILED, _NOISE = (bytes([10, 0, 0, 2]), 1), (bytes([10, 0, 0, 3]), 2)
_OUTBOUND = (_EPB_FLAGS, struct.pack("<I", 2))
_INBOUND = (_EPB_FLAGS, struct.pack("<I", 1))
_PACKETS = {  # side: dissector of binary frames, sender, receiver, packet options
    Side.EITHER: (_BYTES, None, _MASTER, [(_COMMENT, b"no frame")]),
    Side.ASKING: (_RTU, _MASTER, _DRIVE, [_OUTBOUND]),
    Side.ANSWERING: (_RTU, _DRIVE, _MASTER, [_INBOUND]),
    Side.FAILED: (_RTU, _FAILED, _MASTER, [(_COMMENT, b"came in place of a reply"), _INBOUND]),
    Side.NOISE: (_BYTES, _NOISE, _MASTER, [(_COMMENT, b"part of no exchange"), _INBOUND]),
}


def _wrappings(frames: bytes, texts: bytes) -> Wrappings:
    """Return the headers and options of a line's packets.

    `frames` is the dissector for frames, and `texts` for frames that start with ':' as ASCII frames do."""
    return Wrappings(
        {
            (side, is_text): (
                _head((texts if is_text else frames) if dissector == _RTU else dissector, sender, target),
                _options(*options),
            )
            for side, (dissector, sender, target, options) in _PACKETS.items()
            for is_text in (False, True)
        }
    )


WRAPPINGS = _wrappings(_RTU, _BYTES)
TCP_WRAPPINGS = _wrappings(_TCP_FRAME, _TCP_FRAME)  # for tcp:// ports: a transaction id may start with ':'
