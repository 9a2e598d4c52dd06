"""The drives at the far end of an adapter's line."""

from __future__ import annotations

from collections.abc import Sequence
from time import monotonic

import multidrop
from multidrop.sim import EncodedDrive, SimulatedDrive, Wire, simulated

NOMINAL = (1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200)
MOST_DEVIATION = 0.03  # largest relative deviation of an adapter's baud rate from the drives' nominal rate


class FarEnd:
    """Modbus RTU devices that share no code with multidrop.

    Register r of address a holds (a << 8 ^ r) & 0xFFFF until function 06 or 10 writes another value.
    Requests at other settings than `settings`, such as (19200, "8E1"), are noise.
    Without `settings`, requests at all settings are valid.
    """

    def __init__(self, addresses: Sequence[int], settings: Sequence[object] | None = None) -> None:
        self.requests: list[bytes] = []  # valid requests, to any address
        self._addresses = set(addresses)
        self._settings = settings
        self._buffer = b""
        self._written: dict[tuple[int, int], int] = {}

    def feed(self, data: bytes, baudrate: int, format: str) -> bytes:
        """Receive bytes from the line; return the replies."""
        if self._settings and list(self._settings) != [baudrate, format]:
            return b""
        self._buffer += data
        replies = b""
        while len(self._buffer) >= 8:
            size = 9 + self._buffer[6] if self._buffer[1] == 16 else 8
            frame = self._buffer[:size]
            if len(frame) < size:
                break
            if crc(frame[:-2]) != frame[-2:]:
                self._buffer = self._buffer[1:]
                continue
            self._buffer = self._buffer[size:]
            self.requests.append(frame)
            replies += self._answer(frame)
        return replies

    def _answer(self, frame: bytes) -> bytes:
        if frame[0] not in self._addresses:
            return b""
        body = self._body(frame)
        return body + crc(body)

    def _body(self, frame: bytes) -> bytes:
        address, function = frame[:2]
        start, count = int.from_bytes(frame[2:4]), int.from_bytes(frame[4:6])
        if function in (3, 4):
            words = (self._word(address, start + at) for at in range(count))
            return bytes((address, function, 2 * count)) + b"".join(word.to_bytes(2) for word in words)
        if function not in (6, 16):
            return bytes((address, function | 0x80, 1))
        written = frame[4:6] if function == 6 else frame[7:-2]
        for at in range(0, len(written), 2):
            self._written[address, start + at // 2] = int.from_bytes(written[at : at + 2])
        return frame[:6]

    def _word(self, address: int, register: int) -> int:
        return self._written.get((address, register), (address << 8 ^ register) & 0xFFFF)


class SimulatedEnd(FarEnd):
    """multidrop's own simulated drives, of a family named by its class, such as "ErmanERG220".

    With `encoded`, each value identifies its register and its drive.
    """

    def __init__(self, addresses: Sequence[int], family: str, *, encoded: bool = False) -> None:
        super().__init__(addresses)
        made = EncodedDrive if encoded else simulated
        drives: list[SimulatedDrive] = [made(getattr(multidrop, family)(address)) for address in addresses]
        self._wire = Wire(drives, unpaced=True)

    def feed(self, data: bytes, baudrate: int, format: str) -> bytes:
        self.requests.append(data)
        nominal = [rate for rate in NOMINAL if abs(baudrate - rate) <= rate * MOST_DEVIATION]
        rate = nominal[0] if nominal else baudrate
        self._wire.receive(data, monotonic(), rate or None)  # QEMU's adapter does not report its baud rate
        return self._wire.advance(monotonic())


def crc(data: bytes) -> bytes:
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ 0xA001 if value & 1 else value >> 1
    return value.to_bytes(2, "little")
