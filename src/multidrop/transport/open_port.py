"""Open a port by its name, and give its descriptor to the C core."""

from __future__ import annotations

import errno
import os
import re
import socket
import struct
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import cast
from urllib.parse import SplitResult

import serial

from multidrop.core import (
    NO_DIVISOR,
    RS485,
    Failure,
    Mastership,
    Port,
    TransactionIds,
    close_behind,
    is_pseudo_terminal,
    must_take,
    possible_rates,
    refused_names,
)
from multidrop.drive.line_settings import MODBUS_PORT, SCHEMES, URLS, speaks_tcp, url_of
from multidrop.errors import LineError, NoSuchPort
from multidrop.transport import clock, port_identity
from multidrop.transport.network_port import (
    PORT_FAILURES,
    Bridge,
    RFC2217Port,
    SocketPort,
    discard_late_bytes,
    mixed_up,
    set_up,
)
from multidrop.transport.port_identity import PseudoTerminal, USBAdapter, adapter_of, pseudo_terminal_of

# struct serial_icounter_struct of linux/serial.h
_TIOCGICOUNT = 0x545D
_ICOUNTER = struct.Struct("20i")
_OVERRUN, _BUF_OVERRUN = 7, 10


def overruns(fd: int) -> int:
    """Return how many received characters the UART has lost (overruns) since its driver was loaded.

    Raises OSError if the driver does not count them.
    """
    if sys.platform != "linux":
        raise OSError("lost characters (overruns) are counted only on Linux")
    import fcntl  # Windows lacks this module

    counts = bytearray(_ICOUNTER.size)
    fcntl.ioctl(fd, _TIOCGICOUNT, counts)
    found = _ICOUNTER.unpack(counts)
    return int(found[_OVERRUN] + found[_BUF_OVERRUN])


_REASONS = {
    errno.ENOENT: "there is no such port",
    errno.EACCES: "no permission to open it (is the user in the group that owns it?)",
    errno.EAGAIN: "it is in use by this or another program",
    errno.EBUSY: "it is in use by this or another program",
    errno.ENOTTY: "it is not a serial port",
    errno.EIO: "it does not work: there is no UART behind this name, or its adapter failed",
    errno.EISDIR: "it is a directory, not a serial port",
    errno.ECONNREFUSED: "nothing listens there",
}

# pyserial keeps only the text of a Windows error: could not open port 'COM5': PermissionError(13, ...)
_WINDOWS_ERROR = re.compile(r"Error\((\d+), ")
_WINDOWS_REASONS = {
    errno.EACCES: _REASONS[errno.EBUSY],  # a COM port is open in another program
    errno.EBADF: _REASONS[errno.ENOTTY],
}


def reason_of(failure: BaseException) -> str:
    """Return the cause of a failure in words, from the system's error inside pyserial's exception."""
    for error in (failure, failure.__context__):
        if isinstance(error, socket.gaierror):
            return error.strerror or str(error)
        code = error.args[0] if error and error.args else None
        if isinstance(code, int):
            return _REASONS.get(code) or os.strerror(code)
    if windows := _WINDOWS_ERROR.search(str(failure)):
        code = int(windows[1])
        return _WINDOWS_REASONS.get(code) or _REASONS.get(code) or os.strerror(code)
    return str(failure)


def is_lost_by(result: int, port: Port) -> bool:
    """Return True if this result means that the exchange ended because its port was lost."""
    is_lost = result in (Failure.LINE_LOST, Failure.SETTINGS_REFUSED)
    return is_lost or (result == Failure.LATE_ANSWER_DUE and port.lost)


STALLED = "stalled: its adapter takes no bytes"
# errnos that an unplugged device causes; 0: the far end hung up
_UNPLUGGED = (0, errno.EIO, errno.ENODEV, errno.ENXIO)


def why_lost(port: str, error: int, received: bytes = b"") -> str:
    """Return why a port was lost, from the errno of its descriptor (0: the far end hung up)."""
    if "://" not in port:
        if error == errno.ETIMEDOUT:
            return STALLED
        if error in _UNPLUGGED and not Path(port).exists() and not is_pseudo_terminal(os.path.realpath(port)):
            return "unplugged"
    if error != errno.EPROTO:
        return os.strerror(error) if error else "hung up"
    shown = received[:16].hex(" ").upper() or "a damaged header"
    return f"the received bytes are not Modbus TCP: {shown}{mixed_up(port, received)}"


