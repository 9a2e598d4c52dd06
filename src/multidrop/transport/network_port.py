"""RFC2217Port: pyserial's client for serial ports on a network (RFC 2217), with limits on memory and time.

pyserial buffers received bytes without a limit, and waits for seconds until a stalled network takes a
request. This class drops bytes that come too fast, as a serial line does. It sends a request immediately
or never.
"""

from __future__ import annotations

import os
import queue
import select
import socket
import sys
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import serial
from serial import rfc2217
from serial.urlhandler.protocol_socket import Serial


class SocketPort(Serial):
    """pyserial's port for socket://, with a faster `close`: pyserial's sleeps for 300 ms."""

    _socket: socket.socket | None = None

    def close(self) -> None:
        """End the connection, so that the far end can immediately accept a new connection."""
        connection, self._socket, self.is_open = self._socket, None, False
        if connection:
            with suppress(OSError):  # the far end may have closed the connection already
                connection.shutdown(socket.SHUT_RDWR)
            connection.close()

    def reset_input_buffer(self) -> None:
        """Discard received bytes. pyserial's own uses `select`, which fails for descriptors above 1023."""
        with suppress(BlockingIOError):
            while self._socket and self._socket.recv(4096):
                pass


MOST_RECEIVED = 4096  # limit of the bytes read from the network in one call
MOST_CHUNKS = 64  # limit of the received chunks that are buffered
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
    """A serial port on a network; `port` is rfc2217://host:port."""

    # pyserial's own attributes, which its type stubs omit
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
        """Send all data without waiting. Raises SerialException if the network does not take all of it."""
        self._internal_raw_write(bytes(data).replace(_IAC, _IAC + _IAC))
        return len(data)

    def _internal_raw_write(self, data: bytes) -> None:
        if not self.is_open or not self._write_lock.acquire(timeout=LOCK_TIME):
            raise serial.SerialException("the network accepts no bytes")
        try:
            if _send_at_once(self._socket, data) < len(data):
                raise serial.SerialException("the network accepts only a part of the bytes")
        except OSError as failure:
            raise serial.SerialException(f"the connection failed: {failure}") from failure
        finally:
            self._write_lock.release()
