"""MBAP: the frames of Modbus TCP, and the connections on which clients send them.

Source: MODBUS Messaging on TCP/IP Implementation Guide V1.0b, section 3.1.3.
"""

from __future__ import annotations

import asyncio
import logging
import struct
from collections.abc import Awaitable, Callable
from typing import Any, NamedTuple, cast

from multidrop.gateway.modbus_codes import ModbusCode

MOST_DATA = 253  # bytes of a function code and its data (application protocol V1.1b3, 4.1)
_HEADER = struct.Struct(">HHHB")

SLICE = 64  # requests of a client that are answered before others have their turn,
SLICE_S = 0.002  # or so much time
MOST_CLIENTS = 64  # beside each other, on one TCP port
MOST_UNDER_WAY = 16  # requests of one client that wait for a line
IDLE_S = 300.0  # without a request, after which a client is let go
FORGETTABLE_S = 10.0  # the same, where a new client finds no place
STALLED_S = 10.0  # for which a client takes none of its answers
SWEEP_S = 1.0  # between looks at all clients

_log = logging.getLogger("multidrop.gateway")


class Garbage(ValueError):
    """Bytes that are no header of Modbus TCP."""


class MbapRequest(NamedTuple):
    """One request of a client."""

    transaction: int
    unit: int
    function: int
    data: bytes  # that follows the function code

    def reply(self, data: bytes) -> bytes:
        """Return the frame of a good reply."""
        return _HEADER.pack(self.transaction, 0, 2 + len(data), self.unit) + bytes([self.function]) + data

    def exception(self, code: int) -> bytes:
        """Return the frame of an exception."""
        return _HEADER.pack(self.transaction, 0, 3, self.unit) + bytes([self.function | 0x80, code])


def take_request(buffer: bytearray) -> MbapRequest | None:
    """Take the first request out of the bytes that came; None where it is not whole yet.

    Raises Garbage as soon as a header can be none: after it no frame's begin is known any more.
    """
    if len(buffer) >= 4 and buffer[2:4] != b"\0\0":
        raise Garbage(f"protocol id {int.from_bytes(buffer[2:4]):04X}H, and Modbus has 0")
    if len(buffer) < 6:
        return None
    length = int.from_bytes(buffer[4:6])
    if not 2 <= length <= 1 + MOST_DATA:
        raise Garbage(f"length {length}, and a frame has 2 to {1 + MOST_DATA} bytes after it")
    if len(buffer) < 6 + length:
        return None
    transaction, _, _, unit = _HEADER.unpack_from(buffer)
    request = MbapRequest(transaction, unit, buffer[7], bytes(buffer[8 : 6 + length]))
    del buffer[: 6 + length]
    return request


# The frame of the answer, at once or later; None: the connection is closed without one. What comes later is
# cancelled when the client is gone: shield what must be done all the same.
Answer = bytes | Awaitable[bytes] | None


