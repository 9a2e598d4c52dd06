"""Connections of drive vendors' PC tools, by pseudo-terminal or TCP, and the RTU requests in their bytes."""

from __future__ import annotations

import os
import socket
from contextlib import suppress
from pathlib import Path
from typing import Protocol

from multidrop.core import FrameFault, Framing, crc16, parse_request
from multidrop.gateway.modbus_server.protocol import MbapRequest
from multidrop.recording import FileLock

MOST_READ = 256  # limit, in bytes, of one read from a connection
_DEVICES = "/dev/pts/"
# Each link that a gateway makes points to a path that starts with this text. So gateways recognise their
# links and replace no others. Links are made and read with `os`, because a Path would drop the ".".
_OURS = "/dev/pts/./"
LEAST_FRAME, MOST_FRAME = 4, 256  # limits, in bytes, of an RTU frame: address, function code, data, checksum
EXCEPTION = 0x80  # bit of a function code that is set only in exception replies
_CHECKSUM = 2
_MBAP = 6  # number of bytes before the unit id in a Modbus TCP frame


class End(Protocol):
    """The gateway's side of a connection to a vendor's PC tool."""

    @property
    def address(self) -> str:
        """The PC tool's address as text, for log messages: a path or an IP address."""

    def fileno(self) -> int: ...
    def read(self) -> bytes | None:
        """Return received bytes; None if there are none, b"" if the tool has disconnected."""

    def write(self, data: bytes) -> None:
        """Send bytes; drop them if the tool does not read fast enough."""

    def discard(self) -> None:
        """Drop the sent bytes that the PC tool has not read. Over TCP this does nothing."""

    def close(self) -> None: ...


class Terminal:
    """A pseudo-terminal that vendors' PC tools open through a symbolic link.

    This object keeps the tool's side open, so that the pseudo-terminal still exists after a tool has closed
    it. The baud rate and format that a tool sets have no effect. A lock on a file beside the link shows that
    the gateway that made the link runs. An existing link is replaced only if its gateway was killed.

    Raises OSError if the link cannot be made, or if its path is in use.
    """

    def __init__(self, link: Path) -> None:
        self.address = str(link)
        self._target = ""
        self._is_open = True
        self._lock: FileLock | None = None
        self._master, self._slave = os.openpty()
        try:
            self._lock = FileLock(link.with_name(f".{link.name}.lock"))
            os.set_blocking(self._master, False)
            self._make_raw()
            self._target = _OURS + os.ttyname(self._slave).removeprefix(_DEVICES)
            if is_ours(link):
                link.unlink()
            os.symlink(self._target, link)  # noqa: PTH211
        except OSError as failure:
            self._close_descriptors()
            why = {
                FileExistsError: "a file of this name exists, and no gateway made it",
                BlockingIOError: "another gateway uses this link",
            }.get(type(failure), failure.strerror)
            raise OSError(f"pty: the link {link} cannot be made: {why}") from failure

    def fileno(self) -> int:
        return self._master

    def read(self) -> bytes | None:
        try:
            return os.read(self._master, MOST_READ)
        except BlockingIOError:
            return None

    def write(self, data: bytes) -> None:
        self._make_raw()
        with suppress(BlockingIOError):
            os.write(self._master, data)

    def discard(self) -> None:
        import termios

        termios.tcflush(self._slave, termios.TCIFLUSH)

    def _make_raw(self) -> None:
        """Turn echo and translation of bytes off.

        With echo, the gateway would receive its own reply to a write as a second write.
        """
        import termios
        import tty

        input_flags, output_flags, _, local_flags, *_ = termios.tcgetattr(self._slave)
        translates = input_flags & (termios.ICRNL | termios.IXON | termios.ISTRIP | termios.INLCR)
        if translates or output_flags & termios.OPOST or local_flags & (termios.ECHO | termios.ICANON):
            tty.setraw(self._slave, termios.TCSANOW)

    def close(self) -> None:
        """Close the pseudo-terminal, and remove the link if it still points to this pseudo-terminal."""
        if not self._is_open:
            return
        self._is_open = False
        with suppress(OSError):
            if os.readlink(self.address) == self._target:  # noqa: PTH115
                Path(self.address).unlink()
        self._close_descriptors()

    def _close_descriptors(self) -> None:
        os.close(self._master)
        os.close(self._slave)
        if self._lock is not None:
            self._lock.close()


def is_ours(link: Path) -> bool:
    """Return True if a gateway made this link."""
    return link.is_symlink() and os.readlink(link).startswith(_OURS)  # noqa: PTH115


class Connection:
    """The TCP connection of a vendor's PC tool."""

    def __init__(self, peer: socket.socket, address: str) -> None:
        self.address = address
        self._peer = peer
        peer.setblocking(False)
        peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def fileno(self) -> int:
        return self._peer.fileno()

    def read(self) -> bytes | None:
        try:
            return self._peer.recv(MOST_READ)
        except BlockingIOError:
            return None
        except OSError:
            return b""

    def write(self, data: bytes) -> None:
        with suppress(OSError):  # the tool has disconnected, which `read` reports
            self._peer.send(data)

    def discard(self) -> None:
        """Do nothing, because bytes that were sent over TCP cannot be taken back."""

    def close(self) -> None:
        self._peer.close()


# ---- requests ----


class RequestCutter:
    """Collects the bytes that a PC tool sends, and returns whole requests.

    Source: MODBUS over Serial Line V1.02, section 2.5.1. On a serial line, silence separates frames. The
    silence is lost in a pseudo-terminal and in TCP, so a frame is recognised by its length and checksum.
    """

    def __init__(self) -> None:
        self._came = bytearray()
        self._is_in_step = True  # False while the start of the next request is unknown

    def add(self, data: bytes) -> None:
        self._came += data

    def take(self) -> MbapRequest | None:
        """Remove the first complete request and return it; None if there is none.

        Bytes before it that belong to no request are dropped.
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
        """True if bytes of an incomplete request are waiting for the rest of the request."""
        return bool(self._came)

    def skip(self) -> bool:
        """Drop the first byte, because the request that starts there was never completed.

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
    # The length of a request with an unknown function is unknown. But the client sends nothing more until it
    # gets the reply, so all received bytes belong to this request.
    if not is_in_step or came[1] >= EXCEPTION or len(came) > MOST_FRAME:
        return 0
    return None if crc16(bytes(came), len(came)) else len(came)


def rtu_reply(frame: bytes) -> bytes:
    """Return an RTU frame with the contents of a Modbus TCP frame."""
    body = frame[_MBAP:]
    return body + int(crc16(body, len(body))).to_bytes(2, "little")
