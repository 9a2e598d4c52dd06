"""Split received bytes into requests, as a drive does. The input is bytes with times, the output is frames.

Invalid bytes affect only the frames that they damage. Buffers have a limited size. Bytes that follow an RTU
request without a pause damage it, unless they start another request.
"""

from __future__ import annotations

import binascii
from dataclasses import dataclass, replace

from multidrop.core import Framing, Message, crc16, lrc, parse_request, sum8

MOST_RTU = 256
TCP_HEAD, MOST_TCP = 6, 260  # number of bytes before the unit id; length of the longest frame
MOST_TEXT = 513
LEAST_RTU = 4  # bytes of the shortest frame: address, function code, CRC
# Function codes of requests. A byte can be a request's address only if a function code follows it.
_REQUESTS = frozenset(code for code in range(256) if parse_request(Framing.RTU, bytes([1, code]))[0] == 0)


@dataclass(frozen=True)
class Frame:
    """A received frame; `message` is the request in it, or None if it is not a valid request.

    `body` is without start, end and checksum. `intact` is True if the checksum is correct.
    """

    body: bytes
    message: Message | None
    intact: bool
    begin: float  # time of the first bit, in s
    end: float  # time of the last bit, in s
    transaction: int = 0  # transaction id of a Modbus TCP frame; 0 for other frames

    @property
    def address(self) -> int:
        return self.body[0]

    @property
    def function(self) -> int:
        return self.body[1]


class Receiver:
    """Receives frames of one framing and baud rate. A silence of `most_gap` s ends a frame.

    `character` is the time of a character in s; 0 on a line without timing.
    """

    def __init__(self, framing: Framing, character: float, most_gap: float) -> None:
        self.framing = framing
        self.character = character
        self.most_gap = most_gap
        self._buffer = bytearray()
        self._end = float("-inf")  # time in s of the last bit received
        cuts = {Framing.RTU: self._cut_rtu, Framing.TCP: self._cut_tcp}
        self._cut = cuts.get(framing, self._cut_text)

    @property
    def silent_at(self) -> float | None:
        """The time in s at which silence will end the buffered frame; None if the buffer is empty."""
        return self._end + self.most_gap if self._buffer else None

    def feed(self, chunk: bytes, now: float) -> list[Frame]:
        """Return the frames that this chunk completes.

        The chunk's first bit starts at `now` s, or after the previous chunk's last bit if that is later.
        """
        frames = self.silence(now)
        self._end = max(now, self._end) + len(chunk) * self.character
        self._buffer += chunk
        while (frame := self._cut()) is not None:
            frames.append(frame)
        return frames

    def silence(self, now: float) -> list[Frame]:
        """Return a list with the damaged frame that a silence has ended; [] if there is no such frame."""
        if not self._buffer or now < self._end + self.most_gap:
            return []
        rest = bytes(self._buffer)
        self._buffer.clear()
        if self.framing is not Framing.RTU or not LEAST_RTU <= len(rest) <= MOST_RTU:
            return []
        if _first_request(rest) is not None:  # a valid request that was followed by other bytes is ignored
            return []
        intact = crc16(rest[:-2], len(rest) - 2) == int.from_bytes(rest[-2:], "little")
        return [self._frame(rest[:-2], None, intact, 0, len(rest))]

    def forget(self) -> None:
        self._buffer.clear()

    def _frame(self, body: bytes, message: Message | None, intact: bool, after: int, length: int) -> Frame:
        """Return a frame of `length` characters; `after` characters were received after it."""
        end = self._end - after * self.character
        return Frame(body, message, intact, end - length * self.character, end)

    def _cut_rtu(self) -> Frame | None:
        """Return the next request; None if there is none yet.

        Bytes that follow a request damage it, unless they start another request. Return None too if so few
        bytes follow that they could still start one.
        """
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
        """Return the next frame, or None. If the header is invalid, discard all bytes."""
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
    """Return index, length and message of the first valid request in `data`; None if there is none.

    A longer request that starts earlier in `data` may still be incomplete, and contain the found request by
    chance. In this case, return the found request only if it ends at the end of `data`.
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