class ModbusClient(asyncio.Protocol):
    """One connection: each request is answered under its own transaction id, whenever it is done."""

    def __init__(self, port: ModbusPort) -> None:
        self._port = port
        self._buffer = bytearray()
        self._under_way: set[asyncio.Future[bytes]] = set()
        self._is_draining = False
        self._is_refused = False  # it sent what closes its connection
        self._has_ended = False  # the client sends no more, and may still read
        self._stalled_since: float | None = None
        self.last_request = port.clock()
        self.address = ""
        self.transport: asyncio.Transport | None = None

    @property
    def is_full(self) -> bool:
        """True while as many of its requests wait for lines as one client may have."""
        return len(self._under_way) >= MOST_UNDER_WAY

    @property
    def is_idle(self) -> bool:
        """True while nothing of it is under way."""
        return not self._under_way

    # ---- what asyncio calls ----

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast(asyncio.Transport, transport)
        peer = transport.get_extra_info("peername")
        self.address = str(peer[0]) if peer else ""
        self._port.admit(self)

    def connection_lost(self, error: Exception | None) -> None:
        self.transport = None
        self._buffer.clear()
        self._port.forget(self)
        for task in self._under_way:
            asyncio.get_running_loop().call_soon(task.cancel)  # each has begun by then

    def data_received(self, data: bytes) -> None:
        self._buffer += data
        if not self._is_draining:
            self._drain()

    def eof_received(self) -> bool:
        """Keep the connection for the answers that are under way."""
        self._has_ended = True
        return bool(self._under_way or self._is_draining)

    def pause_writing(self) -> None:
        """Read no more from a client that does not take its answers."""
        self._stalled_since = self._port.clock()
        if self.transport is not None:
            self.transport.pause_reading()

    def resume_writing(self) -> None:
        self._stalled_since = None
        if self.transport is not None and not self._is_draining:
            self.transport.resume_reading()

    # ---- requests and answers ----

    def _drain(self) -> None:
        """Answer some of the requests that came, and let others have their turn before the next ones."""
        answers: list[bytes] = []
        self._is_draining = self._answer_some(answers)
        self._write(b"".join(answers))
        if self._is_draining:
            self._pause_for_others()
        elif self._is_refused:
            self.close()
        self._close_if_done()

    def _answer_some(self, answers: list[bytes]) -> bool:
        """Add the answers that are known at once; return True where more requests may be waiting."""
        begun = self._port.clock()
        for _ in range(SLICE):
            request = self._next_request() if self._buffer else None
            if request is None:
                return False
            self.last_request = begun
            answer = self._port.serve(request, self)
            if answer is None:
                self._is_refused = True
                return False
            if isinstance(answer, bytes):
                answers.append(answer)
            else:
                self._begin(request, answer)
            if self._buffer and self._port.clock() - begun > SLICE_S:
                break
        return True

    def _next_request(self) -> MbapRequest | None:
        try:
            return take_request(self._buffer)
        except Garbage as garbage:
            _log.info("modbus client %s is closed: %s", self.address, garbage)
            self._is_refused = True
            return None

    def _pause_for_others(self) -> None:
        if self.transport is not None:
            self.transport.pause_reading()
        asyncio.get_running_loop().call_soon(self._go_on)

    def _go_on(self) -> None:
        self._drain()
        if self.transport is not None and not self._is_draining and self._stalled_since is None:
            self.transport.resume_reading()

    def _begin(self, request: MbapRequest, answer: Awaitable[bytes]) -> None:
        task = asyncio.ensure_future(answer)
        self._under_way.add(task)
        task.add_done_callback(lambda done: self._finish(request, done))

    def _finish(self, request: MbapRequest, task: asyncio.Future[bytes]) -> None:
        self._under_way.discard(task)
        if not task.cancelled():
            failure = task.exception()
            if failure is not None:
                _log.error("modbus request %s", request, exc_info=failure)
            self._write(request.exception(ModbusCode.DEVICE_FAILURE) if failure else task.result())
        self._close_if_done()

    def _close_if_done(self) -> None:
        if self._has_ended and not self._under_way and not self._is_draining:
            self.close()

    def _write(self, data: bytes) -> None:
        if data and self.transport is not None and not self.transport.is_closing():
            self.transport.write(data)

    def close(self) -> None:
        """Close this connection once all that was written to it has left."""
        if self.transport is not None:
            self.transport.close()

    def abort(self) -> None:
        """Cut this connection at once."""
        if self.transport is not None:
            self.transport.abort()

    def stalled_for(self, now: float) -> float:
        """Return for how many seconds it has taken none of its answers."""
        return 0.0 if self._stalled_since is None else now - self._stalled_since


class ModbusPort:
    """One TCP port and its clients.

    `serve` answers a request; `may_connect` says which addresses may come; `clock` is in seconds.
    """

    def __init__(
        self,
        serve: Callable[[MbapRequest, ModbusClient], Answer],
        may_connect: Callable[[str], bool],
        clock: Callable[[], float],
    ) -> None:
        self.serve = serve
        self.clock = clock
        self.clients: set[ModbusClient] = set()
        self.refused = 0  # connections
        self._may_connect = may_connect
        self._server: asyncio.Server | None = None

    async def open(self, listener: Any) -> None:
        """Begin to accept clients on a listening socket."""
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(lambda: ModbusClient(self), sock=listener)

    def admit(self, client: ModbusClient) -> None:
        """Take a new client in; one that has been idle for long makes place where there is none."""
        if not self._may_connect(client.address):
            _log.warning("modbus client %s is refused: it is not among the clients", client.address)
            self.refused += 1
            client.abort()
            return
        if len(self.clients) >= MOST_CLIENTS and not self._make_place():
            _log.warning("modbus client %s is refused: %d are connected", client.address, MOST_CLIENTS)
            self.refused += 1
            client.abort()
            return
        self.clients.add(client)

    def _make_place(self) -> bool:
        idle = [client for client in self.clients if client.is_idle]
        oldest = min(idle, key=lambda client: client.last_request, default=None)
        if oldest is None or self.clock() - oldest.last_request < FORGETTABLE_S:
            return False
        self.forget(oldest)
        oldest.abort()
        return True

    def forget(self, client: ModbusClient) -> None:
        """Remove a client that is gone."""
        self.clients.discard(client)

    def sweep(self) -> None:
        """Let go of clients that have been idle for long, or that take none of their answers."""
        now = self.clock()
        for client in list(self.clients):
            if client.stalled_for(now) >= STALLED_S:
                client.abort()
            elif client.is_idle and now - client.last_request >= IDLE_S:
                client.close()

    def close(self) -> None:
        """Listen no more, and cut all connections."""
        if self._server is not None:
            self._server.close()
        for client in list(self.clients):
            client.abort()
