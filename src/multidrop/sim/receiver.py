"""Cutting what is heard on a line into requests, as a drive's receiver does: bytes and times in,
frames out. The bytes are anyone's: garbage costs what it spoils and no more, and buffers are bounded.
"""

from __future__ import annotations

import binascii
from dataclasses import dataclass

from multidrop.core import Framing, Message, crc16, lrc, parse_request, sum8

MOST_RTU = 256
MOST_TEXT = 513
LEAST_RTU = 4  # address, function, CRC


@dataclass(frozen=True)
class Frame:
    """What was sent in one go: a request where `message` is there, else something else.

    `body` is without start, end and checksum; `intact` says whether the checksum was right.
    """

    body: bytes
    message: Message | None
    intact: bool
    begin: float  # of its first bit
    end: float  # of its last bit

    @property
    def address(self) -> int:
        return self.body[0]

    @property
    def function(self) -> int:
        return self.body[1]


class Receiver:
    """All that drives of one framing and baud rate hear; `most_gap` s of silence end a frame.

    `character` s is what one character takes; 0 where the line is not paced.
    """

    def __init__(self, framing: Framing, character: float, most_gap: float) -> None:
        self.framing = framing
        self.character = character
        self.most_gap = most_gap
        self._buffer = bytearray()
        self._end = float("-inf")  # of the last bit heard
        self._cut = self._cut_rtu if framing is Framing.RTU else self._cut_text

    @property
    def silent_at(self) -> float | None:
        """When what is in the buffer will have ended by silence."""
        return self._end + self.most_gap if self._buffer else None

    def feed(self, chunk: bytes, now: float) -> list[Frame]:
        """The frames that are complete with this chunk, whose first bit came at `now` or after."""
        frames = self.silence(now)
        self._end = max(now, self._end) + len(chunk) * self.character
        self._buffer += chunk
        while (frame := self._cut()) is not None:
            frames.append(frame)
        return frames

    def silence(self, now: float) -> list[Frame]:
        """What silence has ended by `now`: a frame that is no request, or a part of one."""
        if not self._buffer or now < self._end + self.most_gap:
            return []
        rest = bytes(self._buffer)
        self._buffer.clear()
        if self.framing is not Framing.RTU or not LEAST_RTU <= len(rest) <= MOST_RTU:
            return []
        intact = crc16(rest[:-2], len(rest) - 2) == int.from_bytes(rest[-2:], "little")
        return [self._frame(rest[:-2], None, intact, 0, len(rest))]

    def forget(self) -> None:
        self._buffer.clear()

    def _frame(self, body: bytes, message: Message | None, intact: bool, after: int, length: int) -> Frame:
        """A frame of `length` characters that ended `after` characters before the last one heard."""
        end = self._end - after * self.character
        return Frame(body, message, intact, end - length * self.character, end)

    # ---- RTU: found by length and CRC ----

    def _cut_rtu(self) -> Frame | None:
        """The next request; the first byte from which a good one begins wins.

        While one may still be under way, a later one counts only if it ends with the last byte.
        """
        pending = False
        heard = bytes(self._buffer[-MOST_RTU:])
        for at in range(len(heard)):
            used, message = parse_request(Framing.RTU, heard[at:])
            after = len(heard) - at - used
            if message is not None and not (pending and after):
                frame = self._frame(heard[at : at + used - 2], message, True, after, used)
                self._buffer = bytearray(heard[at + used :])
                return frame
            pending = pending or used == 0
        self._buffer = bytearray(heard)
        return None

    # ---- text: from ':' to line feed ----

    def _cut_text(self) -> Frame | None:
        heard = self._buffer
        while (end := heard.find(b"\n") + 1) > 0:
            start = heard.rfind(b":", 0, end)
            text = bytes(heard[start:end])
            del heard[:end]
            if start >= 0 and (frame := self._open_text(text, len(heard))) is not None:
                return frame
        start = heard.rfind(b":")
        if start < 0 or len(heard) - start > MOST_TEXT:
            heard.clear()
        else:
            del heard[:start]
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
