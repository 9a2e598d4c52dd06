"""Writes captures: pcapng whose RTU frames Wireshark decodes without being told how."""

from __future__ import annotations

import struct
from importlib.metadata import version
from pathlib import Path
from types import TracebackType

from multidrop.core import Side
from multidrop.recording.interface import RecordingError
from multidrop.recording.whole import WholeFile

EXPORTED_PDU = 252
APPLICATION = b"multidrop"  # begins the application's name in captures of ours

_SECTION, _INTERFACE, _PACKET = 0x0A0D0D0A, 1, 6
_END, _COMMENT = 0, 1
_IF_NAME, _IF_RESOLUTION = 2, 9
_SHB_APPLICATION = 4
_EPB_FLAGS = 2
_NANOSECONDS = b"\x09"

_DISSECTOR, _IPV4_SOURCE, _IPV4_TARGET, _PORT_TYPE, _SOURCE_PORT, _TARGET_PORT = 12, 20, 21, 24, 25, 26
_TCP = 2
_CLIENT, _SERVER = (bytes([10, 0, 0, 1]), 50000), (bytes([10, 0, 0, 2]), 502)


class CaptureWriter:
    """A capture that is being written; leaving the `with` block closes it. Raises RecordingError.

    Each frame is given to the system at once: after a crash all of them are there.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.frames = 0
        self._lines: dict[str, int] = {}
        try:
            self._file = WholeFile(self.path)
        except OSError as failure:
            raise RecordingError.of(failure, self.path) from failure
        name = APPLICATION + b" " + version("multidrop").encode()
        head = struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1)
        self._append(_block(_SECTION, head + _options((_SHB_APPLICATION, name))))

    def write(self, frame: bytes, side: Side, time_ns: int, line: str) -> None:
        """Append what was on the line at this time (UTC, ns); a side that is not known: no frame."""
        if line not in self._lines:
            self._lines[line] = len(self._lines)
            options = _options((_IF_NAME, line.encode()), (_IF_RESOLUTION, _NANOSECONDS))
            self._append(_block(_INTERFACE, struct.pack("<HHI", EXPORTED_PDU, 0, 0) + options))
        packet = _HEADS[side, frame[:1] == b":"] + frame
        head = struct.pack(
            "<IIIII", self._lines[line], time_ns >> 32, time_ns & 0xFFFF_FFFF, len(packet), len(packet)
        )
        self._append(_block(_PACKET, head + _padded(packet) + _PACKET_OPTIONS[side]))
        self.frames += 1

    def _append(self, block: bytes) -> None:
        try:
            self._file.append(memoryview(block))
        except OSError as failure:
            raise RecordingError.of(failure, self.path) from failure

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> CaptureWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
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


def _head(side: Side, is_text: bool) -> bytes:
    """What stands before a frame: who takes it apart, and who sent it."""
    dissector = b"data" if is_text or side is Side.EITHER else b"mbrtu"
    tags = _tag(_DISSECTOR, dissector)
    if side is not Side.EITHER:
        ends = (_CLIENT, _SERVER) if side is Side.ASKING else (_SERVER, _CLIENT)
        (source, source_port), (target, target_port) = ends
        tags += _tag(_IPV4_SOURCE, source) + _tag(_IPV4_TARGET, target)
        for code, number in (
            (_PORT_TYPE, _TCP),
            (_SOURCE_PORT, source_port),
            (_TARGET_PORT, target_port),
        ):
            tags += _tag(code, struct.pack(">I", number))
    return tags + _tag(_END, b"")


_HEADS = {(side, is_text): _head(side, is_text) for side in Side for is_text in (False, True)}
_INBOUND, _OUTBOUND = 1, 2
_PACKET_OPTIONS = {
    Side.EITHER: _options((_COMMENT, b"no frame")),
    Side.ASKING: _options((_EPB_FLAGS, struct.pack("<I", _OUTBOUND))),
    Side.ANSWERING: _options((_EPB_FLAGS, struct.pack("<I", _INBOUND))),
}
