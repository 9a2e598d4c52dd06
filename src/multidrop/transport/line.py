"""Opening a port and carrying out exchanges on it: the one place, besides the simulator, that meets
the operating system and its clocks.
"""

from __future__ import annotations

import errno
import fcntl
import os
import socket
import struct
import threading
from contextlib import suppress
from typing import cast
from urllib.parse import urlsplit

import serial

from multidrop.core import (
    REFUSALS,
    Completion,
    Echo,
    Exchange,
    Failure,
    Peer,
    Port,
    Tap,
)
from multidrop.core.fork import register_at_fork
from multidrop.errors import LineError, NoSuchPort, PortLost
from multidrop.transport import port_identity
from multidrop.transport.bridge import PORT_FAILURES, Bridge, hand_on_nothing_late, set_up
from multidrop.transport.rfc2217 import RFC2217Port

_ALL_SETTINGS = sum(REFUSALS)
_BAUDRATE = min(REFUSALS)
_NO_SETTINGS = -1

# struct serial_icounter_struct of linux/serial.h
_TIOCGICOUNT = 0x545D
_ICOUNTER = struct.Struct("20i")
_OVERRUN, _BUF_OVERRUN = 7, 10

_OPEN_REASONS = {
    errno.ENOENT: "there is no such port",
    errno.EACCES: "no permission to open it (is the user in the group that owns it?)",
    errno.EAGAIN: "it is in use by another program",
    errno.EBUSY: "it is in use by another program",
    errno.ENOTTY: "it is not a serial port",
    errno.EISDIR: "it is a directory, not a serial port",
    errno.ECONNREFUSED: "nothing listens there",
}


def reason_of(failure: BaseException) -> str:
    """Why, in words: pyserial hides the system's error in its own, or behind it."""
    for error in (failure, failure.__context__):
        if isinstance(error, socket.gaierror):
            return error.strerror or str(error)
        code = error.args[0] if error and error.args else None
        if isinstance(code, int):
            return _OPEN_REASONS.get(code) or os.strerror(code)
    return str(failure)


def unopened(port: str) -> serial.Serial:
    """The port, not opened yet. Raises TypeError, and NoSuchPort for a URL that no port can have."""
    if not isinstance(port, str):
        raise TypeError(f"a port is a device such as '/dev/ttyUSB0' or a pyserial URL, not {port!r}")
    try:
        url = urlsplit(port)
        needs_place = url.scheme in ("socket", "rfc2217") and not (url.hostname and url.port)
    except ValueError as mistake:
        raise NoSuchPort(port, str(mistake)) from mistake
    if needs_place:
        raise NoSuchPort(port, f"it needs a host and a port number, such as {url.scheme}://10.0.0.7:4001")
    try:
        if url.scheme == "rfc2217":
            found = RFC2217Port()
            found.port = port
            return cast(serial.Serial, found)  # as pyserial types all of its kinds of ports
        return serial.serial_for_url(port, do_not_open=True)
    except ValueError as mistake:
        right = "socket://10.0.0.7:4001 or rfc2217://10.0.0.7:4001"
        raise NoSuchPort(port, f"there is no {url.scheme}://; a URL is such as {right}") from mistake