_HOST_AND_PORT = re.compile(r"[\w.-]+:\d+")  # an address without a scheme, such as 10.0.0.7:502

# pyserial's URLs, allowed only without options: spy://DEVICE?file=PATH would empty a file
_FOR_PROGRAMS = ("loop", "spy")


def _socket_url(url: SplitResult) -> str:
    host = f"[{url.hostname}]" if ":" in str(url.hostname) else url.hostname
    return f"socket://{host}:{url.port or MODBUS_PORT}"


def unopened(port: str) -> serial.Serial:
    """Return a pyserial port of this name, not opened yet.

    Raises TypeError if the name is not text, and NoSuchPort for an invalid URL.
    """
    if not isinstance(port, str):
        raise TypeError(f"a port is a device such as '/dev/ttyUSB0' or a pyserial URL, not {port!r}")
    url = url_of(port)
    scheme, is_url, rest = port.partition("://")
    known = SCHEMES if "?" in rest else (*SCHEMES, *_FOR_PROGRAMS)
    if is_url and scheme.lower() not in known:
        raise NoSuchPort(port, f"the scheme {scheme}:// is not supported; write a URL such as {URLS}")
    if not is_url and _HOST_AND_PORT.fullmatch(port) and not Path(port).exists():
        raise NoSuchPort(
            port,
            f"a scheme is missing: write tcp://{port} for Modbus TCP, or socket://{port} for RTU over TCP",
        )
    if url.scheme == "rfc2217":
        found = RFC2217Port()
        found.port = port
        return cast(serial.Serial, found)  # the type that pyserial declares for all its ports
    if url.scheme in ("socket", "tcp"):
        connection = SocketPort()
        connection.port = _socket_url(url) if url.scheme == "tcp" else port
        return cast(serial.Serial, connection)
    return serial.serial_for_url(port, do_not_open=True)


def is_bridged(port: serial.SerialBase) -> bool:
    """Return True if a thread (a bridge) must forward requests, because the C core cannot use the port."""
    return type(port).read is not serial.Serial.read and not isinstance(port, SocketPort)


def check_port(port: str, mastership: Mastership | None) -> None:
    """Raise NoSuchPort for an invalid port name, and TypeError unless `mastership` is a Mastership or None.

    With a mastership, raise NoSuchPort for a bridged port too. The bridge's thread could send a request after
    the mastership was lost, because it takes requests from the C core before it sends them.
    """
    if mastership is not None and not isinstance(mastership, Mastership):
        raise TypeError(f"mastership takes a multidrop.core.Mastership, not {mastership!r}")
    if is_bridged(unopened(port)) and mastership:
        raise NoSuchPort(
            port,
            "a port of this kind cannot be used with a mastership. Use a device, or a port such as "
            "socket://10.0.0.7:4001",
        )


def connection_of(port: serial.SerialBase | None) -> socket.socket | None:
    return getattr(port, "_socket", None)


def descriptor_of(port: serial.SerialBase) -> int:
    """Return the descriptor of the port; on Windows, its handle."""
    return int(getattr(port, "_port_handle", None) or port.fileno())


def device_of(port: serial.SerialBase) -> str:
    """Return the device behind an open port: /dev/ttyUSB0, or on Windows COM5."""
    if sys.platform == "win32":
        return port_identity.com_name(str(port.port))
    return os.ttyname(port.fileno())


def identity_of(port: serial.SerialBase, name: str) -> str:
    """Return the identity of an open port, the same for all of its names (see port_identity)."""
    if connection := connection_of(port):
        return port_identity.of_connection(connection)
    try:
        return port_identity.of_device(device_of(port))
    except (OSError, ValueError, AttributeError):  # raised for a port without a device, such as loop://
        return port_identity.of_name(name)


def failing_refusals(device: str) -> int:
    """Return the mask (of REFUSALS) of the settings that this device must not refuse."""
    return must_take(device) | (NO_DIVISOR if port_identity.has_divisor(device) else 0)


TOLERANCE = 0.02  # greatest relative error of a baud rate that the C core and the kernel accept
CLOSING_S = 0.75  # seconds in which a stalled adapter must take the driver's bytes when the port closes
_UNNOTICED_S = 0.05  # s; a healthy adapter takes all bytes of the driver within this time
BY_PLACE = "/dev/serial/by-path/"  # links whose names state the USB socket, not the adapter
_NO_SETTINGS = -1


