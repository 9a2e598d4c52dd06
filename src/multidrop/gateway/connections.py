"""Connections: how many may be open, and how long one may take over its request.

Clients that are slow or silent cost nobody else anything: where there are too many connections, the one that
has been idle for longest is closed, and a new one, which may bring a stop, always gets in.
"""

from __future__ import annotations

import socket
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from starlette.types import ASGIApp, Message, Receive, Scope, Send

MOST_OPEN = 256  # a process has 1024 descriptors as a rule, and lines and files need some
FIRST_S = 10.0  # for a TLS handshake and the whole first request
AGAIN_S = 40.0  # for a later one; the server itself closes a silent connection after 30 s

BODY_HEADERS = (b"content-length", b"transfer-encoding")


class _Open:
    """One connection."""

    __slots__ = ("ends", "is_busy", "peer")

    def __init__(self, peer: socket.socket, ends: float) -> None:
        self.peer = peer
        self.ends = ends  # unless its next request is complete by then
        self.is_busy = False

    def end(self) -> None:
        """Let the server see its end, and close it."""
        with suppress(OSError):  # it is gone already
            self.peer.shutdown(socket.SHUT_RDWR)


class Connections:
    """The open connections by the client's address, the one that was idle for longest first."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._open: dict[tuple[str, int], _Open] = {}
        self.ended = 0  # so far

    def add(self, peer: socket.socket, address: Any) -> None:
        """Note a new connection, and close another one where there are too many."""
        self._forget_closed()
        self._open.pop(address[:2], None)
        self._open[address[:2]] = _Open(peer, self._clock() + FIRST_S)
        while len(self._open) > MOST_OPEN:
            others = [client for client in self._open if client != address[:2]]
            self._end(next((client for client in others if not self._open[client].is_busy), others[0]))

    def sweep(self) -> None:
        """Close those that took too long."""
        self._forget_closed()
        now = self._clock()
        for client in [client for client, one in self._open.items() if not one.is_busy and one.ends < now]:
            self._end(client)

    def begin(self, client: tuple[str, int] | None) -> None:
        """Note that a request is complete."""
        if client in self._open:
            self._open[client].is_busy = True

    def finish(self, client: tuple[str, int] | None) -> None:
        """Note that a request was answered."""
        if client in self._open:
            found = self._open[client] = self._open.pop(client)  # the last one in order
            found.is_busy, found.ends = False, self._clock() + AGAIN_S

    def _end(self, client: tuple[str, int]) -> None:
        self._open.pop(client).end()
        self.ended += 1

    def _forget_closed(self) -> None:
        for client in [client for client, one in self._open.items() if one.peer.fileno() < 0]:
            del self._open[client]

    def __len__(self) -> int:
        return len(self._open)


class CountingSocket(socket.socket):
    """A listening socket that notes each connection in `connections`."""

    connections: Connections | None = None

    def accept(self) -> tuple[socket.socket, Any]:
        """Return the next connection and its client's address."""
        peer, address = super().accept()
        if self.connections is not None:
            self.connections.add(peer, address)
        return peer, address


class Watched:
    """An application that notes in `connections` when a request is complete and when it is answered."""

    def __init__(self, app: ASGIApp, connections: Connections) -> None:
        self._app = app
        self._connections = connections

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        client = scope.get("client")

        async def receive_and_note() -> Message:
            message = await receive()
            if message["type"] == "http.request" and not message.get("more_body", False):
                self._connections.begin(client)
            return message

        if not any(name in BODY_HEADERS for name, _ in scope.get("headers", ())):
            self._connections.begin(client)
        try:
            await self._app(scope, receive_and_note, send)
        finally:
            self._connections.finish(client)
