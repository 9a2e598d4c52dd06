"""Cut received bytes into requests, as a drive does: bytes and times in, frames out.

Garbage costs only the frames that it damages, and buffers are bounded. An RTU frame ends with silence: a
request that is followed at once by other bytes, unless these start a request, is damaged too.
"""

from __future__ import annotations

import binascii
from dataclasses import dataclass, replace

from multidrop.core import Framing, Message, crc16, lrc, parse_request, sum8

MOST_RTU = 256
TCP_HEAD, MOST_TCP = 6, 260  # bytes before the unit id, and of a frame
MOST_TEXT = 513
LEAST_RTU = 4  # address, function, CRC
# Function codes of requests: a byte without one behind it cannot start a request.
_REQUESTS = frozenset(code for code in range(256) if parse_request(Framing.RTU, bytes([1, code]))[0] == 0)


@dataclass(frozen=True)
class Frame:
    """A frame; `message` is None unless it is a request.

    `body` is without start, end and checksum; `intact` says whether the checksum was right.
    """

    body: bytes
    message: Message | None
    intact: bool
    begin: float  # of its first bit
    end: float  # of its last bit
    transaction: int = 0  # of Modbus TCP

    @property
    def address(self) -> int:
        return self.body[0]

    @property
    def function(self) -> int:
        return self.body[1]


class Receiver:
    """The receiver of one framing and baud rate; `most_gap` s of silence end a frame.

    One character takes `character` s; 0 if the line is not paced.
    """

    def __init__(self, framing: Framing, character: float, most_gap: float) -> None:
        self.framing = framing
        self.character = character
        self.most_gap = most_gap
        self._buffer = bytearray()
        self._end = float("-inf")  # of the last bit received
        cuts = {Framing.RTU: self._cut_rtu, Framing.TCP: self._cut_tcp}
        self._cut = cuts.get(framing, self._cut_text)

    @property
    def silent_at(self) -> float | None:
        """The time at which silence will end the frame in the buffer."""
        return self._end + self.most_gap if self._buffer else None

    def feed(self, chunk: bytes, now: float) -> list[Frame]:
        """Return the frames that this chunk completes; its first bit came at `now` or after."""
        frames = self.silence(now)
        self._end = max(now, self._end) + len(chunk) * self.character
        self._buffer += chunk
        while (frame := self._cut()) is not None:
            frames.append(frame)
        return frames

    def silence(self, now: float) -> list[Frame]:
        """Return the frame that silence has ended by `now`: no request, or a part of one."""
        if not self._buffer or now < self._end + self.most_gap:
            return []
        rest = bytes(self._buffer)
        self._buffer.clear()
        if self.framing is not Framing.RTU or not LEAST_RTU <= len(rest) <= MOST_RTU:
            return []
        if _first_request(rest) is not None:  # with more behind it
            return []
        intact = crc16(rest[:-2], len(rest) - 2) == int.from_bytes(rest[-2:], "little")
        return [self._frame(rest[:-2], None, intact, 0, len(rest))]

    def forget(self) -> None:
        self._buffer.clear()

    def _frame(self, body: bytes, message: Message | None, intact: bool, after: int, length: int) -> Frame:
        """Return a frame of `length` characters that ended `after` characters before the last one."""
        end = self._end - after * self.character
        return Frame(body, message, intact, end - length * self.character, end)

    def _cut_rtu(self) -> Frame | None:
        """Return the next request, unless it is followed by bytes that may still become a request."""
        data = bytes(self._buffer[-MOST_RTU:])
        while (found := _first_request(data)) is not None:
            at, used, message = found
            rest = data[at + used :]
            more = parse_request(Framing.RTU, rest)[0] if rest else 1
            if more > 0:
                self._buffer = bytearray(rest)
                return self._frame(data[at : at + used - 2], message, True, len(rest), used)
            if more == 0:
                break
            data = rest
        self._buffer = bytearray(data)
        return None

    def _cut_tcp(self) -> Frame | None:
        """Return the next frame; after an invalid header, drop all bytes."""
        data = bytes(self._buffer)
        if len(data) < TCP_HEAD:
            return None
        length = TCP_HEAD + int.from_bytes(data[4:6])
        if data[2:4] != b"\0\0" or not TCP_HEAD + 2 <= length <= MOST_TCP:
            self._buffer.clear()
            return None
        if len(data) < length:
            return None
        self._buffer = bytearray(data[length:])
        _, message = parse_request(Framing.TCP, data[:length])
        frame = self._frame(data[TCP_HEAD:length], message, True, len(data) - length, length)
        return replace(frame, transaction=int.from_bytes(data[:2]))

    def _cut_text(self) -> Frame | None:
        data = self._buffer
        while (end := data.find(b"\n") + 1) > 0:
            start = data.rfind(b":", 0, end)
            text = bytes(data[start:end])
            del data[:end]
            if start >= 0 and (frame := self._open_text(text, len(data))) is not None:
                return frame
        start = data.rfind(b":")
        if start < 0 or len(data) - start > MOST_TEXT:
            data.clear()
        else:
            del data[:start]
        return None

    def _open_text(self, text: bytes, after: int) -> Frame | None:
        used, message = parse_request(self.framing, text)
        try:
            octets = binascii.unhexlify(text[1:-2])
        except ValueError:
            return None
        if len(octets) < 3:
            return None
        body = octets[:-1]
        checksum = lrc if self.framing is Framing.ASCII else sum8
        intact = checksum(body, len(body)) == octets[-1]
        return self._frame(body, message if used == len(text) else None, intact, after, len(text))


def _first_request(data: bytes) -> tuple[int, int, Message] | None:
    """Return place, length and content of the first good request.

    While one may still be incomplete, a later one counts only if it ends with the last byte.
    """
    pending = False
    for at, code in enumerate(data[1:]):
        if code not in _REQUESTS:
            continue
        used, message = parse_request(Framing.RTU, data[at:])
        if message is not None and not (pending and at + used < len(data)):
            return at, used, message
        pending = pending or used == 0
    return None
