"""Opens a port to listen only: nothing can be sent on it.

A device's descriptor cannot write. A port behind a URL is pyserial's, with its `write` taken away: to a
socket nothing is ever written, and an rfc2217 server is told the settings that it must have.
"""

from __future__ import annotations

import fcntl
import os
import select
import time
from types import TracebackType
from typing import NoReturn

from multidrop.core import REFUSALS, Stream, set_settings
from multidrop.drive.timing import Settings
from multidrop.errors import LineError
from multidrop.transport.bridge import PORT_FAILURES
from multidrop.transport.opening import reason_of, unopened

LOOK_S = 0.05  # the longest that bytes are waited for at a time
_MOST = 4096  # bytes read at once
_BAUDRATE = min(REFUSALS)


class _Device:
    """A device of this machine, opened for reading alone."""

    def __init__(self, port: str, settings: Settings) -> None:
        self._fd = os.open(port, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            refused = set_settings(self._fd, settings.baudrate, settings.format)
            if os.ttyname(self._fd).startswith(("/dev/pts/", "/dev/ttys")):
                refused &= _BAUDRATE  # a pty stays at 8 bits without parity whatever it is told
            if refused:
                names = ", ".join(name for bit, name in REFUSALS.items() if refused & bit)
                raise LineError(port, f"the port does not take the {names} of {settings}")
        except OSError:
            self.close()
            raise

    def fileno(self) -> int:
        return self._fd

    def read(self) -> bytes:
        """What came within a while; EOFError when nothing ever will again."""
        return _read(self._fd)

    def close(self) -> None:
        os.close(self._fd)


class _Remote:
    """A port behind a pyserial URL, without its `write`."""

    def __init__(self, url: str, settings: Settings) -> None:
        self._port = unopened(url)
        vars(self._port)["write"] = _refuse
        self._port.baudrate = settings.baudrate
        self._port.bytesize = int(settings.format[0])
        self._port.parity = settings.format[1]
        self._port.stopbits = int(settings.format[2])
        self._port.timeout = LOOK_S
        self._port.open()

    def fileno(self) -> int:
        return int(self._port.fileno())

    def read(self) -> bytes:
        try:
            fd = self.fileno()
        except OSError:  # it has none
            return bytes(self._port.read(1) + self._port.read_all())
        return _read(fd)

    def close(self) -> None:
        self._port.close()


def _refuse(data: bytes) -> NoReturn:
    raise OSError(f"this port is only listened to: {data.hex(' ')} is not sent")


def _read(fd: int) -> bytes:
    if not select.select([fd], [], [], LOOK_S)[0]:
        return b""
    try:
        received = os.read(fd, _MOST)
    except BlockingIOError:
        return b""
    if not received:
        raise EOFError("hung up")
    return received


class Listener:
    """A port, or any pyserial URL, that is heard and cannot be spoken to; leaving the `with` block closes it.

    Every failure of the port is a LineError.
    """

    def __init__(self, port: str, settings: Settings) -> None:
        self.port = port
        self._character_ns = round(settings.character * 1e9)
        self._pause_ns = round(settings.t3_5 * 1e9)
        self._last_ns = 0
        self.stream = Stream()
        try:
            self._source = (_Remote if "://" in port else _Device)(port, settings)
        except LineError:
            raise
        except PORT_FAILURES as failure:
            raise LineError(port, reason_of(failure)) from failure

    def hear(self) -> int:
        """Wait a while for bytes and hear them; how many came."""
        try:
            received = self._source.read()
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

    def fileno(self) -> int:
        return self._source.fileno()

    def close(self) -> None:
        self._source.close()

    def __enter__(self) -> Listener:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
