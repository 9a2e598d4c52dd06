"""Finding and opening a port by its name: a device or a URL, its identity, and why it fails."""

from __future__ import annotations

import errno
import os
import re
import socket
import sys
from typing import cast
from urllib.parse import SplitResult

import serial

from multidrop.core import Failure, Mastership, Port
from multidrop.drive.line_settings import MODBUS_PORT, SCHEMES, URLS, url_of
from multidrop.errors import NoSuchPort
from multidrop.transport import port_identity
from multidrop.transport.mixed_up import mixed_up
from multidrop.transport.rfc2217 import RFC2217Port
from multidrop.transport.socket_port import SocketPort

_REASONS = {
    errno.ENOENT: "there is no such port",
    errno.EACCES: "no permission to open it (is the user in the group that owns it?)",
    errno.EAGAIN: "it is in use by another program",
    errno.EBUSY: "it is in use by another program",
    errno.ENOTTY: "it is not a serial port",
    errno.EISDIR: "it is a directory, not a serial port",
    errno.ECONNREFUSED: "nothing listens there",
}

# pyserial keeps an error of Windows in its text alone: could not open port 'COM5': PermissionError(13, ...)
_WINDOWS_ERROR = re.compile(r"Error\((\d+), ")
_WINDOWS_REASONS = {
    errno.EACCES: _REASONS[errno.EBUSY],  # a COM port is one program's, whoever asks
    errno.EBADF: _REASONS[errno.ENOTTY],
}


def reason_of(failure: BaseException) -> str:
    """Return the cause in words: pyserial hides the system's error in or behind its own."""
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
    """Return True where an exchange with this result ended because its port was lost."""
    is_lost = result in (Failure.LINE_LOST, Failure.SETTINGS_REFUSED)
    return is_lost or (result == Failure.LATE_ANSWER_DUE and port.lost)


def why_lost(port: str, error: int, received: bytes) -> str:
    """Return why a port was lost: by the errno of its descriptor, 0 where that hung up."""
    if error != errno.EPROTO:
        return os.strerror(error) if error else "hung up"
    shown = received[:16].hex(" ").upper() or "a damaged header"
    return f"what came is no Modbus TCP: {shown}{mixed_up(port, received)}"


_FOR_PROGRAMS = ("loop", "spy")  # of pyserial, without options: spy://DEVICE?file=PATH empties that file


def _socket_url(url: SplitResult) -> str:
    host = f"[{url.hostname}]" if ":" in str(url.hostname) else url.hostname
    return f"socket://{host}:{url.port or MODBUS_PORT}"


def unopened(port: str) -> serial.Serial:
    """Return the port, not opened yet. Raises TypeError, and NoSuchPort for a URL that no port can have."""
    if not isinstance(port, str):
        raise TypeError(f"a port is a device such as '/dev/ttyUSB0' or a pyserial URL, not {port!r}")
    url = url_of(port)
    scheme, is_url, rest = port.partition("://")
    known = SCHEMES if "?" in rest else (*SCHEMES, *_FOR_PROGRAMS)
    if is_url and scheme.lower() not in known:
        raise NoSuchPort(port, f"there is no {scheme}://; a URL is such as {URLS}")
    if url.scheme == "rfc2217":
        found = RFC2217Port()
        found.port = port
        return cast(serial.Serial, found)  # as pyserial types all of its kinds of ports
    if url.scheme in ("socket", "tcp"):
        connection = SocketPort()
        connection.port = _socket_url(url) if url.scheme == "tcp" else port
        return cast(serial.Serial, connection)
    return serial.serial_for_url(port, do_not_open=True)


def is_bridged(port: serial.SerialBase) -> bool:
    """Return True for a port that the core cannot write to itself: a thread passes its requests on."""
    return type(port).read is not serial.Serial.read and not isinstance(port, SocketPort)


def check_port(port: str, mastership: Mastership | None) -> None:
    """Raise NoSuchPort for a name that no port can have, and TypeError for what is no mastership.

    With a mastership requests must be held back, and those that a thread has taken leave all the same: then
    NoSuchPort is raised for such a port too.
    """
    if mastership is not None and not isinstance(mastership, Mastership):
        raise TypeError(f"mastership takes a multidrop.core.Mastership, not {mastership!r}")
    if is_bridged(unopened(port)) and mastership:
        raise NoSuchPort(
            port,
            "a line with a mastership needs a port that the core writes to itself, such as "
            "socket://10.0.0.7:4001 or a device: what goes through a thread could leave after another "
            "process has become master",
        )


def connection_of(port: serial.SerialBase | None) -> socket.socket | None:
    """Return the socket of a network port, None for other ports."""
    return getattr(port, "_socket", None)


def descriptor_of(port: serial.SerialBase) -> int:
    """Return what the core reads from and writes to: a descriptor, or on Windows a handle."""
    return int(getattr(port, "_port_handle", None) or port.fileno())


def device_of(port: serial.SerialBase) -> str:
    """Return the device behind an open port: /dev/ttyUSB0, or on Windows COM5."""
    if sys.platform == "win32":
        return port_identity.com_name(str(port.port))
    return os.ttyname(port.fileno())


def identity_of(port: serial.SerialBase, name: str) -> str:
    """Return the identity of an open port, however its name is spelt (see port_identity)."""
    if connection := connection_of(port):
        return port_identity.of_connection(connection)
    try:
        return port_identity.of_device(device_of(port))
    except (OSError, ValueError, AttributeError):  # it has no device, as loop:// has none
        return port_identity.of_name(name)
