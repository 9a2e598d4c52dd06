"""MBAP: the frames of Modbus TCP.

Source: MODBUS Messaging on TCP/IP Implementation Guide V1.0b, section 3.1.3.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

MOST_DATA = 253  # bytes of a function code and its data (application protocol V1.1b3, 4.1)
_HEADER = struct.Struct(">HHHB")
_FUNCTION = _HEADER.size  # where the function code stands


class Garbage(ValueError):
    """Bytes that are no header of Modbus TCP."""


class MbapRequest(NamedTuple):
    """One request of a client."""

    transaction: int
    unit: int
    function: int
    data: bytes  # that follows the function code

    def reply(self, data: bytes) -> bytes:
        """Return the frame of a good reply."""
        return _HEADER.pack(self.transaction, 0, 2 + len(data), self.unit) + bytes([self.function]) + data

    def exception(self, code: int) -> bytes:
        """Return the frame of an exception."""
        return _HEADER.pack(self.transaction, 0, 3, self.unit) + bytes([self.function | 0x80, code])


def take_frame(buffer: bytearray) -> bytes | None:
    """Take the first request's frame out of the bytes that came; None where it is not whole yet.

    Raises Garbage as soon as a header can be none: after it no frame's begin is known any more.
    """
    if len(buffer) >= 4 and buffer[2:4] != b"\0\0":
        raise Garbage(f"protocol id {int.from_bytes(buffer[2:4]):04X}H, and Modbus has 0")
    if len(buffer) < 6:
        return None
    length = int.from_bytes(buffer[4:6])
    if not 2 <= length <= 1 + MOST_DATA:
        raise Garbage(f"length {length}, and a frame has 2 to {1 + MOST_DATA} bytes after it")
    if len(buffer) < 6 + length:
        return None
    frame = bytes(buffer[: 6 + length])
    del buffer[: 6 + length]
    return frame


def function_of(frame: bytes) -> int:
    """Return the function code of a whole frame."""
    return frame[_FUNCTION]


def request_of(frame: bytes) -> MbapRequest:
    """Return the request of a whole frame."""
    transaction, _, _, unit = _HEADER.unpack_from(frame)
    return MbapRequest(transaction, unit, frame[_FUNCTION], frame[_FUNCTION + 1 :])


def take_request(buffer: bytearray) -> MbapRequest | None:
    """Take the first request out of the bytes that came; None where it is not whole yet. Raises Garbage."""
    frame = take_frame(buffer)
    return None if frame is None else request_of(frame)
