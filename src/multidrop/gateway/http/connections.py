"""Connections: how many may be open, how long one may take over its request, and whose turn it is.

Clients that are slow, silent or greedy do not delay the others. If there are too many connections, one of
theirs is closed, and a new one, which may bring a stop, always gets in. Requests are answered one at a time;
those that may stop a drive come first.
"""

from __future__ import annotations

import asyncio
import errno
import socket
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from enum import IntEnum
from typing import Any

from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from multidrop.gateway.http.messages import JsonResponse

MOST_OPEN = 256  # a process has 1024 descriptors as a rule, and lines and files need some
FIRST_S = 10.0  # for a TLS handshake and the whole first request
AGAIN_S = 40.0  # for a later one; the server itself closes a silent connection after 30 s
FRESH_S = 1.0  # in which a new connection's first request should be there
MOST_FRESH = 64  # such connections that are closed after all others
STALLED_S = 10.0  # for which a client may take none of its answers

ENDS = "the gateway ends: it is not known what became of this"

BODY_HEADERS = (b"content-length", b"transfer-encoding")
STOP_PATHS, VERB_PATH = ("/api/stop", "/api/fleet/stop"), "/api/act"  # a verb may stop a drive, too


class Rank(IntEnum):
    """The order in which connections are closed if there are too many; of one rank the oldest goes first."""

    GREEDY = 0  # its client sends requests before it has its answers, or takes none
    IDLE = 1
    BUSY = 2
    FRESH = 3  # it is new, and its first request is not here yet
    STOPS = 4  # its request may be a stop


class _Open:
    """One connection."""

    __slots__ = ("ends", "fresh_until", "is_busy", "is_greedy", "is_stop", "peer", "stalled_since")

    def __init__(self, peer: socket.socket, now: float) -> None:
        self.peer = peer
        self.ends = now + FIRST_S  # unless its next request is complete by then
        self.fresh_until = now + FRESH_S
        self.is_busy = self.is_stop = False
        self.is_greedy = False
        self.stalled_since: float | None = None

    def rank(self, now: float) -> Rank:
        if self.is_stop:
            return Rank.STOPS
        if self.is_greedy or (self.stalled_since is not None and now - self.stalled_since > FRESH_S):
            return Rank.GREEDY
        if self.is_busy:
            return Rank.BUSY
        return Rank.FRESH if now < self.fresh_until else Rank.IDLE

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
        now = self._clock()
        self._open[address[:2]] = _Open(peer, now)
        while len(self._open) > MOST_OPEN:
            ranks = {client: one.rank(now) for client, one in self._open.items() if client != address[:2]}
            fresh = [client for client, rank in ranks.items() if rank is Rank.FRESH]
            is_flood = len(fresh) > MOST_FRESH and Rank.GREEDY not in ranks.values()
            self._end(fresh[0] if is_flood else min(ranks, key=lambda client: ranks[client]))

    def sweep(self) -> None:
        """Close those that took too long."""
        self._forget_closed()
        now = self._clock()
        for client, one in [*self._open.items()]:
            is_stalled = one.stalled_since is not None and now - one.stalled_since > STALLED_S
            if is_stalled or (not one.is_busy and one.ends < now):
                self._end(client)

    def begin(self, client: tuple[str, int] | None) -> None:
        """Note that a request is complete."""
        if client in self._open:
            self._open[client].is_busy = True

    def is_stop(self, client: tuple[str, int] | None, path: str) -> bool:
        """Return, and note, whether a new request counts as a stop.

        One of a verb is not while its client sends others ahead of its answers.
        """
        found = self._open.get(client) if client else None
        is_stop = path in STOP_PATHS or (path == VERB_PATH and not (found and found.is_greedy))
        if found:
            found.is_stop = is_stop
        return is_stop

    def note_greed(self, client: tuple[str, int] | None, *, is_greedy: bool) -> None:
        """Note whether more requests came than were answered."""
        if client in self._open:
            self._open[client].is_greedy = is_greedy

    def note_stall(self, client: tuple[str, int] | None, *, is_stalled: bool) -> None:
        """Note whether answers wait for a client that does not take them."""
        if client in self._open:
            self._open[client].stalled_since = self._clock() if is_stalled else None

    def finish(self, client: tuple[str, int] | None) -> None:
        """Note that a request was answered."""
        if client in self._open:
            found = self._open[client] = self._open.pop(client)  # the last one in order
            found.is_busy = found.is_stop = False
            found.fresh_until, found.ends = 0.0, self._clock() + AGAIN_S

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


