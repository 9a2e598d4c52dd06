"""Opening a port and carrying out exchanges on it: the one place, besides the simulator, that meets
the operating system and its clocks.
"""

from __future__ import annotations

import errno
import os
import socket
import termios
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import groupby

import serial

from multidrop.core import REFUSALS, Completions, Exchange, Port, Result, now_ns
from multidrop.errors import LineError

__all__ = ["Line", "Wake", "now_ns", "sleep", "utc_minus_monotonic_ns"]

sleep = time.sleep

_ALL_SETTINGS = sum(REFUSALS)
_BAUDRATE = min(REFUSALS)
_NO_SETTINGS = -1

_PORT_FAILURES = (OSError, termios.error, serial.SerialException, ValueError, EOFError)

_OPEN_REASONS = {
    errno.ENOENT: "there is no such port",
    errno.EACCES: "no permission to open it (is the user in the group that owns it?)",
    errno.EAGAIN: "it is in use by another program",
    errno.EBUSY: "it is in use by another program",
    errno.ENOTTY: "it is not a serial port",
    errno.ECONNREFUSED: "nothing listens there",
}


def utc_minus_monotonic_ns() -> int:
    """What to add to CLOCK_MONOTONIC to have UTC, as of now."""
    return time.time_ns() - int(now_ns())


def _reason(failure: BaseException) -> str:
    """Why, in words: pyserial hides the system's error in its own, or behind it."""
    for error in (failure, failure.__context__):
        code = error.args[0] if error and error.args else None
        if isinstance(code, int):
            return _OPEN_REASONS.get(code) or os.strerror(code)
    return str(failure)


def _lost(error: int) -> str:
    return f"the port was lost ({os.strerror(error) if error else 'hung up'})"


class Wake:
    """A descriptor that becomes readable when it is set: for select, poll or an asyncio loop."""

    def __init__(self) -> None:
        self._reader, self._writer = os.pipe()
        os.set_blocking(self._reader, False)
        os.set_blocking(self._writer, False)

    def fileno(self) -> int:
        return self._reader

    def set(self) -> None:
        with suppress(BlockingIOError):
            os.write(self._writer, b"\0")

    def clear(self) -> None:
        with suppress(BlockingIOError):
            while os.read(self._reader, 64):
                pass

    def close(self) -> None:
        os.close(self._reader)
        os.close(self._writer)


class _Bridge:
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
        with suppress(*_PORT_FAILURES):
            while request := self._ours.recv(1024):
                self._port.write(request)
        self._hang_up()

    def _in(self) -> None:
        with suppress(*_PORT_FAILURES):
            while not self._closing.is_set():
                received = self._port.read(1)  # waits for 10 ms at most
                if received:
                    self._ours.sendall(received + self._port.read_all())
        self._hang_up()

    def _hang_up(self) -> None:
        with suppress(OSError):
            self._ours.shutdown(socket.SHUT_RDWR)

    def set(self, baudrate: int, format: str) -> None:
        self._port.baudrate = baudrate
        self._port.bytesize = int(format[0])
        self._port.parity = format[1]
        self._port.stopbits = int(format[2])

    def close(self) -> None:
        self._closing.set()
        self._hang_up()
        for thread in self._threads:
            thread.join()
        self._ours.close()
        self.theirs.close()


class Line:
    """An open port. Exchanges are carried out one at a time; urgent ones go ahead of the others.

    `port` is a device or any pyserial URL. Every failure of the port is a LineError.
    """

    def __init__(self, port: str) -> None:
        self.port = port
        self._turn = threading.Condition()
        self._busy = False
        self._urgent = 0
        self._bridge: _Bridge | None = None
        self._core: Port | None = None
        self._open()

    def _open(self) -> None:
        try:
            self._serial = serial.serial_for_url(self.port, do_not_open=True)
            self._serial.timeout = 0
            if isinstance(self._serial, serial.Serial):
                self._serial.exclusive = True
            self._serial.open()
            self._core = self._drive(self._serial)
        except _PORT_FAILURES as failure:
            raise LineError(self.port, _reason(failure)) from failure

    def _drive(self, port: serial.SerialBase) -> Port:
        if type(port).read is serial.Serial.read:
            pseudo = os.ttyname(port.fileno()).startswith(("/dev/pts/", "/dev/ttys"))
            # A pty stays at 8 bits without parity whatever it is told.
            return Port(port.fileno(), _BAUDRATE if pseudo else _ALL_SETTINGS)
        if self.port.startswith("socket://"):
            fd = port.fileno()
            os.set_blocking(fd, False)
            with socket.socket(fileno=os.dup(fd)) as connection:
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return Port(fd, _NO_SETTINGS)
        self._bridge = _Bridge(port)
        return Port(self._bridge.theirs.fileno(), _NO_SETTINGS)

    def close(self) -> None:
        """Close the port; an exchange under way is finished first."""
        with self._taking_turn(urgent=True):
            self._core = None
            if self._bridge:
                self._bridge.close()
                self._bridge = None
            with suppress(*_PORT_FAILURES):
                self._serial.close()

    def reopen(self) -> None:
        """Close what is left of the port and open it again; LineError when it is not there."""
        self.close()
        with self._taking_turn(urgent=True):
            self._open()

    @contextmanager
    def _taking_turn(self, *, urgent: bool) -> Iterator[None]:
        with self._turn:
            if urgent:
                self._urgent += 1
                self._yield_now(True)
                self._turn.wait_for(lambda: not self._busy)
                self._urgent -= 1
                self._yield_now(False)
            else:
                self._turn.wait_for(lambda: not self._busy and not self._urgent)
            self._busy = True
        try:
            yield
        finally:
            with self._turn:
                self._busy = False
                self._turn.notify_all()

    def _yield_now(self, wanted: bool) -> None:
        if self._core:
            self._core.yield_now(wanted)

    def run(self, exchanges: Sequence[Exchange], completions: Completions) -> int:
        """Carry them out in turn; how many were, fewer when something urgent or a failure came between."""
        with self._taking_turn(urgent=False):
            return self._run(exchanges, completions)

    def run_urgent(self, exchange: Exchange, completions: Completions) -> None:
        """Carry one out ahead of everything else."""
        with self._taking_turn(urgent=True):
            self._run([exchange], completions)

    def _run(self, exchanges: Sequence[Exchange], completions: Completions) -> int:
        if self._core is None:
            raise LineError(self.port, "it is closed")
        if self._bridge is None:
            return self._core.run(exchanges, completions)
        (baudrate, format), group = next(groupby(exchanges, lambda exchange: exchange.settings))
        self._bridge.set(baudrate, format)
        return self._core.run(list(group), completions)

    def failure(self, result: int, error: int) -> LineError | None:
        """The error that a completion's result means for the port, if it does."""
        if result == Result.LINE_LOST:
            return LineError(self.port, _lost(error))
        if result == Result.SETTINGS_REFUSED:
            refused = ", ".join(name for bit, name in REFUSALS.items() if error & bit)
            return LineError(self.port, f"the port does not take the {refused} that the drive needs")
        return None
