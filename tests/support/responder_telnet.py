"""Telnet with the serial port option (RFC 2217), for a responder that accepts any settings."""

from __future__ import annotations

IAC, DONT, DO, WONT, WILL, SB, SE = 255, 254, 253, 252, 251, 250, 240
BINARY, SUPPRESS_GO_AHEAD, COM_PORT = 0, 3, 44
ANSWERS = {WILL: DO, DO: WILL}
SERVER = 100  # server's answer = client's command + 100


class Telnet:
    """A connection's state: agreed options, and an incomplete command."""

    def __init__(self) -> None:
        self._buffer = b""
        self._agreed: set[tuple[int, int]] = set()

    def decode(self, received: bytes) -> tuple[bytes, bytes]:
        """Return the received data, and the answer to the commands between it."""
        self._buffer += received
        data, answer = b"", b""
        while self._buffer:
            if self._buffer[0] != IAC:
                end = self._buffer.find(IAC)
                end = len(self._buffer) if end < 0 else end
                data, self._buffer = data + self._buffer[:end], self._buffer[end:]
                continue
            length = self._length()
            if not length:
                break
            command, self._buffer = self._buffer[:length], self._buffer[length:]
            if command == bytes([IAC, IAC]):
                data += bytes([IAC])
            else:
                answer += self._answer(command)
        return data, answer

    @staticmethod
    def encode(data: bytes) -> bytes:
        return data.replace(bytes([IAC]), bytes([IAC, IAC]))

    def _length(self) -> int:
        """Return the length of the first command, or 0 if it is incomplete."""
        if len(self._buffer) < 2:
            return 0
        if self._buffer[1] == SB:
            return self._buffer.find(bytes([IAC, SE])) + 2 if bytes([IAC, SE]) in self._buffer else 0
        length = 3 if self._buffer[1] in (WILL, WONT, DO, DONT) else 2
        return length if len(self._buffer) >= length else 0

    def _answer(self, command: bytes) -> bytes:
        if command[1] == SB and command[2] == COM_PORT:
            return command[:3] + bytes([command[3] + SERVER]) + command[4:]
        if command[1] not in ANSWERS or (command[1], command[2]) in self._agreed:
            return b""
        self._agreed.add((command[1], command[2]))
        known = command[2] in (BINARY, SUPPRESS_GO_AHEAD, COM_PORT)
        yes, no = ANSWERS[command[1]], {WILL: DONT, DO: WONT}[command[1]]
        return bytes([IAC, yes if known else no, command[2]])
