"""Connections of Modbus TCP clients.

Requests are received even from a client that does not read its answers. So a stop waits neither for earlier
requests nor until its client reads answers.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from typing import Any, cast

from multidrop.gateway.modbus_server.protocol import (
    WRITES,
    InvalidHeader,
    MbapRequest,
    ModbusCode,
    function_of,
    request_of,
    take_frame,
    take_request,
)
from multidrop.supervisor import supervisor

SLICE = 64  # limit of requests of one client that are answered in one turn
SLICE_S = 0.002  # limit, in s, of the duration of one client's turn
ROUND_S = 0.004  # in s: in this time each busy client has a turn, so a stop waits at most this long
MOST_CLIENTS = 64  # limit of clients per TCP port
MOST_BEHIND = 1 << 18  # limit, in bytes, of the requests of one client that wait for a turn
MOST_UNTAKEN = 1 << 18  # limit, in bytes, of the answers that one client has not read yet
MOST_UNDER_WAY = 16  # limit of one client's requests that wait for a drive's line
IDLE_S = 300.0  # in s: a client that sends no request for this long is disconnected
# in s: a client without a request for this long is disconnected if a new client needs its place
FORGETTABLE_S = 10.0
STALLED_S = 10.0  # in s: a client that reads none of its answers for this long is disconnected
SWEEP_S = 1.0  # interval, in s, of checking all clients for these limits

_log = logging.getLogger("multidrop.gateway")

# The answer to a request: a frame, or an awaitable of the frame. None closes the connection. If the client
# disconnects, the awaitable is cancelled, so work that must be finished has to be shielded.
Answer = bytes | Awaitable[bytes] | None


class ModbusClient(asyncio.Protocol):
    """One client's connection. Each answer is sent as soon as it is ready.

    Writes start when they arrive, in their order. Other requests wait for the client's turn.
    """

    def __init__(self, port: ModbusPort) -> None:
        self._port = port
        self._came = bytearray()  # received bytes, not parsed yet
        self._waiting = bytearray()  # received requests that wait for the client's turn
        self._under_way: set[asyncio.Future[bytes]] = set()
        self._is_draining = False
        # True: a request was forbidden or invalid, and the connection will be closed
        self._is_refused = False
        # True: the client has closed its sending direction, but may still read answers
        self._has_ended = False
        self._has_lost_answers = False
        self._stalled_since: float | None = None
        self.last_request = port.clock()
        self.address = ""
        self.transport: asyncio.Transport | None = None

    @property
    def is_full(self) -> bool:
        """True while MOST_UNDER_WAY of this client's requests wait for lines."""
        return len(self._under_way) >= MOST_UNDER_WAY

    @property
    def is_idle(self) -> bool:
        return not self._under_way

    # ---- called by asyncio ----

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast(asyncio.Transport, transport)
        peer = transport.get_extra_info("peername")
        self.address = str(peer[0]) if peer else ""
        self._port.admit(self)

    def connection_lost(self, error: Exception | None) -> None:
        self.transport = None
        self._came.clear()
        self._waiting.clear()
        self._port.share.note(self, is_busy=False)
        self._port.forget(self)
        for task in self._under_way:
            # Give a new task time to start. Without a start it would not cancel the request that it awaits.
            asyncio.get_running_loop().call_soon(task.cancel)

    def data_received(self, data: bytes) -> None:
        if self._is_refused:
            return
        self._came += data
        if not self._is_draining:
            self._drain()

    def eof_received(self) -> bool:
        """Keep the connection open for pending answers."""
        self._has_ended = True
        return bool(self._under_way or self._waiting or self._is_draining)

    def pause_writing(self) -> None:
        """Note that the client does not read its answers.

        asyncio calls this when its write buffer is full. From now on the client's reads wait, but its writes,
        which may be stops, still start on arrival.
        """
        self._stalled_since = self._port.clock()

    def resume_writing(self) -> None:
        self._stalled_since = None
        if not self._is_draining:
            self._drain()

    # ---- requests and answers ----

    def _drain(self) -> None:
        """Parse received bytes and answer some requests; the rest is done after other clients' turns."""
        is_looked_at = self._look()
        self._is_draining = self._answer_some() or not is_looked_at
        self._port.share.note(self, is_busy=self._is_draining)
        if self.transport is not None:
            if is_looked_at:
                self.transport.resume_reading()
            else:
                self.transport.pause_reading()
        if self._is_draining:
            asyncio.get_running_loop().call_soon(self._drain)
        elif self._is_refused and not self._waiting:
            self.close()
        self._close_if_done()

    def _look(self) -> bool:
        """Start the writes among the received requests, and queue the others.

        Return False if the time was too short for all requests.
        """
        begun = self._port.clock()
        answers: list[bytes] = []
        is_in_time = True
        while self._came and is_in_time:
            frame = self._next_frame()
            if frame is None:
                break
            self.last_request = begun
            if function_of(frame) in WRITES:
                answers.append(self._answered(request_of(frame)))
            elif len(self._waiting) + len(frame) <= MOST_BEHIND:
                self._waiting += frame
            else:
                answers.append(request_of(frame).exception(ModbusCode.BUSY))
            is_in_time = self._port.clock() - begun <= self._port.share.slice_s
        self._write(b"".join(answers))
        return is_in_time or not self._came

    def _next_frame(self) -> bytes | None:
        try:
            return take_frame(self._came)
        except InvalidHeader as mistake:
            _log.info("modbus client %s is closed: %s", self.address, mistake)
            self._refuse()
            return None

    def _refuse(self) -> None:
        """Ignore all further requests of this client."""
        self._is_refused = True
        self._came.clear()

    def _answer_some(self) -> bool:
        """Answer up to SLICE requests in `RoundShare.slice_s` seconds. Return True if more can follow."""
        begun = self._port.clock()
        answers: list[bytes] = []
        for _ in range(SLICE):
            request = take_request(self._waiting) if self._stalled_since is None else None
            if request is None:
                break
            answers.append(self._answered(request))
            if self._port.clock() - begun > self._port.share.slice_s:
                break
        self._write(b"".join(answers))
        return bool(self._waiting) and self._stalled_since is None

    def _answered(self, request: MbapRequest) -> bytes:
        """Return the answer to a request; b"" if it follows later, or if there is none."""
        answer = self._port.serve(request, self)
        if isinstance(answer, bytes):
            return answer
        if answer is None:
            self._refuse()
            self._waiting.clear()
        else:
            self._begin(request, answer)
        return b""

    def _begin(self, request: MbapRequest, answer: Awaitable[bytes]) -> None:
        task = supervisor().start("modbus answer", _awaited(answer))
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
        if self._has_ended and not (self._under_way or self._waiting or self._is_draining):
            self.close()

    def _write(self, data: bytes) -> None:
        """Send answers. Drop them if the client has stopped reading and has left too many bytes unread."""
        if not data or self.transport is None or self.transport.is_closing():
            return
        if self._stalled_since is not None and self.transport.get_write_buffer_size() > MOST_UNTAKEN:
            if not self._has_lost_answers:
                _log.warning("modbus client %s does not read its answers; some are dropped", self.address)
            self._has_lost_answers = True
            return
        self.transport.write(data)

    def close(self) -> None:
        """Close this connection after its pending bytes are sent."""
        if self.transport is not None:
            self.transport.close()

    def abort(self) -> None:
        if self.transport is not None:
            self.transport.abort()

    def stalled_for(self, now: float) -> float:
        """Return for how many seconds this client has read none of its answers."""
        return 0.0 if self._stalled_since is None else now - self._stalled_since


