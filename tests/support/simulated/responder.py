"""Responders behind ptys or sockets, run by one thread and independent of the library."""

from __future__ import annotations

import os
import selectors
import socket
import threading
import time
import tty
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import checksums
from responder_drives import DELIXI, DriveRequest, ResponderDrive

__all__ = ["ReceivedFrame", "Responder", "ResponderLine"]


class Responder:
    """Runs responder lines behind ports in one thread; `ports` are the names that a client opens.

    A client opens a pty through a link in `directory`, so that the pty can vanish and come back.
    Alternatively each line has a listening socket, for raw bytes or for Telnet with the serial port option.
    """

    def __init__(
        self,
        lines: Sequence[ResponderLine],
        directory: Path | None = None,
        listening: Sequence[socket.socket] = (),
        telnet: bool = False,
    ) -> None:
        self.lines = list(lines)
        self._telnets: dict[ResponderLine, Telnet] = {}
        self._is_telnet = telnet
        self.ports: list[str] = []
        self._links: list[Path] = []
        self._slaves: dict[ResponderLine, int] = {}
        self._masters: dict[ResponderLine, int] = {}
        self._sockets: dict[ResponderLine, socket.socket] = {}
        self._listening = list(listening)
        self._delayed: list[tuple[float, ResponderLine, bytes]] = []
        self._ready = selectors.DefaultSelector()
        self._jobs: list[Callable[[], Any]] = []
        self._wake, self._waker = os.pipe()
        self._ready.register(self._wake, selectors.EVENT_READ, self._woken)
        for number, line in enumerate(self.lines):
            if directory:
                self._links.append(directory / f"line-{number}")
                self._plug_in(line)
                self.ports.append(str(self._links[-1]))
        for line, each in zip(self.lines, self._listening, strict=False):
            self._listen(line, each)
            host, port = each.getsockname()
            self.ports.append(f"{'rfc2217' if telnet else 'socket'}://{host}:{port}")
        self._thread = threading.Thread(target=self._run, name="responder", daemon=True)
        self._done = False

    def __enter__(self) -> Responder:
        self._thread.start()
        return self

    def __exit__(self, *failure: object) -> None:
        self.do(lambda: setattr(self, "_done", True))
        self._thread.join()
        self._ready.close()
        for link in self._links:
            link.unlink(missing_ok=True)
        for fd in (*self._masters.values(), *self._slaves.values(), self._wake, self._waker):
            os.close(fd)
        for connection in (*self._sockets.values(), *self._listening):
            connection.close()

    # ---- ports ----

    def _plug_in(self, line: ResponderLine) -> None:
        master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(master, False)
        link = self._links[self.lines.index(line)]
        new = link.with_suffix(".new")
        new.symlink_to(os.ttyname(slave))
        new.rename(link)
        self._masters[line], self._slaves[line] = master, slave
        self._ready.register(master, selectors.EVENT_READ, lambda: self._read(line))

    def _listen(self, line: ResponderLine, listening: socket.socket) -> None:
        self._ready.register(listening, selectors.EVENT_READ, lambda: self._accept(line, listening))

    def _accept(self, line: ResponderLine, listening: socket.socket) -> None:
        if line in self._sockets:
            self._hang_up(line)
        connection, _ = listening.accept()
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._sockets[line] = connection
        if self._is_telnet:
            self._telnets[line] = Telnet()
        line.reconnected()
        self._ready.register(connection, selectors.EVENT_READ, lambda: self._read(line))

    def _hang_up(self, line: ResponderLine) -> None:
        connection = self._sockets.pop(line)
        self._ready.unregister(connection)
        connection.close()

    def lose(self, line: ResponderLine) -> None:
        """Remove the line's port, as when an adapter is unplugged."""

        def unplug() -> None:
            self._links[self.lines.index(line)].unlink()
            master = self._masters.pop(line)
            self._ready.unregister(master)
            os.close(master)
            os.close(self._slaves.pop(line))

        self.do(unplug)

    def bring_back(self, line: ResponderLine) -> None:
        def plug_in() -> None:
            line.reconnected()
            self._plug_in(line)

        self.do(plug_in)

    # ---- the responder thread ----

    def do(self, job: Callable[[], Any]) -> None:
        """Run `job` in the responder thread, and wait until it is done."""
        done = threading.Event()

        def run_and_notify() -> None:
            job()
            done.set()

        self._jobs.append(run_and_notify)
        os.write(self._waker, b"\0")
        done.wait()  # the job completes even if a signal handler interrupts this wait

    def release(self, line: ResponderLine) -> None:
        """Send the replies that `hold` has held back on this line."""

        def give() -> None:
            for said in line.release():
                self._send(line, said)

        self.do(give)

    def _woken(self) -> None:
        os.read(self._wake, 1024)
        while self._jobs:
            self._jobs.pop(0)()

    def _run(self) -> None:
        while not self._done:
            waits = [at - time.monotonic() for at, _, _ in self._delayed[:1]]
            for key, _ in self._ready.select(max(0.0, waits[0]) if waits else None):
                key.data()
            while self._delayed and self._delayed[0][0] <= time.monotonic():
                _, line, said = self._delayed.pop(0)
                self._send(line, said)

    def _read(self, line: ResponderLine) -> None:
        try:
            connection = self._sockets.get(line)
            received = connection.recv(4096) if connection else os.read(self._masters[line], 4096)
        except BlockingIOError:
            return
        except OSError:
            received = b""
        if not received:
            if line in self._sockets:
                self._hang_up(line)
            return
        if line in self._telnets:
            received, answer = self._telnets[line].decode(received)
            self._sockets[line].send(answer)
        for said in line.hear(received):
            if line.delay:
                self._delayed.append((time.monotonic() + line.delay, line, said))
            else:
                self._send(line, said)

    def _send(self, line: ResponderLine, said: bytes) -> None:
        with suppress(OSError, KeyError):
            if line in self._sockets:
                self._sockets[line].send(Telnet.encode(said) if self._is_telnet else said)
            else:
                os.write(self._masters[line], said)


