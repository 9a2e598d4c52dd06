"""Bridge: a descriptor for a port that pyserial gives none for, such as a network's (RFC 2217)."""

from __future__ import annotations

import socket
import struct
import sys
import termios
import threading
import time
from contextlib import suppress

import serial

# every way in which a port can fail
PORT_FAILURES = (OSError, termios.error, serial.SerialException, ValueError, EOFError)

# A write's caller is told nothing before both are over (WRITE_TIMEOUT): what it is told then stays true.
MOST_STALL_MS = 750  # of a network: what it does not take within this time it never gets
MOST_AGE = 0.25  # s, of a request that leaves
MOST_CHUNK = 1024  # bytes that the core reads at once
LOOK_EVERY = 0.1  # s, until a thread sees that the bridge is closed
CLOSING_TIME = 2.0  # s, for a thread that a port holds up

# Linux keeps the requests on such a socket apart, and stamps each with the time when the core wrote it.
_STAMPED = sys.platform == "linux"
_KIND = socket.SOCK_SEQPACKET if _STAMPED else socket.SOCK_STREAM
_SO_TIMESTAMPNS = 35  # asm-generic/socket.h; also the type of what it adds, a struct timespec
_TIMESPEC = struct.Struct("@ll")


def set_up(port: serial.SerialBase, settings: tuple[int, str]) -> None:
    """Have pyserial set the port up, which may take it a while."""
    baudrate, format = settings
    port.baudrate = baudrate
    port.bytesize = int(format[0])
    port.parity = format[1]
    port.stopbits = int(format[2])


def hand_on_nothing_late(connection: socket.socket) -> None:
    """Make the kernel cut a connection that stalls, and throw away what waits when it is closed.

    What waits may start a motor. A process that dies closes its connections too.
    """
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    if hasattr(socket, "TCP_USER_TIMEOUT"):
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, MOST_STALL_MS)


class Bridge:
    """A descriptor for a port that has none: a socket pair, and a thread for each direction.

    Nothing waits in it. A request that its thread finds too late was given up meanwhile, and is thrown
    away: the process stood still, or the port held an earlier one up.
    """

    def __init__(self, port: serial.SerialBase) -> None:
        self._port = port
        self._port.timeout = 0.01
        self._ours, self.theirs = socket.socketpair(socket.AF_UNIX, _KIND)
        if _STAMPED:
            self._ours.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        self._ours.settimeout(LOOK_EVERY)
        self.theirs.setblocking(False)
        self._closing = threading.Event()
        self._threads = [threading.Thread(target=copy, daemon=True) for copy in (self._out, self._in)]
        for thread in self._threads:
            thread.start()

    def _out(self) -> None:
        with suppress(*PORT_FAILURES):
            while not self._closing.is_set():
                try:
                    request, stamps, _, _ = self._ours.recvmsg(MOST_CHUNK, socket.CMSG_SPACE(_TIMESPEC.size))
                except TimeoutError:
                    continue
                if not request:
                    break
                if _is_fresh(stamps):
                    self._port.write(request)
        self._hang_up()

    def _in(self) -> None:
        with suppress(*PORT_FAILURES):
            while not self._closing.is_set():
                received = self._port.read(1)  # waits for 10 ms at most
                if received:
                    received += self._port.read_all()
                for at in range(0, len(received), MOST_CHUNK):
                    self._hand_over(received[at : at + MOST_CHUNK])
        self._hang_up()

    def _hand_over(self, chunk: bytes) -> None:
        """Give the core what came. While it takes nothing, the port keeps what comes."""
        while chunk and not self._closing.is_set():
            with suppress(TimeoutError):
                chunk = chunk[self._ours.send(chunk) :]

    def _hang_up(self) -> None:
        with suppress(OSError):
            self._ours.shutdown(socket.SHUT_RDWR)

    def forget(self) -> None:
        """Close without hanging up: others still use it."""
        self._ours.close()
        self.theirs.close()

    def close(self) -> None:
        self._closing.set()
        self._hang_up()
        for thread in self._threads:
            thread.join(CLOSING_TIME)
        self.forget()


def _is_fresh(stamps: list[tuple[int, int, bytes]]) -> bool:
    """Return True for a request that was written just now; a doubt, as when the clock was set, is False."""
    if not _STAMPED:
        return True
    written = [_TIMESPEC.unpack(stamp) for _, kind, stamp in stamps if kind == _SO_TIMESTAMPNS]
    return any(abs(time.time() - seconds - ns / 1e9) <= MOST_AGE for seconds, ns in written)
