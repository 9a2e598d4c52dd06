"""Bridge: a descriptor for a port that pyserial gives none for, such as a network's (RFC 2217)."""

from __future__ import annotations

import socket
import termios
import threading
from contextlib import suppress

import serial

# every way in which a port can fail
PORT_FAILURES = (OSError, termios.error, serial.SerialException, ValueError, EOFError)


def set_up(port: serial.SerialBase, settings: tuple[int, str]) -> None:
    """Have pyserial set the port up, which may take it a while."""
    baudrate, format = settings
    port.baudrate = baudrate
    port.bytesize = int(format[0])
    port.parity = format[1]
    port.stopbits = int(format[2])


class Bridge:
    """A descriptor for a port that has none: a socket pair, and a thread for each direction."""

    def __init__(self, port: serial.SerialBase) -> None:
        self._port = port
        self._port.timeout = 0.01
        self._ours, self.theirs = socket.socketpair()
        self.theirs.setblocking(False)
        self._closing = threading.Event()
        self._threads = [threading.Thread(target=copy, daemon=True) for copy in (self._out, self._in)]
        for thread in self._threads:
            thread.start()

    def _out(self) -> None:
        with suppress(*PORT_FAILURES):
            while request := self._ours.recv(1024):
                self._port.write(request)
        self._hang_up()

    def _in(self) -> None:
        with suppress(*PORT_FAILURES):
            while not self._closing.is_set():
                received = self._port.read(1)  # waits for 10 ms at most
                if received:
                    self._ours.sendall(received + self._port.read_all())
        self._hang_up()

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
            thread.join()
        self.forget()
