"""Serial ports for tests: joined ptys, ptys for raw bytes, ptys that hang up, and a network serial port."""

from __future__ import annotations

import os
import select
import selectors
import socket
import threading
import tty
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from types import SimpleNamespace

import pytest
from serial import rfc2217

from multidrop.core import set_settings


@contextmanager
def linked_ptys() -> Iterator[tuple[str, str]]:
    """Yield the paths of two ports. Each port receives the bytes written to the other."""
    masters, slaves = zip(*(os.openpty() for _ in range(2)), strict=True)
    one, other = masters
    for slave in slaves:
        tty.setraw(slave)
    try:
        with passing({one: partial(os.write, other), other: partial(os.write, one)}):
            yield os.ttyname(slaves[0]), os.ttyname(slaves[1])
    finally:
        for fd in (*masters, *slaves):
            os.close(fd)


@contextmanager
def passing(takers: Mapping[int, Callable[[bytes], object]]) -> Iterator[None]:
    """During the block, pass what each descriptor receives to its function."""
    reader, writer = os.pipe()
    thread = threading.Thread(target=_pass, args=(takers, reader), daemon=True)
    thread.start()
    try:
        yield
    finally:
        os.write(writer, b"\0")
        thread.join()
        os.close(reader)
        os.close(writer)


def _pass(takers: Mapping[int, Callable[[bytes], object]], stop: int) -> None:
    with selectors.DefaultSelector() as ready:
        for fd in (*takers, stop):
            ready.register(fd, selectors.EVENT_READ)
        while True:
            for key, _ in ready.select():
                if key.fd == stop:
                    return
                with suppress(OSError):
                    takers[key.fd](os.read(key.fd, 1024))


PATIENCE = 60.0  # longest wait for a reply that must come, in s


@contextmanager
def opened(path: str, baudrate: int = 9600) -> Iterator[int]:
    """Yield a descriptor of the port, opened and configured as by a client."""
    if path.startswith("socket://"):
        host, _, port = path.removeprefix("socket://").partition(":")
        with socket.create_connection((host, int(port))) as client:
            yield client.fileno()
        return
    fd = os.open(path, os.O_RDWR | os.O_NOCTTY)
    try:
        set_settings(fd, baudrate, "8N1")
        yield fd
    finally:
        os.close(fd)


def receive(fd: int, length: int, patience: float = PATIENCE) -> bytes:
    """Return at least `length` bytes; fewer if none come for `patience` s."""
    received = b""
    os.set_blocking(fd, False)
    while len(received) < length and select.select([fd], [], [], patience)[0]:
        with suppress(BlockingIOError):  # the other end may discard bytes between select() and read()
            received += os.read(fd, 1024)
    os.set_blocking(fd, True)
    return received


# ---- a network serial port (RFC 2217), and a pty that hangs up ----


class SerialServer:
    """A network serial port (RFC 2217) with a simulated line behind it. Serial settings are only recorded."""

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

    This process keeps the client's end open: otherwise a new pty could get the same path.
    """
    master, slave = os.openpty()
    path = os.ttyname(slave)

    def hang_up() -> None:
        os.read(master, 1024)
        os.close(master)

    return path, hang_up
