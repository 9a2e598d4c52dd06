"""A tap: all that goes over a line, taken as packets of a pcapng file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from multidrop._core import ffi, lib
from multidrop.core.sniffer import Side

_RING = 1 << 18  # bytes: some seconds of a fast line
_TAKEN = 1 << 16  # bytes of packets at a time


class Wrappings:
    """Headers and trailers of packets, by side, and apart for bytes that begin with ':'."""

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
        """Return one packet with these bytes."""
        length = lib.md_packet_length(self.c, side, raw[0] if raw else 0, len(raw))
        out = ffi.new("uint8_t[]", length)
        lib.md_put_packet(self.c, interface, side, time_ns, raw, len(raw), out)
        return bytes(ffi.buffer(out, length))


class Tap:
    """Bytes that went over one line and were not taken yet (struct md_tap)."""

    def __init__(self) -> None:
        self._ring = ffi.new("uint8_t[]", _RING)
        self.c = ffi.new("struct md_tap *", {"ring": self._ring, "room": _RING})
        self._out: Any = None

    @property
    def lost(self) -> int:
        """Bytes without room, because nobody took the others in time."""
        return int(self.c.lost)

    def take(self, wrappings: Wrappings, interface: int, utc_minus_monotonic_ns: int) -> Iterator[bytes]:
        """Yield all bytes as packets of this interface, many at a time."""
        if self.c.put == self.c.taken:
            return
        out = self._out = self._out or ffi.new("uint8_t[]", _TAKEN)
        while used := lib.md_tap_take(self.c, wrappings.c, interface, utc_minus_monotonic_ns, out, _TAKEN):
            yield bytes(ffi.buffer(out, used))
