"""Read captures: pcap and pcapng files, from multidrop or other programs, as a stream of bytes per line.

A capture is read in pieces, because it may be larger than memory. It is not mapped into memory: if another
program truncated the file, a mapping would crash the process, whereas reading raises an error.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from io import SEEK_END
from pathlib import Path
from typing import Self

from multidrop.capture.pcapng_writer import (
    APPLICATION,
    IF_NAME,
    IF_RESOLUTION,
    INTERFACE,
    SECTION,
    SHB_APPLICATION,
)
from multidrop.core import Stream, Unpacked, Unpacker

_OLD_PACKET, _SIMPLE_PACKET = 2, 3
_IF_OFFSET = 14
_BINARY, _MOST_DIGITS, _MOST_BITS = 0x80, 9, 32
_MOST_OFFSET = 1 << 33  # limit in s: times in ns since 1970 must fit into 64 bits
_PCAP = {  # by a file's first four bytes: True if it is big-endian, and its clock ticks per second
    b"\xd4\xc3\xb2\xa1": (False, 10**6),
    b"\xa1\xb2\xc3\xd4": (True, 10**6),
    b"\x4d\x3c\xb2\xa1": (False, 10**9),
    b"\xa1\xb2\x3c\x4d": (True, 10**9),
}
_PCAP_HEADER, _PCAPNG_HEADER = 24, 28
_PIECE = 1 << 20  # bytes read at a time, many times the largest packet
_NO_SERIAL_LINE = {1: "Ethernet", 101: "IP", 105: "Wi-Fi", 113: "Linux cooked", 189: "USB", 220: "USB"}


class CaptureError(ValueError):
    """A file is not a capture, or is damaged; the message has the position of the damage."""


class Capture:
    """A capture file that is read; leaving the `with` block closes it. Raises CaptureError and OSError.

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
        self._unpacker: Unpacker | None = None
        try:
            self._begin()
        except BaseException:
            self.close()
            raise

    @property
    def streams(self) -> list[Stream]:
        return self._unpacker.streams if self._unpacker else []

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _begin(self) -> None:
        if not self._file.seekable():  # a serial port, or a pipe
            raise CaptureError(f"{self.path} is not a capture: it is no file")
        self._size = self._file.seek(0, SEEK_END)  # bytes that are appended later are not read
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
            raise CaptureError(f"{self.path} is not a capture: it does not begin like pcap or pcapng")

    def __iter__(self) -> Iterator[None]:
        """Read a part of the file into `streams`, and yield, so that the caller takes all bytes from them."""
        unpacker = self._unpacker
        assert unpacker is not None
        seen = unpacker.at  # position in the file after the last byte read
        while True:
            state = unpacker.unpack()
            if state is Unpacked.NONSENSE:
                raise self._damaged(unpacker.at)
            if state is Unpacked.OTHER_BLOCK:
                if not self._read_block(unpacker):
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
        """Return up to `most` bytes of the file from position `at`."""
        self._file.seek(at)
        piece = self._file.read(most)
        if len(piece) < min(most, self._size - at):
            raise CaptureError(
                f"{self.path} was cut short while it was read: it had {self._size} bytes, "
                f"and ends at byte {at + len(piece)} now"
            )
        return piece

    def _read_block(self, unpacker: Unpacker) -> bool:
        """Read a block other than an enhanced packet; return False if the file ends within it."""
        at = unpacker.at
        kind = self._read("I", at)
        if kind == SECTION and self._size - at >= _PCAPNG_HEADER and self._order_at(at) != self._order:
            raise CaptureError(f"{self.path}: byte {at}: sections of both byte orders cannot be read")
        size = self._read("I", at + 4)
        if size < 12 or size % 4:
            raise self._damaged(at)
        if at + size > self._size:
            return False
        body = self._piece(at + 8, min(size - 12, _PIECE)) if kind in (SECTION, INTERFACE) else b""
        if kind == SECTION:
            if at and self.lines:
                raise CaptureError(f"{self.path}: byte {at}: only the first section can be read")
            self._is_ours = dict(self._options(body[16:])).get(SHB_APPLICATION, b"").startswith(APPLICATION)
        elif kind == INTERFACE:
            self._read_interface(body, at)
        elif kind in (_SIMPLE_PACKET, _OLD_PACKET):
            raise CaptureError(
                f"{self.path}: byte {at}: packets without time or of the old kind cannot be read; "
                "`editcap` turns them into enhanced ones"
            )
        unpacker.at = at + size
        return True

    def _read_interface(self, body: bytes, at: int) -> None:
        if len(body) < 8:
            raise self._damaged(at)
        options = dict(self._options(body[8:]))
        resolution = (options.get(IF_RESOLUTION) or b"\x06")[0]
        power = resolution & ~_BINARY
        if power > (_MOST_BITS if resolution & _BINARY else _MOST_DIGITS):
            raise CaptureError(f"{self.path}: byte {at}: its clock is finer than a nanosecond")
        ticks_per_s = 2**power if resolution & _BINARY else 10**power
        offset = options.get(_IF_OFFSET, bytes(8))
        seconds: int = struct.unpack(f"{self._order}q", offset)[0] if len(offset) == 8 else 0
        if abs(seconds) > _MOST_OFFSET:
            raise CaptureError(f"{self.path}: byte {at}: its clock is {seconds} s off")
        name = options.get(IF_NAME, b"").rstrip(b"\0").decode(errors="replace")
        link: int = struct.unpack_from(f"{self._order}H", body)[0]
        self._add(link, name or f"{self.path.stem}-{len(self.lines)}", ticks_per_s, seconds * 10**9)

    def _add(self, link: int, name: str, ticks_per_s: int, offset_ns: int) -> None:
        assert self._unpacker is not None
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
        return CaptureError(f"{self.path} is damaged: what begins at byte {at} is no packet")
