"""HTTP connections: limit their number and duration, and order their requests.

A slow, silent or greedy client does not delay the others. A new connection is always accepted, because its
request may stop a motor. If MOST_OPEN connections are open already, an old one is closed for it, a greedy
client's first. Requests start one by one, and those that may be stops start first.
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

# limit of open connections; a process usually has 1024 file descriptors, and lines and files need some
MOST_OPEN = 256
# time limit, in s, from the opening of a connection to its first complete request, including a TLS handshake
FIRST_S = 10.0
# time limit, in s, from an answer to the next complete request. uvicorn closes a silent connection after 30 s
# already.
AGAIN_S = 40.0
FRESH_S = 1.0  # in s: a connection without a request counts as fresh (see Rank) for this long
MOST_FRESH = 64  # limit of fresh connections: above it, the oldest fresh connection is closed first
STALLED_S = 10.0  # in s: a client that reads none of its answers for this long is disconnected

ENDS = "the gateway is shutting down: the outcome of this request is unknown"

BODY_HEADERS = (b"content-length", b"transfer-encoding")
# paths of stop requests; a request to VERB_PATH may be a stop too, depending on its body
STOP_PATHS, VERB_PATH = ("/api/stop", "/api/fleet/stop"), "/api/act"
MAY_STOP = frozenset((*STOP_PATHS, VERB_PATH))
BACKLOG = 64  # limit of new connections that the operating system holds until the gateway accepts them
_WHY = {
    errno.EADDRINUSE: "another program listens there",
    errno.EACCES: "this user has no permission",
    errno.EADDRNOTAVAIL: "this machine does not have this address",
}


class Rank(IntEnum):
    """Kinds of connections, in the order in which they are closed when more than MOST_OPEN are open.

    Among connections of one kind, the one that comes first in `Connections` is closed first.
    """

    GREEDY = 0  # the client sends requests without waiting for answers, or does not read its answers
    IDLE = 1
    BUSY = 2
    FRESH = 3  # the connection is new, and no request has arrived on it yet
    STOPS = 4  # the request may be a stop


class _OpenConnection:
    __slots__ = ("ends", "fresh_until", "is_busy", "is_greedy", "is_stop", "peer", "stalled_since")

    def __init__(self, peer: socket.socket, now: float) -> None:
        self.peer = peer
        self.ends = now + FIRST_S  # deadline for the client's next request
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
        """Shut the socket down; the web server then closes the connection."""
        with suppress(OSError):  # the socket is closed already
            self.peer.shutdown(socket.SHUT_RDWR)


class Connections:
    """The open connections by client address.

    They are ordered by the time of the latest answer, or else of the opening.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._open: dict[tuple[str, int], _OpenConnection] = {}
        self.ended = 0  # number of connections that this object has closed

    def add(self, peer: socket.socket, address: Any) -> None:
        """Note a new connection, and close older ones while more than MOST_OPEN are open."""
        self._forget_closed()
        self._open.pop(address[:2], None)
        now = self._clock()
        self._open[address[:2]] = _OpenConnection(peer, now)
        while len(self._open) > MOST_OPEN:
            ranks = {client: one.rank(now) for client, one in self._open.items() if client != address[:2]}
            fresh = [client for client, rank in ranks.items() if rank is Rank.FRESH]
            is_flood = len(fresh) > MOST_FRESH and Rank.GREEDY not in ranks.values()
            self._end(fresh[0] if is_flood else min(ranks, key=lambda client: ranks[client]))

    def sweep(self) -> None:
        """Close the connections that exceeded a time limit."""
        self._forget_closed()
        now = self._clock()
        for client, one in [*self._open.items()]:
            is_stalled = one.stalled_since is not None and now - one.stalled_since > STALLED_S
            if is_stalled or (not one.is_busy and one.ends < now):
                self._end(client)

    def begin(self, client: tuple[str, int] | None) -> None:
        """Note that a complete request of this client has arrived."""
        if client in self._open:
            self._open[client].is_busy = True

    def is_stop(self, client: tuple[str, int] | None, path: str) -> bool:
        """Record and return whether a new request of this client may be a stop.

        A request to VERB_PATH does not count as a stop if its client sends requests without waiting for
        answers.
        """
        found = self._open.get(client) if client else None
        is_stop = path in STOP_PATHS or (path == VERB_PATH and not (found and found.is_greedy))
        if found:
            found.is_stop = is_stop
        return is_stop

    def note_greed(self, client: tuple[str, int] | None, *, is_greedy: bool) -> None:
        """Note whether the client sends requests without waiting for answers."""
        if client in self._open:
            self._open[client].is_greedy = is_greedy

    def note_stall(self, client: tuple[str, int] | None, *, is_stalled: bool) -> None:
        """Note whether answers are unsent because the client does not read."""
        if client in self._open:
            self._open[client].stalled_since = self._clock() if is_stalled else None

    def finish(self, client: tuple[str, int] | None) -> None:
        """Note that a request of this client was answered."""
        if client in self._open:
            found = self._open[client] = self._open.pop(client)  # now the last one in `_open`
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
    """A listening socket that adds each connection to `connections`."""

    connections: Connections | None = None

    def accept(self) -> tuple[socket.socket, Any]:
        peer, address = super().accept()
        if self.connections is not None:
            self.connections.add(peer, address)
        return peer, address


class Turns:
    """Starts one request in each round of the event loop, requests in the queue `stops` first.

    The loop reads all sockets in each round, so a stop waits for one other request at most.
    """

    def __init__(self) -> None:
        self.stops: deque[asyncio.Future[None]] = deque()
        self.others: deque[asyncio.Future[None]] = deque()
        self._is_taken = False  # True: the event loop's present round has started a request

    async def wait(self, waiting: deque[asyncio.Future[None]]) -> None:
        """Wait until a request in the queue `waiting` may start."""
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
            if not turn.done():  # a cancelled request is done already, and takes no turn
                turn.set_result(None)
                self._is_taken = True
                asyncio.get_running_loop().call_soon(self._give)


class WatchedProtocol(H11Protocol):
    """An HTTP connection that reports a client which does not wait for answers, or does not read them."""

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


class WatchedApp:
    """An ASGI application that reports the start and end of each request to `connections`.

    Requests wait for each other; those that may be stops go first.
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
        except asyncio.CancelledError:  # the server is shutting down
            if not has_begun:
                await JsonResponse({"error": ENDS}, 503)(scope, receive, send)
        finally:
            self._connections.finish(client)


def listen(host: str, port: int) -> CountingSocket:
    """Return a listening socket. Raises OSError, with a message for the user, if that fails."""
    try:
        family, _, _, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
    except socket.gaierror as failure:
        raise OSError(
            f"listen: this machine does not have the address {host}: {failure.strerror}"
        ) from failure
    # With IPPROTO_TCP, asyncio sets TCP_NODELAY. Without it, each answer would be delayed by 40 ms.
    listener = CountingSocket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.listen(BACKLOG)
        listener.setblocking(False)
    except OSError as failure:
        listener.close()
        reason = _WHY.get(failure.errno or 0, failure.strerror)
        raise OSError(f"listen: {host}:{port} cannot be opened: {reason}") from failure
    return listener
