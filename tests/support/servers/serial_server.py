"""A network serial port (RFC 2217), and a pty that hangs up."""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Callable
from contextlib import suppress
from types import SimpleNamespace

import pytest
from serial import rfc2217


class SerialServer:
    """A network serial port (RFC 2217) with a simulated line behind it.

    Serial settings have no effect; they are recorded for tests to check.
    """

    def __init__(self, path: str) -> None:
        settings = {"baudrate": 0, "bytesize": 8, "parity": "N", "stopbits": 1}
        modem_lines = {"cts": True, "dsr": True, "ri": False, "cd": True}
        flushes = dict.fromkeys(("reset_input_buffer", "reset_output_buffer"), lambda: None)
        self.port = SimpleNamespace(**settings, **modem_lines, **flushes)
        host, port = path.removeprefix("socket://").split(":")
        self._wire = socket.create_connection((host, int(port)))
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"rfc2217://127.0.0.1:{self._listener.getsockname()[1]}"
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        client, _ = self._listener.accept()
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        manager = rfc2217.PortManager(self.port, SimpleNamespace(write=client.sendall))
        back = threading.Thread(target=self._copy_back, args=(client, manager), daemon=True)
        back.start()
        with suppress(OSError):  # the client may disconnect meanwhile
            while received := client.recv(1024):
                self._wire.sendall(b"".join(manager.filter(received)))
        with suppress(OSError):
            self._wire.shutdown(socket.SHUT_RDWR)
        back.join()
        client.close()

    def _copy_back(self, client: socket.socket, manager: rfc2217.PortManager) -> None:
        with suppress(OSError):
            while answer := self._wire.recv(1024):
                client.sendall(b"".join(manager.escape(answer)))

    def close(self) -> None:
        self._thread.join()
        self._listener.close()
        self._wire.close()


pyserials_own = pytest.mark.filterwarnings("ignore:set(Daemon|Name)\\(\\) is deprecated:DeprecationWarning")


def vanishing_pty() -> tuple[str, Callable[[], None]]:
    """Return a pty's path, and a function that waits for a request and hangs up, like an unplugged adapter.

    The client's end stays open here: otherwise a new pty could get the same number and be opened instead.
    """
    master, slave = os.openpty()
    path = os.ttyname(slave)

    def hang_up() -> None:
        os.read(master, 1024)
        os.close(master)

    return path, hang_up