def _refusal(rs485: RS485, failure: OSError) -> str:
    """Return the error text if the driver cannot switch the transceiver as `rs485` requires."""
    what = "has no RS-485 mode" if rs485 is RS485.KERNEL else "does not switch RTS"
    return f'the driver {what} ({os.strerror(failure.errno or 0)}), which rs485 = "{rs485}" needs'


class OpenPort:
    """A pyserial port, with a bridge if the C core cannot use it directly.

    The port may be opened and closed repeatedly, by one thread at a time.
    """

    def __init__(
        self, name: str, ids: TransactionIds, rs485: RS485, mastership: Mastership | None, settle: float = 0.0
    ) -> None:
        self.name = name
        self.identity = name  # the port's identity (see port_identity); until it is opened, the given name
        self.bridge: Bridge | None = None
        self.settings: tuple[int, str] | None = None  # baud rate and format of a bridged port
        self._ids = ids
        self._rs485 = rs485
        self._mastership = mastership
        self._settle = settle
        self._serial: serial.SerialBase | None = None
        self._adapter: USBAdapter | None = None  # the USB adapter behind the port when it was last opened
        # the pseudo-terminal behind the port when it was last opened
        self._terminal: PseudoTerminal | None = None
        self.must_discard = False  # True: the driver may hold bytes of a command that has ended

    def open(self) -> Port:
        """Open the port, wait for `settle` s, discard the input, and return the C core's port.

        Raises LineError or one of PORT_FAILURES; the caller must then call `close`.
        """
        port = self._serial = unopened(self._name_now())
        terminal = self._terminal_now()
        port.timeout = 0
        if isinstance(port, serial.Serial):
            port.exclusive = True
            # at the other level, opening the port would switch the transceiver to sending
            port.rts = self._rs485 is not RS485.RTS_UP
        port.open()
        if isinstance(port, serial.Serial) and not self.name.startswith(BY_PLACE):
            self._require_same_adapter(device_of(port))
        self._terminal = terminal
        self.identity = identity_of(port, self.name)
        if self._settle:
            clock.sleep(self._settle)
            port.reset_input_buffer()
        core = self._drive(port)
        with suppress(*PORT_FAILURES, AttributeError, NotImplementedError):
            port.set_low_latency_mode(True)  # without low latency, a USB adapter delays bytes by up to 16 ms
        return core

    def _name_now(self) -> str:
        """Return the port's name, or the present device name of its adapter.

        An adapter gets another name if its old name is in use when it comes back, as after a sleep.
        """
        if self._adapter is None:
            return self.name
        found = adapter_of(os.path.realpath(self.name))
        is_same = found is not None and self._adapter.is_same(found)
        return (None if is_same else port_identity.device_of(self._adapter)) or self.name

    def _terminal_now(self) -> PseudoTerminal | None:
        """Return the pseudo-terminal to open. Raises LineError if a later terminal now has its number.

        The later terminal may belong to any program, such as a shell, and opening it changes its settings.
        """
        found = pseudo_terminal_of(self.name)
        if self._terminal and found and self._terminal.is_replaced_by(found):
            raise LineError(
                self.name,
                f"the port's pseudo-terminal is gone, and {found.device} is now a different one",
            )
        return found

    def _require_same_adapter(self, device: str) -> None:
        """Raise LineError if another adapter has this device name now, because its line has other motors."""
        found = adapter_of(device)
        if self._adapter and (found is None or not self._adapter.is_same(found)):
            raise LineError(
                self.name,
                f"this name now belongs to another adapter ({found or 'none on USB'}, not {self._adapter}). "
                "If that is intended, restart the program, or use a permanent name in /dev/serial/by-id",
            )
        had_twin = self._adapter is not None and self._adapter.has_twin
        self._adapter = found and replace(found, has_twin=had_twin or port_identity.has_twin(found))

    def _drive(self, port: serial.SerialBase) -> Port:
        """Return a core port that uses this port's descriptor, or that of a new bridge."""
        if type(port).read is serial.Serial.read:
            device = device_of(port)
            opened = Port(descriptor_of(port), failing_refusals(device), mastership=self._mastership)
            return self._switched(opened, device)
        if connection := connection_of(port):
            discard_late_bytes(connection)
        if connection and not is_bridged(port):
            connection.setblocking(False)
            ids = self._ids if speaks_tcp(self.name) else None
            return Port(connection.fileno(), _NO_SETTINGS, transactions=ids, mastership=self._mastership)
        if self.settings:
            set_up(port, self.settings)
        self.bridge = Bridge(port)
        return Port(self.bridge.theirs.fileno(), _NO_SETTINGS)

    def _switched(self, core: Port, device: str) -> Port:
        """Set who switches the transceiver, except on a pseudo-terminal; return `core`.

        Raises LineError if the driver refuses.
        """
        try:
            core.switch(self._rs485, is_usb=adapter_of(device) is not None)
        except OSError as failure:
            if not is_pseudo_terminal(device):
                core.close()
                raise LineError(self.name, _refusal(self._rs485, failure)) from failure
        return core

    def _holds_bytes_now(self) -> bool:
        """Return True if the driver still holds bytes that the adapter has not accepted; False on Windows."""
        port = self._serial
        if sys.platform != "win32" and isinstance(port, serial.Serial) and port.is_open and not self.bridge:
            with suppress(*PORT_FAILURES):
                return bool(port.out_waiting)
        return False

    def holds_bytes(self) -> bool:
        """Return True if the driver still holds bytes that a healthy adapter would have accepted by now."""
        if not self._holds_bytes_now():
            return False
        clock.sleep(_UNNOTICED_S)
        return self._holds_bytes_now()

    def close(self, seconds: float = CLOSING_S) -> None:
        """Close the port, even if opening it failed halfway.

        The adapter has `seconds` s to take the driver's unsent bytes; then the rest is discarded. If the
        attribute `must_discard` is True, all unsent bytes are discarded immediately.
        """
        if self.bridge:
            self.bridge.close()
            self.bridge = None
        if self._serial:
            connection = connection_of(self._serial)
            if self._holds_bytes_now():  # pyserial would wait for up to 30 s until these bytes are sent
                port = cast(serial.Serial, self._serial)
                other = cast(int, port.pipe_abort_read_r)
                close_behind(port.fileno(), other, 0.0 if self.must_discard else seconds)
            with suppress(*PORT_FAILURES):
                self._serial.close()
            self.must_discard = False
            if connection:  # pyserial leaves a connection open that the far end has closed
                connection.close()

    def forget(self) -> None:
        """Close the descriptors in a forked child, but not the connection that the parent still uses."""
        if self.bridge:
            self.bridge.forget()
            self.bridge = None
        # For a network port, close only the socket: pyserial would end the connection, which the parent still
        # uses. Never close loop://, which has no descriptor: pyserial would wait for a lock of its queue, and
        # a thread of the parent may hold this lock.
        port = connection_of(self._serial) or self._serial
        self._serial = None
        if isinstance(port, (socket.socket, serial.Serial)):
            with suppress(*PORT_FAILURES):
                port.close()

    def require(self, settings: tuple[int, str]) -> None:
        """Set the baud rate and format of a bridged port, whose settings cannot change later.

        Raises LineError if the port already has other settings, or rejects these.
        """
        # not open yet: keep the settings, because the port may be bridged
        if self._serial is None or self.bridge is None:
            self.settings = self.settings or settings
            return
        if self.settings == settings:
            return
        if self.settings:
            raise LineError(
                self.name, "this kind of port cannot change its baud rate or format between drives"
            )
        try:
            set_up(self._serial, settings)
        except PORT_FAILURES as failure:
            raise LineError(self.name, reason_of(failure)) from failure
        self.settings = settings

    def refusal(self, mask: int, baudrate: int) -> str:
        """Return why the port refused settings; `mask` has a bit of REFUSALS for each refused setting."""
        if mask != NO_DIVISOR or self._serial is None:
            return f"the port does not take the {refused_names(mask)} that the drive needs"
        true, lower, higher = possible_rates(self._serial.fileno(), baudrate)
        if abs(true - baudrate) <= baudrate * TOLERANCE:
            return (
                f"its driver replaces {baudrate} baud by a custom divisor: setserial {self.name} spd_normal"
            )
        return (
            f"the port cannot run at {baudrate} baud: its UART would run at {true}; "
            f"the nearest possible baud rates are {lower} and {higher}"
        )

    def overruns(self) -> int | None:
        """Return how many characters the UART has lost (overruns); None if unknown or while closed."""
        try:
            return None if self.bridge or not self._serial else overruns(self._serial.fileno())
        except (*PORT_FAILURES, TypeError, AttributeError):  # another thread may close the port meanwhile
            return None