class Turns:
    """Turns of requests: one in each round of the loop, those in `stops` first.

    The loop reads the sockets in each round, so a stop waits for one request instead of all.
    """

    def __init__(self) -> None:
        self.stops: deque[asyncio.Future[None]] = deque()
        self.others: deque[asyncio.Future[None]] = deque()
        self._is_taken = False  # in this round

    async def wait(self, waiting: deque[asyncio.Future[None]]) -> None:
        """Wait for a turn behind those that wait here."""
        loop = asyncio.get_running_loop()
        if self._is_taken:
            turn: asyncio.Future[None] = loop.create_future()
            waiting.append(turn)
            await turn
        else:
            self._is_taken = True
            loop.call_soon(self._give)

    def _give(self) -> None:
        self._is_taken = False
        while not self._is_taken and (waiting := self.stops or self.others):
            turn = waiting.popleft()
            if not turn.done():  # its request was cancelled
                turn.set_result(None)
                self._is_taken = True
                asyncio.get_running_loop().call_soon(self._give)


class WatchedProtocol(H11Protocol):
    """A connection that reports clients that send requests ahead of their answers, or do not read these."""

    @property
    def _connections(self) -> Connections:
        app: Any = self.config.app
        found: Connections = app.connections
        return found

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        cycle = self.cycle
        if cycle is not None and not cycle.response_complete and not cycle.more_body:
            self._note_greed()

    def on_response_complete(self) -> None:
        super().on_response_complete()
        self._note_greed()

    def _note_greed(self) -> None:
        waiting, _ = self.conn.trailing_data
        self._connections.note_greed(self.client, is_greedy=bool(waiting))

    def pause_writing(self) -> None:
        super().pause_writing()
        self._connections.note_stall(self.client, is_stalled=True)

    def resume_writing(self) -> None:
        super().resume_writing()
        self._connections.note_stall(self.client, is_stalled=False)


class Watched:
    """An application that notes in `connections` when a request is complete and when it is answered.

    Each request waits for its turn; one that may be a stop is before all others.
    """

    def __init__(self, app: ASGIApp, connections: Connections) -> None:
        self.connections = self._connections = connections
        self._app = app
        self._turns = Turns()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        client, has_begun = scope.get("client"), False

        async def receive_and_note() -> Message:
            message = await receive()
            if message["type"] == "http.request" and not message.get("more_body", False):
                self._connections.begin(client)
            return message

        async def send_and_note(message: Message) -> None:
            nonlocal has_begun
            has_begun = True
            await send(message)

        is_stop = self._connections.is_stop(client, scope.get("path", ""))
        if not any(name in BODY_HEADERS for name, _ in scope.get("headers", ())):
            self._connections.begin(client)
        try:
            await self._turns.wait(self._turns.stops if is_stop else self._turns.others)
            await self._app(scope, receive_and_note, send_and_note)
        except asyncio.CancelledError:  # the server ends, and waits for it no longer
            if not has_begun:
                await JsonResponse({"error": ENDS}, 503)(scope, receive, send)
        finally:
            self._connections.finish(client)


BACKLOG = 64  # connections that wait, and that are taken at once: their descriptors are not bounded yet

_WHY = {
    errno.EADDRINUSE: "another program listens there",
    errno.EACCES: "this user may not",
    errno.EADDRNOTAVAIL: "it is no address of this machine",
}


def listen(host: str, port: int) -> CountingSocket:
    """Return a listening socket. Raises OSError with a sentence where the port cannot be had."""
    try:
        family, _, _, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
    except socket.gaierror as failure:
        raise OSError(f"listen: {host} is no address of this machine: {failure.strerror}") from failure
    # With its protocol named asyncio sets TCP_NODELAY: else each frame waits 40 ms.
    listener = CountingSocket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.listen(BACKLOG)
        listener.setblocking(False)
    except OSError as failure:
        listener.close()
        reason = _WHY.get(failure.errno or 0, failure.strerror)
        raise OSError(f"listen: {host}:{port} cannot be had: {reason}") from failure
    return listener
