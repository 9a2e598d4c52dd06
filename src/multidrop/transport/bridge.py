"""Bridge: a descriptor for a port that has none of its own, such as an RFC 2217 port."""

from __future__ import annotations

import errno
import logging
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress

import serial

from multidrop.transport.aside_log import log_aside, traceback_of

try:
    import termios
except ImportError:  # Windows has no termios
    _terminal_error: type[Exception] = OSError
else:
    _terminal_error = termios.error

_log = logging.getLogger("multidrop.line")

# All exceptions that pyserial's ports may raise.
PORT_FAILURES = (OSError, _terminal_error, serial.SerialException, ValueError, EOFError)

# The next two limits are below WRITE_TIMEOUT, so that no write is sent after it was reported as unconfirmed.
MOST_STALL_MS = 750  # ms; the kernel cuts a connection that stalls for longer
MOST_AGE = 0.25  # s; an older request is not forwarded
MOST_CHUNK = 1024  # limit of the bytes that the core reads in one call
LOOK_EVERY = 0.1  # s between checks of whether the bridge is closed
CLOSING_TIME = 2.0  # s; limit of the wait for a thread that the port blocks

# On Linux the socket pair keeps requests separate, and gives the time at which the core wrote each request.
_STAMPED = sys.platform == "linux"
_KIND = socket.SOCK_SEQPACKET if _STAMPED else socket.SOCK_STREAM
_SO_TIMESTAMPNS = 35  # asm-generic/socket.h; the control message is a struct timespec
_TIMESPEC = struct.Struct("@ll")
_LINGER = "hh" if sys.platform == "win32" else "ii"  # struct linger
_TCP_MAXRTMS = 14  # mstcpip.h


def set_up(port: serial.SerialBase, settings: tuple[int, str]) -> None:
    """Set the port's baud rate and format; this may take a while."""
    baudrate, format = settings
    port.baudrate = baudrate
    port.bytesize = int(format[0])
    port.parity = format[1]
    port.stopbits = int(format[2])


def discard_late_bytes(connection: socket.socket) -> None:
    """Make the kernel discard unsent bytes when the connection stalls for MOST_STALL_MS, or is closed.

    Such bytes could start a motor, even after this process has died. A connection that stalls is cut. Windows
    before 11 may not support this timeout, and then cuts the connection when its own retransmissions end.
    """
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack(_LINGER, 1, 0))
    if hasattr(socket, "TCP_USER_TIMEOUT"):
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, MOST_STALL_MS)
    elif sys.platform == "win32":
        with suppress(OSError):
            connection.setsockopt(socket.IPPROTO_TCP, _TCP_MAXRTMS, MOST_STALL_MS)


def _pair() -> tuple[socket.socket, socket.socket]:
    if hasattr(socket, "AF_UNIX"):
        return socket.socketpair(socket.AF_UNIX, _KIND)
    pair = socket.socketpair()  # on Windows a TCP connection, so disable its delay of small packets
    for end in pair:
        end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return pair


class Bridge:
    """A descriptor for a port that has none: a socket pair, and a thread for each direction.

    A request older than MOST_AGE is discarded, not forwarded: the core has already given it up. A request
    gets that old if the process was suspended, or if the port blocked its thread.
    """

    def __init__(self, port: serial.SerialBase) -> None:
        self._port = port
        self._port.timeout = 0.01
        self._ours, self.theirs = _pair()
        if _STAMPED:
            self._ours.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        self._ours.settimeout(LOOK_EVERY)
        self.theirs.setblocking(False)
        self._closing = threading.Event()
        self._threads: list[threading.Thread] = []
        try:
            for copy in (self._out, self._in):
                thread = threading.Thread(
                    target=self._run, args=(copy,), name="multidrop bridge", daemon=True
                )
                thread.start()
                self._threads.append(thread)
        except RuntimeError as failure:  # the system's thread limit is reached
            self.close()
            raise OSError(errno.ENOMEM, str(failure)) from failure

    def _run(self, copy: Callable[[], None]) -> None:
        """Copy in one direction until the port fails; then hang up, so that the core sees a lost port."""
        try:
            copy()
        except PORT_FAILURES:
            pass  # the line logs that the port was lost
        except BaseException as failure:
            log_aside(_log, logging.ERROR, "%s: it failed\n%s", self._port.port, traceback_of(failure))
        finally:
            self._hang_up()

    def _out(self) -> None:
        while not self._closing.is_set():
            try:
                request, is_fresh = self._take()
            except TimeoutError:
                continue
            if not request:
                break
            if is_fresh:
                self._port.write(request)

    def _take(self) -> tuple[bytes, bool]:
        """Return a request of the core, and whether it is fresh (always True if there are no time stamps)."""
        if not _STAMPED:
            return self._ours.recv(MOST_CHUNK), True
        request, stamps, _, _ = self._ours.recvmsg(MOST_CHUNK, socket.CMSG_SPACE(_TIMESPEC.size))
        return request, _is_fresh(stamps)

    def _in(self) -> None:
        while not self._closing.is_set():
            received = self._port.read(1)  # waits for 10 ms at most
            if received:
                received += self._port.read_all()
            for at in range(0, len(received), MOST_CHUNK):
                self._hand_over(received[at : at + MOST_CHUNK])

    def _hand_over(self, chunk: bytes) -> None:
        """Pass these bytes to the core. Until the core has read them, further bytes stay in the port."""
        while chunk and not self._closing.is_set():
            with suppress(TimeoutError):
                chunk = chunk[self._ours.send(chunk) :]

    def _hang_up(self) -> None:
        with suppress(OSError):
            self._ours.shutdown(socket.SHUT_RDWR)

    def forget(self) -> None:
        """Close both ends of the pair without hanging up: the parent of a fork still uses the connection."""
        self._ours.close()
        self.theirs.close()

    def close(self) -> None:
        self._closing.set()
        self._hang_up()
        for thread in self._threads:
            thread.join(CLOSING_TIME)
        self.forget()


def _is_fresh(stamps: list[tuple[int, int, bytes]]) -> bool:
    """Return True if the request is at most MOST_AGE s old; False if the clock was changed since."""
    written = [_TIMESPEC.unpack(stamp) for _, kind, stamp in stamps if kind == _SO_TIMESTAMPNS]
    return any(abs(time.time() - seconds - ns / 1e9) <= MOST_AGE for seconds, ns in written)
