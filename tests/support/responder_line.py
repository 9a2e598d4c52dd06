"""A line of responders that splits, checks and answers frames, and records each with its time.

It shares no code with the library: checksums are those of checksums.py.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import checksums
from responder_drives import DELIXI, Asked, ResponderDrive

READS, WRITES = (1, 2, 3, 4), (5, 6, 15, 16)
DELIXI_WRITES = (2, 4, 5, 6)
LENGTHS = dict.fromkeys((*READS, 5, 6, 8), 8)


@dataclass(frozen=True)
class ReceivedFrame:
    """A received frame; `what` is moves, stops, writes, reads or damaged."""

    at: int  # ns, CLOCK_MONOTONIC, when it was read
    connection: int  # increases each time the port comes back
    frame: bytes
    what: str
    asked: Asked | None

    def __str__(self) -> str:
        said = (
            self.frame.decode("ascii", "replace").strip() if self.frame[:1] == b":" else self.frame.hex(" ")
        )
        return f"{self.at / 1e9:.4f} {self.what:8}{said}"


def split(buffer: bytes) -> tuple[bytes, Asked | None, bytes]:
    """Return the first frame, its request (None if its checksum is wrong), and the rest; without a frame,
    b"".
    """
    if buffer[:1] == b":":
        end = buffer.find(b"\n") + 1
        frame, rest = buffer[:end], buffer[end:]
        return frame, _ascii(frame) if frame else None, rest
    if len(buffer) < 8:
        return b"", None, buffer
    length = LENGTHS.get(buffer[1], 9 + buffer[6])
    if len(buffer) < length:
        return b"", None, buffer
    frame, rest = buffer[:length], buffer[length:]
    if checksums.rtu(frame[:-2]) != frame:
        return frame, None, rest
    return frame, _standard(frame[:-2]), rest


def _ascii(frame: bytes) -> Asked | None:
    body = frame[1:-4].decode("ascii", "replace")
    with suppress(ValueError):
        if frame == checksums.delixi(body):
            octets = bytes.fromhex(body)
            start, value = int.from_bytes(octets[2:4]), int.from_bytes(octets[4:])
            return Asked(octets[0], octets[1], start, value)
        if frame == checksums.ascii(body):
            return _standard(bytes.fromhex(body))
    return None


def _standard(body: bytes) -> Asked:
    value = body[7:9] if body[1] in (15, 16) else body[4:6]
    return Asked(body[0], body[1], int.from_bytes(body[2:4]), int.from_bytes(value))


def reply(drive: ResponderDrive, asked: Asked, frame: bytes, exception: int = 0) -> bytes:
    """Execute a request; return the drive's reply."""
    if drive.kind.protocol == DELIXI:
        return _delixi_reply(drive, asked, frame, exception)
    head = f"{asked.address:02X}"
    if exception:
        body = f"{head}{asked.function | 0x80:02X}{exception:02X}"
    elif asked.function in READS:
        words = "".join(f"{drive.word(asked.start + at, asked.function):04X}" for at in range(asked.value))
        body = f"{head}{asked.function:02X}{2 * asked.value:02X}{words}"
    elif asked.function in (15, 16):
        body = f"{head}{asked.function:02X}{asked.start:04X}0001"
    else:
        return frame
    return checksums.ascii(body) if frame[:1] == b":" else checksums.rtu(body)


def _delixi_reply(drive: ResponderDrive, asked: Asked, frame: bytes, exception: int) -> bytes:
    head = f"{asked.address:02X}"
    if exception:
        return checksums.delixi(f"{head}{exception:02X}000000000000")
    if asked.function == 3:
        return checksums.delixi(f"{head}03{drive.state():04X}00000000")
    if asked.function == 7:
        return checksums.delixi(f"{head}07{asked.start:04X}{drive.word(asked.start, 7):08X}")
    return frame


class ResponderLine:
    """The line of a port, with its faults.

    Each entry of the list of troubles affects one of the next requests: "mute" executes without a reply,
    "deaf"
    ignores, "late" replies after the following request, and a number replies with that exception.
    `deaf_until`
    and `delay` (s) stay in effect.
    """

    def __init__(self, drives: Sequence[ResponderDrive]) -> None:
        self.drives = {drive.address: drive for drive in drives}
        self.log: list[ReceivedFrame] = []
        self.troubles: list[str | int] = []
        self.deaf_until = 0.0  # s, CLOCK_MONOTONIC
        self.delay = 0.0
        self.connection = 0
        self.mangle: Callable[[bytes], bytes] = lambda said: said  # changes a reply on its way
        self.held = threading.Event()  # set when `hold` has its request
        self._hold_in = 0  # requests until then
        self._is_holding = False
        self._kept: list[bytes] = []  # held replies
        self._late = b""
        self._buffer = b""
        self._last = 0.0  # s, time of the latest bytes

    def hold(self, requests: int) -> None:
        """Hold replies, after this many requests, until `release`."""
        self.held.clear()
        self._hold_in, self._is_holding = requests + 1, False

    def release(self) -> list[bytes]:
        """Return the replies that were held back."""
        self._hold_in, self._is_holding = 0, False
        kept, self._kept = self._kept, []
        return kept

    def reconnected(self) -> None:
        self._buffer = self._late = b""
        self.release()
        self.connection += 1

    def hear(self, received: bytes) -> list[bytes]:
        """Return the replies to these bytes."""
        now = time.monotonic()
        if now - self._last > 0.05:  # the rest of a truncated frame will not come
            self._buffer = b""
        self._last = now
        self._buffer += received
        replies = []
        while self._buffer:
            frame, asked, self._buffer = split(self._buffer)
            if not frame:
                break
            replies += self._answer(frame, asked)
        return replies

    def _answer(self, frame: bytes, asked: Asked | None) -> list[bytes]:
        drives = [] if asked is None else self._addressed(asked.address)
        self.log.append(
            ReceivedFrame(time.monotonic_ns(), self.connection, frame, _what(asked, drives), asked)
        )
        if asked is None or not drives:
            return []
        self._count()
        trouble = self.troubles.pop(0) if self.troubles else ""
        late, self._late = self._late, b""
        if trouble == "deaf" or time.monotonic() < self.deaf_until:
            return [late] if late else []
        if not isinstance(trouble, int) and _is_write(drives[0], asked):
            for drive in drives:
                drive.write(asked)
        said = reply(drives[0], asked, frame, trouble if isinstance(trouble, int) else 0)
        if trouble == "late":
            self._late, said = said, b""
        if trouble == "mute" or asked.address == 0:
            said = b""
        said = self.mangle(late + said)
        if self._is_holding:
            self._kept.append(said)
            return []
        return [said] if said else []

    def _addressed(self, address: int) -> list[ResponderDrive]:
        if address == 0:
            return list(self.drives.values())
        return [self.drives[address]] if address in self.drives else []

    def _count(self) -> None:
        if self._hold_in:
            self._hold_in -= 1
            if not self._hold_in:
                self._is_holding = True
                self.held.set()


def _is_write(drive: ResponderDrive, asked: Asked) -> bool:
    return asked.function in (DELIXI_WRITES if drive.kind.protocol == DELIXI else WRITES)


def _what(asked: Asked | None, drives: Sequence[ResponderDrive]) -> str:
    if asked is None:
        return "damaged"
    if not drives or not _is_write(drives[0], asked):
        return "reads"
    for what, judge in (("moves", drives[0].kind.moves), ("stops", drives[0].kind.stops)):
        if judge(asked):
            return what
    return "writes"