# ---- Telnet with the serial port option (RFC 2217); all settings are accepted ----

IAC, DONT, DO, WONT, WILL, SB, SE = 255, 254, 253, 252, 251, 250, 240
BINARY, SUPPRESS_GO_AHEAD, COM_PORT = 0, 3, 44
ANSWERS = {WILL: DO, DO: WILL}
SERVER = 100  # code of an answer = code of the client's command + 100


class Telnet:
    """State of a Telnet connection: agreed options, and an incomplete command."""

    def __init__(self) -> None:
        self._buffer = b""
        self._agreed: set[tuple[int, int]] = set()

    def decode(self, received: bytes) -> tuple[bytes, bytes]:
        """Return the data in the received bytes, and the answer to the Telnet commands among them."""
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
        """Return the length of the buffered command, or 0 if it is incomplete."""
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


# ---- one line: frames are split, checked and answered without code of the library ----

READS, WRITES = (1, 2, 3, 4), (5, 6, 15, 16)
DELIXI_WRITES = (2, 4, 5, 6)
LENGTHS = dict.fromkeys((*READS, 5, 6, 8), 8)


@dataclass(frozen=True)
class ReceivedFrame:
    """A received frame; `what` is "moves", "stops", "writes", "reads" or "damaged"."""

    at: int  # time at which the frame was read, CLOCK_MONOTONIC in ns
    connection: int  # number of the connection; increases each time the port comes back
    frame: bytes
    what: str
    asked: DriveRequest | None

    def __str__(self) -> str:
        said = (
            self.frame.decode("ascii", "replace").strip() if self.frame[:1] == b":" else self.frame.hex(" ")
        )
        return f"{self.at / 1e9:.4f} {self.what:8}{said}"


