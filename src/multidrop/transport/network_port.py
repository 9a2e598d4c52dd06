"""Ports on a network: their connections, RFC 2217, and a bridge that gives a port a descriptor."""

from __future__ import annotations

import errno
import logging
import os
import queue
import select
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any
from urllib.parse import urlsplit

import serial
from serial import rfc2217
from serial.urlhandler.protocol_socket import Serial

from multidrop.core import crc16
from multidrop.drive.line_settings import MODBUS_PORT
from multidrop.transport.aside_log import log_aside, traceback_of


class SocketPort(Serial):
    """pyserial's port for socket://, with a faster `close`: pyserial's own method sleeps for 300 ms."""

    _socket: socket.socket | None = None

    def close(self) -> None:
        """End the connection, so that the far end can immediately accept a new connection."""
        connection, self._socket, self.is_open = self._socket, None, False
        if connection:
            with suppress(OSError):  # the far end may have closed the connection already
                connection.shutdown(socket.SHUT_RDWR)
            connection.close()

    def reset_input_buffer(self) -> None:
        """Discard received bytes. pyserial's own method uses select, which fails above descriptor 1023."""
        with suppress(BlockingIOError):
            while self._socket and self._socket.recv(4096):
                pass


MOST_RECEIVED = 4096  # limit of the bytes read from the network in one call
MOST_CHUNKS = 64  # limit of the chunks of received bytes that are buffered
MOST_SUBOPTION = 256  # bytes; RFC 2217's suboptions are short, except the signature
LOCK_TIME = 0.1  # s; how long a write waits for the reading thread to answer a telnet option

_IAC, _SB, _SE = rfc2217.IAC, rfc2217.SB, rfc2217.SE
_NEGOTIATIONS = (rfc2217.DO, rfc2217.DONT, rfc2217.WILL, rfc2217.WONT)


class Telnet:
    """Parser that splits a telnet stream (RFC 854), received in any pieces, into data and commands."""

    def __init__(self) -> None:
        self._command = b""  # the received part of an incomplete command
        self._suboption: bytearray | None = None

    def split(self, received: bytes) -> Iterator[tuple[bytes, bytes]]:
        """Yield pairs in the order of the stream: (b"", data), (command, option) or (SB, suboption)."""
        at = 0
        while at < len(received):
            if self._command:
                self._command += received[at : at + 1]
                at += 1
                yield from self._obey()
                continue
            end = received.find(_IAC, at)
            data = received[at : end if end >= 0 else len(received)]
            yield from self._take(data)
            at += len(data)
            if end >= 0:
                self._command = _IAC
                at += 1

    def _take(self, data: bytes) -> Iterator[tuple[bytes, bytes]]:
        if self._suboption is None:
            if data:
                yield b"", data
            return
        self._suboption += data
        if len(self._suboption) > MOST_SUBOPTION:
            self._suboption = None

    def _obey(self) -> Iterator[tuple[bytes, bytes]]:
        kind, option = self._command[1:2], self._command[2:]
        if kind in _NEGOTIATIONS and not option:
            return
        self._command = b""
        if kind == _IAC:
            yield from self._take(_IAC)
        elif kind == _SB:
            self._suboption = bytearray()
        elif kind == _SE:
            if self._suboption is not None:
                yield _SB, bytes(self._suboption)
            self._suboption = None
        else:
            yield kind, option


def _send_at_once(connection: socket.socket, data: bytes) -> int:
    """Send without waiting, unlike socket.send(); return the number of bytes sent."""
    if sys.platform != "win32":
        return os.write(connection.fileno(), data)
    return connection.send(data) if select.select([], [connection], [], 0)[1] else 0


class RFC2217Port(rfc2217.Serial):
    """A serial port on a network (RFC 2217); `port` is rfc2217://host:port.

    pyserial's own class buffers received bytes without a limit, and waits for seconds until a stalled network
    takes a request. This class drops bytes that come too fast, as a serial line does. It sends a request
    immediately or not at all.
    """

    # attributes of pyserial's class that its type stubs omit
    _socket: Any
    _write_lock: Any
    _read_buffer: Any
    _telnet_process_subnegotiation: Any
    _telnet_negotiate_option: Any

    def _telnet_read_loop(self) -> None:
        """Read the socket until the connection ends; pyserial runs this on its own thread."""
        self._read_buffer = queue.Queue(MOST_CHUNKS)
        telnet = Telnet()
        with suppress(OSError):
            while self.is_open:
                try:
                    received = self._socket.recv(MOST_RECEIVED)
                except TimeoutError:
                    continue
                if not received:
                    break
                for kind, content in telnet.split(received):
                    self._act(kind, content)
        with suppress(queue.Full):
            self._read_buffer.put_nowait(None)

    def _act(self, kind: bytes, content: bytes) -> None:
        if not kind:
            with suppress(queue.Full):
                self._read_buffer.put_nowait(content)
        elif kind == _SB:
            self._telnet_process_subnegotiation(content)
        elif kind in _NEGOTIATIONS:
            self._telnet_negotiate_option(kind, content)

    def write(self, data: Any) -> int:
        """Send all data without waiting. Raises SerialException if the network does not take all data."""
        self._internal_raw_write(bytes(data).replace(_IAC, _IAC + _IAC))
        return len(data)

    def _internal_raw_write(self, data: bytes) -> None:
        if not self.is_open or not self._write_lock.acquire(timeout=LOCK_TIME):
            raise serial.SerialException("the network connection accepts no bytes")
        try:
            if _send_at_once(self._socket, data) < len(data):
                raise serial.SerialException("the network connection accepted only a part of the bytes")
        except OSError as failure:
            raise serial.SerialException(f"the connection failed: {failure}") from failure
        finally:
            self._write_lock.release()


