"""Build and parse frames in four framings, and describe the format of their characters."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple

from multidrop._core import ffi, lib

crc16 = lib.md_crc16
lrc = lib.md_lrc
sum8 = lib.md_sum


class FrameFault(IntEnum):
    """Reasons why bytes are not a frame (enum md_frame_fault)."""

    INCOMPLETE = lib.MD_INCOMPLETE
    NO_START = lib.MD_NO_START
    BAD_CHARACTER = lib.MD_BAD_CHARACTER
    BAD_CHECKSUM = lib.MD_BAD_CHECKSUM
    BAD_ADDRESS = lib.MD_BAD_ADDRESS
    BAD_FUNCTION = lib.MD_BAD_FUNCTION
    BAD_LENGTH = lib.MD_BAD_LENGTH
    BAD_ECHO = lib.MD_BAD_ECHO
    BAD_REQUEST = lib.MD_BAD_REQUEST


class Framing(IntEnum):
    RTU = lib.MD_RTU
    ASCII = lib.MD_ASCII
    DELIXI = lib.MD_DELIXI
    TCP = lib.MD_TCP  # Modbus TCP (MBAP), only on tcp:// ports

    def __str__(self) -> str:
        return self.name.lower()


@dataclass(frozen=True)
class Message:
    """The content of a frame in any framing (struct md_message)."""

    address: int
    function: int
    start: int = 0
    count: int = 0
    data: bytes = b""
    exception: int = 0
    transaction: int = 0  # transaction id; only with Modbus TCP


MODBUS = (Framing.RTU, Framing.ASCII, Framing.TCP)  # framings that carry the PDU of the Modbus standard
_LONGER_THAN_RTU = 4  # bytes by which a Modbus TCP frame exceeds the same frame in RTU


def characters_on_wire(framing: Framing, length: int) -> int:
    """Return a frame's number of characters on the serial wire. A gateway sends Modbus TCP as RTU."""
    return length - _LONGER_THAN_RTU if framing is Framing.TCP else length


def to_c(message: Message) -> Any:
    if len(message.data) > lib.MD_MOST_DATA:
        raise ValueError(f"a frame holds at most {lib.MD_MOST_DATA} data bytes, not {len(message.data)}")
    try:
        return ffi.new(
            "struct md_message *",
            {
                "address": message.address,
                "function": message.function,
                "exception": message.exception,
                "transaction": message.transaction,
                "start": message.start,
                "count": message.count,
                "data_len": len(message.data),
                "data": message.data,
            },
        )
    except OverflowError as mistake:
        raise ValueError(f"a field is out of bounds: {mistake}") from mistake


def from_c(found: Any) -> Message:
    return Message(
        found.address,
        found.function,
        found.start,
        found.count,
        bytes(ffi.buffer(found.data, found.data_len)),
        found.exception,
        found.transaction,
    )


def _build(build: Any, framing: Framing, message: Message) -> bytes:
    room = lib.MD_MOST_FRAME
    out = ffi.new("uint8_t[]", room)
    length = build(framing, to_c(message), out, room)
    if length < 0:
        raise ValueError(f"a field is out of bounds for a {framing} frame: {message}")
    return bytes(ffi.buffer(out, length))


def build_request(framing: Framing, message: Message) -> bytes:
    """Return a request's frame. Raises ValueError if a field is out of bounds."""
    return _build(lib.md_build_request, framing, message)


def build_reply(framing: Framing, message: Message) -> bytes:
    """Return a drive's reply as a frame. Raises ValueError if a field is out of bounds."""
    return _build(lib.md_build_reply, framing, message)


def parse_request(framing: Framing, received: bytes) -> tuple[int, Message | None]:
    """Parse the request that `received` starts with.

    Return its length in bytes and the message, or a FrameFault and None.
    """
    found = ffi.new("struct md_message *")
    used = lib.md_parse_request(framing, received, len(received), found)
    return used, from_c(found) if used > 0 else None


def parse_reply(framing: Framing, received: bytes, request: Message) -> tuple[int, Message | None]:
    """Parse the reply to `request`, whatever its transaction id. Return the same pair as `parse_request`."""
    found = ffi.new("struct md_message *")
    used = lib.md_parse_reply(framing, received, len(received), to_c(request), found)
    return used, from_c(found) if used > 0 else None


def find_replies(framing: Framing, received: bytes, request: Message) -> Iterator[bytes]:
    """Yield each reply to `request`, starting at any byte of `received`."""
    asked, reply, source = to_c(request), ffi.new("struct md_message *"), ffi.from_buffer(received)
    for at in range(len(received)):
        used = lib.md_parse_reply(framing, source + at, len(received) - at, asked, reply)
        if used > 0:
            yield received[at : at + used]


def reply_length(framing: Framing, request: Message) -> int:
    """Return the length in bytes of the good reply to `request`; 0 after a broadcast."""
    return int(lib.md_reply_length(framing, to_c(request)))


# ---- characters ----


class CharacterFormat(NamedTuple):
    """Data bits, parity and stop bits of a character."""

    databits: int
    parity: str
    stopbits: int

    @classmethod
    def parse(cls, text: str) -> CharacterFormat:
        """Parse a format such as "8N1"."""
        return cls(int(text[0]), text[1], int(text[2]))


def settings_to_c(baudrate: int, format: str) -> dict[str, object]:
    """Return the fields of a struct md_settings."""
    bits = CharacterFormat.parse(format)
    return {"baudrate": baudrate, **bits._asdict(), "parity": bits.parity.encode()}
