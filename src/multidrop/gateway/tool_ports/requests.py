"""RTU frames of a tool: cut requests out of its bytes, and build replies. This module does no I/O.

Source: MODBUS over Serial Line V1.02, section 2.5.1. On a serial line, silence separates frames. A
pseudo-terminal and TCP do not keep the silence, so a frame is recognised by its length and checksum.
"""

from __future__ import annotations

from multidrop.core import FrameFault, Framing, crc16, parse_request
from multidrop.gateway.modbus_server.protocol import MbapRequest

LEAST_FRAME, MOST_FRAME = 4, 256  # in bytes: address, function, data, checksum
EXCEPTION = 0x80  # bit of a function code that only replies have
_CHECKSUM = 2
_MBAP = 6  # bytes of a Modbus TCP frame before the unit id


class RequestCutter:
    """Collects a tool's bytes and returns whole requests."""

    def __init__(self) -> None:
        self._came = bytearray()
        self._is_in_step = True  # False while the start of the next request is unknown

    def add(self, data: bytes) -> None:
        """Append received bytes."""
        self._came += data

    def take(self) -> MbapRequest | None:
        """Remove the first request and return it; None if no request is complete.

        Bytes before this request that belong to no request are dropped.
        """
        while len(self._came) >= LEAST_FRAME:
            length = _request_length(self._came, self._is_in_step)
            if length is None:
                return None
            self._is_in_step = length > 0
            if length:
                body = bytes(self._came[: length - _CHECKSUM])
                del self._came[:length]
                return MbapRequest(0, body[0], body[1], body[2:])
            del self._came[0]
        return None

    @property
    def has_rest(self) -> bool:
        """True if bytes of an incomplete request wait for the rest."""
        return bool(self._came)

    def skip(self) -> bool:
        """Drop the first byte, because the rest of the request that it starts did not come.

        Return False if no byte is left.
        """
        del self._came[:1]
        self._is_in_step = not self._came
        return self.has_rest


def _request_length(came: bytearray, is_in_step: bool) -> int | None:
    """Return the length of the request at the start of `came`.

    Return None if that request is incomplete, and 0 if no request starts there.
    """
    found, _ = parse_request(Framing.RTU, bytes(came[:MOST_FRAME]))
    if found == FrameFault.INCOMPLETE:
        return None
    if found != FrameFault.BAD_FUNCTION:
        return max(found, 0)
    # The length of requests of other functions is unknown. But a tool waits after its request, so the request
    # ends where the received bytes end.
    if not is_in_step or came[1] >= EXCEPTION or len(came) > MOST_FRAME:
        return 0
    return None if crc16(bytes(came), len(came)) else len(came)


def rtu_reply(frame: bytes) -> bytes:
    """Return an RTU frame with the content of a Modbus TCP frame."""
    body = frame[_MBAP:]
    return body + int(crc16(body, len(body))).to_bytes(2, "little")