def split(buffer: bytes) -> tuple[bytes, DriveRequest | None, bytes]:
    """Return the first frame (b"" if incomplete), its request (None if the checksum is wrong), the rest."""
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


def _ascii(frame: bytes) -> DriveRequest | None:
    body = frame[1:-4].decode("ascii", "replace")
    with suppress(ValueError):
        if frame == checksums.delixi(body):
            octets = bytes.fromhex(body)
            start, value = int.from_bytes(octets[2:4]), int.from_bytes(octets[4:])
            return DriveRequest(octets[0], octets[1], start, value)
        if frame == checksums.ascii(body):
            return _standard(bytes.fromhex(body))
    return None


def _standard(body: bytes) -> DriveRequest:
    value = body[7:9] if body[1] in (15, 16) else body[4:6]
    return DriveRequest(body[0], body[1], int.from_bytes(body[2:4]), int.from_bytes(value))


def reply(drive: ResponderDrive, asked: DriveRequest, frame: bytes, exception: int = 0) -> bytes:
    """Carry out a request; return the drive's reply, which has `exception` if that is not 0."""
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


def _delixi_reply(drive: ResponderDrive, asked: DriveRequest, frame: bytes, exception: int) -> bytes:
    head = f"{asked.address:02X}"
    if exception:
        return checksums.delixi(f"{head}{exception:02X}000000000000")
    if asked.function == 3:
        return checksums.delixi(f"{head}03{drive.state():04X}00000000")
    if asked.function == 7:
        return checksums.delixi(f"{head}07{asked.start:04X}{drive.word(asked.start, 7):08X}")
    return frame


class ResponderLine:
    """A line with its drives and its faults.

    Each entry of `troubles` affects one request, in order: "mute" carries it out without a reply, "deaf"
    ignores it, "late" replies after the following request, and a number replies with that exception.
    `deaf_until` and `delay` (s) affect all requests.
    """

    def __init__(self, drives: Sequence[ResponderDrive]) -> None:
        self.drives = {drive.address: drive for drive in drives}
        self.log: list[ReceivedFrame] = []
        self.troubles: list[str | int] = []
        self.deaf_until = 0.0  # requests before this time are ignored, s of CLOCK_MONOTONIC
        self.delay = 0.0
        self.connection = 0
        self.mangle: Callable[[bytes], bytes] = lambda said: said  # changes each reply before it is sent
        self.held = threading.Event()  # set once replies are held back
        self._hold_in = 0  # number of requests after which replies are held back
        self._is_holding = False
        self._kept: list[bytes] = []  # the replies that are held back
        self._late = b""
        self._buffer = b""
        self._last = 0.0  # time in s at which the latest bytes came

    def hold(self, requests: int) -> None:
        """Answer this many more requests; then hold back all replies until `release` is called."""
        self.held.clear()
        self._hold_in, self._is_holding = requests + 1, False

    def release(self) -> list[bytes]:
        """Stop holding back replies; return those held so far."""
        self._hold_in, self._is_holding = 0, False
        kept, self._kept = self._kept, []
        return kept

    def reconnected(self) -> None:
        self._buffer = self._late = b""
        self.release()
        self.connection += 1

    def hear(self, received: bytes) -> list[bytes]:
        """Process received bytes; return the replies."""
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

    def _answer(self, frame: bytes, asked: DriveRequest | None) -> list[bytes]:
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


def _is_write(drive: ResponderDrive, asked: DriveRequest) -> bool:
    return asked.function in (DELIXI_WRITES if drive.kind.protocol == DELIXI else WRITES)


def _what(asked: DriveRequest | None, drives: Sequence[ResponderDrive]) -> str:
    if asked is None:
        return "damaged"
    if not drives or not _is_write(drives[0], asked):
        return "reads"
    for what, judge in (("moves", drives[0].kind.moves), ("stops", drives[0].kind.stops)):
        if judge(asked):
            return what
    return "writes"
