"""The simulator's end of a simulated line: a pty, or a TCP port that serves one client at a time."""

from __future__ import annotations

import contextlib
import os
import socket
from pathlib import Path
from urllib.parse import urlsplit

from multidrop.control.records import default_ledger_path
from multidrop.core import get_settings, set_settings
from multidrop.drive.line_settings import Settings
from multidrop.transport.port_identity import SimulatedPort, is_simulated, of_address

MOST_READ = 4096


def is_dead_link(link: Path) -> bool:
    """Return True if a killed simulator left this link: its pty is gone or is used by another program."""
    if not link.is_symlink():
        return False
    target = str(link.readlink())
    return target.startswith("/dev/pts/") and not (link.exists() and is_simulated(target))


class PtyPort:
    """A pty whose other end a client opens by its path.

    This object keeps the client's end open, so that the pty remains when a client closes it. Of a client's
    settings, only the baud rate has an effect, because a pty stores no parity.
    """

    def __init__(self, settings: Settings, link: Path | None) -> None:
        if not hasattr(os, "openpty"):
            raise OSError("this system has no pseudo-terminals: name ports such as socket://127.0.0.1:0")
        self._master, self._slave = os.openpty()
        self._simulated: SimulatedPort | None = None
        self._link = link
        try:
            os.set_blocking(self._master, False)
            set_settings(self._slave, settings.baudrate, settings.format)
            self.path = os.ttyname(self._slave)
            self._simulated = SimulatedPort(self.path, default_ledger_path().parent)
            if link is not None:
                if is_dead_link(link):
                    link.unlink()
                link.symlink_to(self.path)
                self.path = str(link)
        except OSError:
            self._link = None
            self.close()
            raise

    def fileno(self) -> int:
        return self._master

    def read(self) -> bytes:
        try:
            return os.read(self._master, MOST_READ)
        except BlockingIOError:
            return b""

    def write(self, data: bytes) -> None:
        # if no client reads, the bytes are lost, as on a real line
        with contextlib.suppress(BlockingIOError):
            os.write(self._master, data)

    def baudrate(self) -> int | None:
        return get_settings(self._slave)[0]

    def close(self) -> None:
        if self._link is not None:
            self._link.unlink(missing_ok=True)
        if self._simulated is not None:
            self._simulated.close()
        os.close(self._master)
        os.close(self._slave)


class TCPPort:
    """A listening socket; it accepts the next client when the current one has disconnected."""

    def __init__(self, url: str) -> None:
        parts = urlsplit(url)
        if parts.hostname is None or parts.port is None:
            kind = parts.scheme
            raise ValueError(f"{url!r} is not {kind}://host:port, such as {kind}://127.0.0.1:5020")
        self._listener = socket.create_server((parts.hostname, parts.port))
        self._listener.setblocking(False)
        self._client: socket.socket | None = None
        host, port, *_ = self._listener.getsockname()
        near = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
        self._simulated = SimulatedPort(of_address((near, port)), default_ledger_path().parent)
        self.path = f"{parts.scheme}://{parts.hostname}:{self._listener.getsockname()[1]}"

    def fileno(self) -> int:
        """Return the descriptor to poll; it changes when a client connects or disconnects."""
        return (self._client or self._listener).fileno()

    def read(self) -> bytes:
        if self._client is None:
            with contextlib.suppress(BlockingIOError, ConnectionError):  # the client has already disconnected
                self._client, _ = self._listener.accept()
                self._client.setblocking(False)
                self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return b""
        try:
            chunk = self._client.recv(MOST_READ)
        except BlockingIOError:
            return b""
        except OSError:
            chunk = b""
        if not chunk:
            self._hang_up()
        return chunk

    def _hang_up(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None

    def write(self, data: bytes) -> None:
        if self._client is not None:
            with contextlib.suppress(OSError):  # reading detects a disconnected client
                self._client.send(data)

    def baudrate(self) -> None:
        """Return None, because a TCP client's baud rate is unknown."""

    def close(self) -> None:
        self._hang_up()
        self._simulated.close()
        self._listener.close()


SimulatedEnd = PtyPort | TCPPort  # both types have the same methods, which never block


def open_port(where: str, settings: Settings) -> SimulatedEnd:
    """Open the pty or TCP port named by `where`; see `Wire` for the forms of `where`."""
    if where.startswith(("socket://", "tcp://")):
        return TCPPort(where)
    return PtyPort(settings, None if where == "pty" else Path(where))