# ---- Modbus TCP (tcp://) and RTU over TCP (socket://) confused in a port's name ----
#
# A gateway is set to one protocol. To requests of the other protocol it is silent, or replies with
# junk.


_HEAD = 6  # bytes of Modbus TCP's header before the unit id
_LEAST, _MOST_RTU = 5, 256  # least and greatest length of an RTU reply in bytes; an exception is the shortest
_OTHER = {"socket": "tcp", "tcp": "socket"}
_SPOKEN = {"socket": "RTU over TCP", "tcp": "Modbus TCP"}


def other_port(port: str) -> str:
    """Return the socket:// URL for a tcp:// port, and vice versa; "" for other kinds of ports."""
    url = urlsplit(port)
    if url.scheme not in _OTHER:
        return ""
    place = url.netloc if url.port else f"{url.netloc}:{MODBUS_PORT}"
    return f"{_OTHER[url.scheme]}://{place}"


def spoken_on(port: str) -> str:
    """Return the name of the protocol that multidrop speaks on a tcp:// or socket:// port."""
    return _SPOKEN[urlsplit(port).scheme]


def mixed_up(port: str, received: bytes) -> str:
    """Return a hint for the user if RTU bytes came on a tcp:// port, or Modbus TCP on socket://; else ""."""
    other = other_port(port)
    is_shaped = other and (_is_tcp(received) if other.startswith("tcp") else _is_rtu(received))
    if not is_shaped:
        return ""
    return f"; this looks like {spoken_on(other)}: name the port {other} in place of {port}"


def silence_hint(port: str) -> str:
    """Return a hint for the user of a silent tcp:// or socket:// port; "" for other kinds of ports."""
    other = other_port(port)
    if not other:
        return ""
    return (
        f", and whether the far end speaks {spoken_on(port)}: else name the port {other} "
        "(`multidrop doctor` tries)"
    )


def _is_tcp(received: bytes) -> bool:
    """Return True if the bytes are exactly one Modbus TCP frame."""
    announced = int.from_bytes(received[4:6])
    return len(received) > _HEAD + 2 and received[2:4] == b"\0\0" and announced == len(received) - _HEAD


def _is_rtu(received: bytes) -> bool:
    """Return True if the bytes start with an RTU frame."""
    ends = range(_LEAST, min(len(received), _MOST_RTU) + 1)
    return any(crc16(received[:end], end) == 0 for end in ends)


# ---- bridges ----


try:
    import termios
except ImportError:  # Windows has no termios
    _terminal_error: type[Exception] = OSError
else:
    _terminal_error = termios.error

_log = logging.getLogger("multidrop.line")

# All exceptions that pyserial's ports may raise.
PORT_FAILURES = (OSError, _terminal_error, serial.SerialException, ValueError, EOFError)

# MOST_STALL_MS and MOST_AGE are below WRITE_TIMEOUT: no write is sent after it was reported as unconfirmed.
MOST_STALL_MS = 750  # ms; the kernel cuts a connection that stalls for longer
MOST_AGE = 0.25  # s; the bridge does not forward a request older than this
MOST_CHUNK = 1024  # limit of the bytes that the C core reads in one call
LOOK_EVERY = 0.1  # s between checks whether the bridge was closed
CLOSING_TIME = 2.0  # s; limit of the wait for the bridge's threads, which the port may block

# On Linux the socket pair keeps requests separate, and gives the time at which the C core wrote each request.
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
    # on Windows the pair is a TCP connection, so its delay of small packets is disabled
    pair = socket.socketpair()
    for end in pair:
        end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return pair


class Bridge:
    """A descriptor for a port that has none: a socket pair, and a thread for each direction.

    A request older than MOST_AGE is discarded, not forwarded: the C core has already given it up. A request
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
        """Copy bytes one way until the port fails; then hang up, so that the C core sees a lost port."""
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
        """Return a request of the C core, and True if it is younger than MOST_AGE or has no time stamp."""
        if not _STAMPED:
            return self._ours.recv(MOST_CHUNK), True
        request, stamps, _, _ = self._ours.recvmsg(MOST_CHUNK, socket.CMSG_SPACE(_TIMESPEC.size))
        return request, _is_fresh(stamps)

    def _in(self) -> None:
        while not self._closing.is_set():
            received = self._port.read(1)  # this read waits for at most 10 ms
            if received:
                received += self._port.read_all()
            for at in range(0, len(received), MOST_CHUNK):
                self._hand_over(received[at : at + MOST_CHUNK])

    def _hand_over(self, chunk: bytes) -> None:
        """Pass these bytes to the C core. Until the C core has read them, further bytes stay in the port."""
        while chunk and not self._closing.is_set():
            with suppress(TimeoutError):
                chunk = chunk[self._ours.send(chunk) :]

    def _hang_up(self) -> None:
        with suppress(OSError):
            self._ours.shutdown(socket.SHUT_RDWR)

    def forget(self) -> None:
        """Close both ends of the pair, but do not hang up: a fork's parent still uses the connection."""
        self._ours.close()
        self.theirs.close()

    def close(self) -> None:
        self._closing.set()
        self._hang_up()
        for thread in self._threads:
            thread.join(CLOSING_TIME)
        self.forget()


def _is_fresh(stamps: list[tuple[int, int, bytes]]) -> bool:
    """Return True if the request's timestamp is at most MOST_AGE s from the present time.

    It is farther away if the request is old, or if the clock was set after the request was sent.
    """
    written = [_TIMESPEC.unpack(stamp) for _, kind, stamp in stamps if kind == _SO_TIMESTAMPNS]
    return any(abs(time.time() - seconds - ns / 1e9) <= MOST_AGE for seconds, ns in written)
