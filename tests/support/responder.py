"""Responders behind ports, run by one thread: ptys that may vanish, and sockets."""

from __future__ import annotations

import os
import selectors
import socket
import threading
import time
import tty
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from responder_line import ReceivedFrame, ResponderLine
from responder_telnet import Telnet

__all__ = ["ReceivedFrame", "Responder", "ResponderLine"]


class Responder:
    """Responders behind ports, run by one thread; `ports` are the names that a client opens.

    A pty is opened under a link in `directory`, so that it can vanish and come back. Alternatively each line
    has
    a listening socket, with raw bytes or with Telnet's serial port option.
    """

    def __init__(
        self,
        lines: Sequence[ResponderLine],
        directory: Path | None = None,
        listening: Sequence[socket.socket] = (),
        telnet: bool = False,
    ) -> None:
        self.lines = list(lines)
        self._telnets: dict[ResponderLine, Telnet] = {}
        self._is_telnet = telnet
        self.ports: list[str] = []
        self._links: list[Path] = []
        self._slaves: dict[ResponderLine, int] = {}
        self._masters: dict[ResponderLine, int] = {}
        self._sockets: dict[ResponderLine, socket.socket] = {}
        self._listening = list(listening)
        self._delayed: list[tuple[float, ResponderLine, bytes]] = []
        self._ready = selectors.DefaultSelector()
        self._jobs: list[Callable[[], Any]] = []
        self._wake, self._waker = os.pipe()
        self._ready.register(self._wake, selectors.EVENT_READ, self._woken)
        for number, line in enumerate(self.lines):
            if directory:
                self._links.append(directory / f"line-{number}")
                self._plug_in(line)
                self.ports.append(str(self._links[-1]))
        for line, each in zip(self.lines, self._listening, strict=False):
            self._listen(line, each)
            host, port = each.getsockname()
            self.ports.append(f"{'rfc2217' if telnet else 'socket'}://{host}:{port}")
        self._thread = threading.Thread(target=self._run, name="responder", daemon=True)
        self._done = False

    def __enter__(self) -> Responder:
        self._thread.start()
        return self

    def __exit__(self, *failure: object) -> None:
        self.do(lambda: setattr(self, "_done", True))
        self._thread.join()
        self._ready.close()
        for link in self._links:
            link.unlink(missing_ok=True)
        for fd in (*self._masters.values(), *self._slaves.values(), self._wake, self._waker):
            os.close(fd)
        for connection in (*self._sockets.values(), *self._listening):
            connection.close()

    # ---- ports ----

    def _plug_in(self, line: ResponderLine) -> None:
        master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(master, False)
        link = self._links[self.lines.index(line)]
        new = link.with_suffix(".new")
        new.symlink_to(os.ttyname(slave))
        new.rename(link)
        self._masters[line], self._slaves[line] = master, slave
        self._ready.register(master, selectors.EVENT_READ, lambda: self._read(line))

    def _listen(self, line: ResponderLine, listening: socket.socket) -> None:
        self._ready.register(listening, selectors.EVENT_READ, lambda: self._accept(line, listening))

    def _accept(self, line: ResponderLine, listening: socket.socket) -> None:
        if line in self._sockets:
            self._hang_up(line)
        connection, _ = listening.accept()
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._sockets[line] = connection
        if self._is_telnet:
            self._telnets[line] = Telnet()
        line.reconnected()
        self._ready.register(connection, selectors.EVENT_READ, lambda: self._read(line))

    def _hang_up(self, line: ResponderLine) -> None:
        connection = self._sockets.pop(line)
        self._ready.unregister(connection)
        connection.close()

    def lose(self, line: ResponderLine) -> None:
        """Remove the port, as when an adapter is unplugged."""

        def unplug() -> None:
            self._links[self.lines.index(line)].unlink()
            master = self._masters.pop(line)
            self._ready.unregister(master)
            os.close(master)
            os.close(self._slaves.pop(line))

        self.do(unplug)

    def bring_back(self, line: ResponderLine) -> None:
        def plug_in() -> None:
            line.reconnected()
            self._plug_in(line)

        self.do(plug_in)

    # ---- the thread ----

    def do(self, job: Callable[[], Any]) -> None:
        """Run the job in the responder thread, and wait until it is done."""
        done = threading.Event()

        def do_and_tell() -> None:
            job()
            done.set()

        self._jobs.append(do_and_tell)
        os.write(self._waker, b"\0")
        done.wait()  # a signal handler may interrupt this wait, and the job still completes

    def release(self, line: ResponderLine) -> None:
        """Send the replies that were held back."""

        def give() -> None:
            for said in line.release():
                self._send(line, said)

        self.do(give)

    def _woken(self) -> None:
        os.read(self._wake, 1024)
        while self._jobs:
            self._jobs.pop(0)()

    def _run(self) -> None:
        while not self._done:
            waits = [at - time.monotonic() for at, _, _ in self._delayed[:1]]
            for key, _ in self._ready.select(max(0.0, waits[0]) if waits else None):
                key.data()
            while self._delayed and self._delayed[0][0] <= time.monotonic():
                _, line, said = self._delayed.pop(0)
                self._send(line, said)

    def _read(self, line: ResponderLine) -> None:
        try:
            connection = self._sockets.get(line)
            received = connection.recv(4096) if connection else os.read(self._masters[line], 4096)
        except BlockingIOError:
            return
        except OSError:
            received = b""
        if not received:
            if line in self._sockets:
                self._hang_up(line)
            return
        if line in self._telnets:
            received, answer = self._telnets[line].decode(received)
            self._sockets[line].send(answer)
        for said in line.hear(received):
            if line.delay:
                self._delayed.append((time.monotonic() + line.delay, line, said))
            else:
                self._send(line, said)

    def _send(self, line: ResponderLine, said: bytes) -> None:
        with suppress(OSError, KeyError):
            if line in self._sockets:
                self._sockets[line].send(Telnet.encode(said) if self._is_telnet else said)
            else:
                os.write(self._masters[line], said)
