"""A port that is opened to listen only.

A device's descriptor is opened read-only. A port behind a URL is pyserial's, with its `write` replaced:
nothing is written to a socket, and an rfc2217 server gets the settings alone.
"""

from __future__ import annotations

import os
import select
import sys
import time
from io import FileIO
from typing import Any, NoReturn

from multidrop.core import Stream, must_take, refused_names, set_settings
from multidrop.drive.timing import Settings
from multidrop.errors import LineError
from multidrop.transport.bridge import PORT_FAILURES
from multidrop.transport.opening import reason_of, unopened

LOOK_S = 0.05  # the longest wait for bytes
_MOST = 4096  # bytes of one read


def _open_device(port: str, settings: Settings) -> FileIO:
    """Open a device of this machine read-only, and lock and set it up."""
    if sys.platform == "win32":
        raise LineError(port, "on Windows only a socket:// can be listened to, and no serial device")
    import fcntl

    fd = os.open(port, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        refused = set_settings(fd, settings.baudrate, settings.format) & must_take(os.ttyname(fd))
        if refused:
            raise LineError(port, f"the port does not take the {refused_names(refused)} of {settings}")
    except OSError:
        os.close(fd)
        raise
    return FileIO(fd)


def _open_url(url: str, settings: Settings) -> Any:
    """Open a URL, with a `write` that refuses."""
    port = unopened(url)
    vars(port)["write"] = _refuse
    port.baudrate = settings.baudrate
    port.bytesize = settings.databits
    port.parity = settings.parity
    port.stopbits = settings.stopbits
    port.timeout = LOOK_S
    port.open()
    return port


def _refuse(data: bytes) -> NoReturn:
    raise OSError(f"this port is only listened to: {data.hex(' ')} is not sent")


class Listener:
    """A port or URL whose bytes go into `stream`. Every failure of the port is a LineError."""

    def __init__(self, port: str, settings: Settings) -> None:
        self.port = port
        self._character_ns = round(settings.character * 1e9)
        self._pause_ns = round(settings.t3_5 * 1e9)
        self._last_ns = 0
        self.stream = Stream()
        try:
            self._source: Any = (_open_url if "://" in port else _open_device)(port, settings)
        except LineError:
            raise
        except PORT_FAILURES as failure:
            raise LineError(port, reason_of(failure)) from failure

    def receive(self) -> int:
        """Wait for bytes, LOOK_S at most, and put them into the stream; return how many came."""
        try:
            received = self._read()
        except PORT_FAILURES as failure:
            raise LineError(self.port, f"the port was lost ({reason_of(failure)})") from failure
        if not received:
            return 0
        now_ns = time.time_ns()
        begun_ns = max(self._last_ns, now_ns - len(received) * self._character_ns)
        after_pause = begun_ns - self._last_ns >= self._pause_ns
        self.stream.put(received, begun_ns, after_pause=after_pause)
        self._last_ns = now_ns
        return len(received)

    def _read(self) -> bytes:
        """Return what came within LOOK_S. Raises EOFError when the other end has hung up."""
        try:
            fd = self.fileno()
        except OSError:  # no descriptor, as of loop://
            return bytes(self._source.read(1) + self._source.read_all())
        if not select.select([fd], [], [], LOOK_S)[0]:
            return b""
        try:
            received = os.read(fd, _MOST)
        except BlockingIOError:
            return b""
        if not received:
            raise EOFError("hung up")
        return received

    def fileno(self) -> int:
        return int(self._source.fileno())

    def close(self) -> None:
        self._source.close()