class RoundShare:
    """Divides the event loop's time among all clients with waiting requests.

    In a round, each such client has one turn, in which some of its requests are answered.
    """

    def __init__(self) -> None:
        self._busy: set[ModbusClient] = set()

    def note(self, client: ModbusClient, *, is_busy: bool) -> None:
        if is_busy:
            self._busy.add(client)
        else:
            self._busy.discard(client)

    @property
    def slice_s(self) -> float:
        """The longest duration, in s, of one client's turn in the present round."""
        return min(SLICE_S, ROUND_S / max(1, len(self._busy)))


async def _awaited(answer: Awaitable[bytes]) -> bytes:
    return await answer


class ModbusPort:
    """One TCP port and its clients.

    `serve` answers a request, `may_connect` returns whether a client's address is allowed, and `clock`
    returns seconds. All ports of a server have the same `share`.
    """

    def __init__(
        self,
        serve: Callable[[MbapRequest, ModbusClient], Answer],
        may_connect: Callable[[str], bool],
        clock: Callable[[], float],
        share: RoundShare | None = None,
    ) -> None:
        self.serve = serve
        self.clock = clock
        self.share = share or RoundShare()
        self.clients: set[ModbusClient] = set()
        self.refused = 0
        self._may_connect = may_connect
        self._server: asyncio.Server | None = None

    async def open(self, listener: Any) -> None:
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(lambda: ModbusClient(self), sock=listener)

    def admit(self, client: ModbusClient) -> None:
        """Accept a new client or refuse it.

        If the port is full, close the client that has been idle longest.
        """
        if not self._may_connect(client.address):
            _log.warning("modbus client %s is refused: its address is not in clients", client.address)
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
        self.clients.discard(client)

    def sweep(self) -> None:
        """Close clients that have been idle for too long, or that do not read their answers."""
        now = self.clock()
        for client in list(self.clients):
            if client.stalled_for(now) >= STALLED_S:
                client.abort()
            elif client.is_idle and now - client.last_request >= IDLE_S:
                client.close()

    def close(self) -> None:
        """Stop listening, and close all connections immediately."""
        if self._server is not None:
            self._server.close()
        for client in list(self.clients):
            client.abort()