class Line:
    """An open port on which exchanges are carried out, urgent ones ahead of those that are queued.

    `port` is a device or any pyserial URL. Every failure of the port is a LineError.
    """

    def __init__(self, port: str, echo: Echo = Echo.AUTO) -> None:
        self.port = port
        self.identity = port  # what it is, however its name is spelt, once it is open
        self._echo = echo
        self._bridge: Bridge | None = None
        self._settings: tuple[int, str] | None = None  # that a bridged port must have
        self._core: Port | None = None  # dropped before the descriptor that it looks at
        self._serial: serial.SerialBase | None = None
        self._tap: Tap | None = None
        self._make_locks()
        register_at_fork(self)
        self._open()

    def _make_locks(self) -> None:
        self._lock = threading.RLock()  # one opens or closes at a time
        self._waiting = 0  # callers that wait for an exchange
        self._left = threading.Condition(self._lock)  # one of them has left

    def forked(self) -> None:
        """In the child it is closed, at once: a descriptor left open there would keep the port in use."""
        self._make_locks()
        self._is_over = True
        self._why_closed = "it was opened before this process was forked; open it again here"
        self._core = None
        if self._bridge:
            self._bridge.forget()
            self._bridge = None
        # Of a network port the socket alone: pyserial would end the connection, which the parent has too.
        port = getattr(self._serial, "_socket", self._serial)
        if port:
            with suppress(*PORT_FAILURES):
                port.close()

    def _open(self) -> None:
        self._why_closed = "it is closed"
        self._is_over = False
        try:
            port = self._serial = unopened(self.port)
            port.timeout = 0
            if isinstance(port, serial.Serial):
                port.exclusive = True
            port.open()
            self.identity = self._identify(port)
            self._core = self._drive(port)
            self._core.tell_echo(self._echo)
            if self._tap:
                self._core.tap(self._tap)
            with suppress(*PORT_FAILURES, AttributeError, NotImplementedError):
                port.set_low_latency_mode(True)  # a USB adapter else holds bytes back for 16 ms
        except NoSuchPort:
            raise
        except PORT_FAILURES as failure:
            self._let_go()
            raise LineError(self.port, reason_of(failure)) from failure

    def _identify(self, port: serial.SerialBase) -> str:
        if connection := getattr(port, "_socket", None):
            return port_identity.of_connection(connection)
        try:
            return port_identity.of_device(os.ttyname(port.fileno()))
        except (OSError, ValueError, AttributeError):  # it has no device, as loop:// has none
            return port_identity.of_name(self.port)

    def _drive(self, port: serial.SerialBase) -> Port:
        if type(port).read is serial.Serial.read:
            pseudo = os.ttyname(port.fileno()).startswith(("/dev/pts/", "/dev/ttys"))
            # A pty stays at 8 bits without parity whatever it is told.
            return Port(port.fileno(), _BAUDRATE if pseudo else _ALL_SETTINGS)
        if connection := getattr(port, "_socket", None):
            hand_on_nothing_late(connection)
        if self.port.startswith("socket://"):
            os.set_blocking(port.fileno(), False)
            return Port(port.fileno(), _NO_SETTINGS)
        if self._settings:
            set_up(port, self._settings)
        self._bridge = Bridge(port)
        return Port(self._bridge.theirs.fileno(), _NO_SETTINGS)

    def drop(self) -> None:
        """Carry out nothing more; what is queued and not yet sent never will be. The port itself, which

        may take its time, is closed by `close` or `reopen`.
        """
        with self._lock:
            core, self._core = self._core, None
            if core:
                core.stop()
                if self._left.wait_for(lambda: not self._waiting, timeout=1.0):
                    core.close()  # nobody looks at it any more

    def close(self) -> None:
        """Drop the port and close it; no `regain` opens it any more."""
        with self._lock:
            self._is_over = True
            self._let_go()

    def _let_go(self) -> None:
        with self._lock:
            self.drop()
            if self._bridge:
                self._bridge.close()
                self._bridge = None
            if self._serial:
                connection = getattr(self._serial, "_socket", None)
                with suppress(*PORT_FAILURES):
                    self._serial.close()
                if connection:  # pyserial leaves one open that has ended already
                    connection.close()

    def tap(self, tap: Tap) -> None:
        """Tell this tap, and no other any more, of all that goes over the line."""
        with self._lock:
            self._tap = tap
            if self._core:
                self._core.tap(tap)

    def reopen(self) -> None:
        """Close what is left of the port and open it again; LineError when it is not there."""
        with self._lock:
            self._let_go()
            self._open()

    @property
    def is_lost(self) -> bool:
        """It failed, and was neither opened again nor closed since."""
        core = self._core
        return not self._is_over and (core is None or core.lost)

    def regain(self) -> None:
        """Open it again if it is lost; PortLost when it is not there, and LineError once it was closed."""
        with self._lock:
            if self._is_over:
                raise LineError(self.port, self._why_closed)
            if not self.is_lost:
                return
            try:
                self.reopen()
            except LineError as failure:
                raise PortLost(self.port, failure.reason) from failure

    def require(self, settings: tuple[int, str]) -> None:
        """Exchanges with these settings will come: a port that is bridged can only have one kind of them.

        Raises LineError when it has others already, or does not take these.
        """
        with self._lock:
            if self._serial is None or self._bridge is None or self._settings == settings:
                return
            if self._settings:
                raise LineError(self.port, "this kind of port cannot change its settings from drive to drive")
            try:
                set_up(self._serial, settings)
            except PORT_FAILURES as failure:
                raise LineError(self.port, reason_of(failure)) from failure
            self._settings = settings

    def inherit(self, peer: Peer, before: Peer) -> None:
        """Have a drive take the place of another at its address, whose answers may still come."""
        with self._lock:
            if self._core:
                self._core.inherit(peer, before)
            else:
                peer.inherit(before)

    def _opened(self, settings: tuple[int, str]) -> Port:
        if self._core is None:
            raise self._closed()
        self.require(settings)
        return self._core

    def carry_out(self, exchange: Exchange, *, not_before_ns: int = 0, expires_ns: int = 0) -> Completion:
        """Carry an exchange out ahead of what is queued, and wait for it; LineError when the port fails."""
        if self._core is None:  # at once, also while it is being opened again
            raise self._closed()
        with self._lock:
            core = self._opened(exchange.settings)
            self._waiting += 1
        try:
            found = core.carry_out(exchange, not_before_ns=not_before_ns, expires_ns=expires_ns)
            waits_in_vain = found.result == Failure.LATE_ANSWER_DUE and core.lost
        finally:
            with self._lock:
                self._waiting -= 1
                self._left.notify_all()
        failure = self._failure(Failure.LINE_LOST if waits_in_vain else found.result, found.error)
        if failure:
            failure.is_sent = found.sent_ns > 0
            raise failure
        return found

    def _failure(self, result: int, error: int) -> LineError | None:
        if result == Failure.LINE_LOST and self._core is None:
            return self._closed()
        if result == Failure.LINE_LOST:
            return PortLost(self.port, f"the port was lost ({os.strerror(error) if error else 'hung up'})")
        if result == Failure.SETTINGS_REFUSED:
            refused = ", ".join(name for bit, name in REFUSALS.items() if error & bit)
            return LineError(self.port, f"the port does not take the {refused} that the drive needs")
        return None

    def _closed(self) -> LineError:
        return (LineError if self._is_over else PortLost)(self.port, self._why_closed)

    def overruns(self) -> int | None:
        """Characters that came too fast for the port, since its driver was loaded.

        None while it is closed, and where the driver does not count them.
        """
        counts = bytearray(_ICOUNTER.size)
        try:
            if self._bridge or not self._serial:
                return None
            fcntl.ioctl(self._serial.fileno(), _TIOCGICOUNT, counts)
        except (*PORT_FAILURES, TypeError, AttributeError):  # it may be closed meanwhile
            return None
        found = _ICOUNTER.unpack(counts)
        return int(found[_OVERRUN] + found[_BUF_OVERRUN])

    @property
    def has_echo(self) -> bool:
        """The adapter is known to repeat what is sent."""
        return self._core is not None and self._core.has_echo

    @property
    def queue(self) -> Port | None:
        """The core's port, for whoever keeps it busy; None while it is closed."""
        return self._core
