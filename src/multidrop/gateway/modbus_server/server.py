"""Modbus TCP server: answers clients such as SCADA systems, with polled values if possible.

Requests are received even from a client that does not read its answers. So a stop waits neither for earlier
requests nor until its client reads answers.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any, cast

from multidrop import BusError, Plant
from multidrop.gateway.clock import monotonic_ns
from multidrop.gateway.commands import Commands
from multidrop.gateway.http.connections import listen
from multidrop.gateway.http.rights import Right
from multidrop.gateway.live.hub import SILENT, Hub
from multidrop.gateway.modbus_server.address_map import AddressRow, address_map
from multidrop.gateway.modbus_server.passed_requests import ClientWrites, LineShare, Standstill
from multidrop.gateway.modbus_server.protocol import (
    WRITES,
    Declined,
    InvalidHeader,
    MbapRequest,
    ModbusCode,
    PassingBusy,
    code_of,
    function_of,
    read_range,
    reply_data,
    request_of,
    take_frame,
    take_request,
)
from multidrop.gateway.modbus_server.settings import MAIN, ModbusSettings, Unit, Units
from multidrop.gateway.modbus_server.words import Unavailable
from multidrop.gateway.parts import Ask, PartContext
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
        """Answer up to SLICE requests within `RoundShare.slice_s` seconds. Return True if more wait."""
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

    In a round, each of these clients has one turn, in which some of its requests are answered.
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


# ---- the server ----

Settings = ModbusSettings


def build(settings: ModbusSettings, context: PartContext) -> ModbusServer:
    """Return the listening server. Raises OSError if a port cannot be opened."""
    server = ModbusServer(context.plant, context.hub, context.commands, settings, context.ask)
    server.listen()
    return server


class ModbusServer:
    """The Modbus TCP server of a plant: a TCP port for each line in `ports`, and one for all other lines.

    `ask(drive, function, start, count, expiry)` reads words or bits from a drive; `expiry` is in s. Raises
    ValueError with all mistakes if unit ids clash.
    """

    def __init__(
        self, plant: Plant, hub: Hub, commands: Commands, settings: ModbusSettings, ask: Ask
    ) -> None:
        self.settings = settings
        # TCP port by line; with the key MAIN, the port of all lines without their own port
        self.ports: dict[str, int] = {}
        self._hub = hub
        self._commands = commands
        self._ask = ask
        self._units = Units(plant, settings)
        role = Right[settings.may.upper()]
        self._standstill = Standstill()
        self._writes = ClientWrites(commands, role, "modbus", settings.common_addresses, self._standstill)
        self._shares: dict[str, LineShare] = {}
        self._sockets: dict[str, Any] = {}  # listening socket of each port, with the keys of `ports`
        self._listening: list[ModbusPort] = []

    # ---- start and end ----

    def listen(self) -> None:
        """Open all TCP ports, or none. Raises OSError for the first port that cannot be opened."""
        for line, number in {MAIN: self.settings.port, **self.settings.ports}.items():
            try:
                self._sockets[line] = listen(self.settings.host, number)
            except OSError:
                self._close_sockets()
                raise
            self.ports[line] = self._sockets[line].getsockname()[1]

    async def run(self) -> None:
        """Accept clients, and close idle ones, until cancelled."""
        clock, share = asyncio.get_running_loop().time, RoundShare()
        for line, listener in self._sockets.items():
            port = ModbusPort(partial(self.serve, line), self.settings.may_connect, clock, share)
            await port.open(listener)
            self._listening.append(port)
        while True:
            await asyncio.sleep(SWEEP_S)
            self._standstill.note()
            for port in self._listening:
                port.sweep()

    def _close_sockets(self) -> None:
        for listener in self._sockets.values():
            listener.close()
        self._sockets, self.ports = {}, {}

    async def close(self) -> None:
        """Close all sockets and connections; stops in progress continue."""
        for port in self._listening:
            port.close()
        for share in self._shares.values():
            share.close()
        self._listening = []
        self._close_sockets()

    def adopt(self, plant: Plant) -> None:
        """Use another plant. If its unit ids clash, keep the present plant and raise ValueError."""
        self._units = Units(plant, self.settings)

    def address_map(self) -> list[AddressRow]:
        return address_map(self._units, self.settings, self.ports, self._commands.may)

    @property
    def clients(self) -> int:
        return sum(len(port.clients) for port in self._listening)

    # ---- requests ----

    def serve(self, port: str, request: MbapRequest, client: ModbusClient) -> Answer:
        """Return the answer to a request, or an awaitable of it.

        Return None for a broadcast, which has no answer. The caller then closes the connection.
        """
        if request.unit == 0:
            return None
        unit = self._units.find(port, request.unit)
        if unit is None:
            return request.exception(ModbusCode.NO_PATH)
        answer = self._writes.begin if request.function in WRITES else self._read
        try:
            return answer(unit, request, client)
        except Declined as declined:
            return request.exception(declined.code)

    # ---- reading ----

    def _read(self, unit: Unit, request: MbapRequest, client: ModbusClient) -> bytes | Awaitable[bytes]:
        addresses = read_range(request)
        function = request.function
        words = self._in_blocks(unit, addresses) if function in (3, 4) else None
        if words is None:
            found = unit.words.read(
                function,
                addresses,
                partial(self._hub.newest, unit.drive.name),
                monotonic_ns(),
                max(self._commands.ended_ns(unit.drive.name), self._hub.woke_ns()),
            )
            if isinstance(found, Unavailable):
                return self._pass(unit, request, addresses, found, client)
            words = found
        return request.reply(reply_data(function, words))

    def _in_blocks(self, unit: Unit, addresses: range) -> list[int] | None:
        """Return the words at these addresses of the common block or of the channel block.

        Return None for other addresses.
        """
        for start, block in ((self.settings.common, unit.common), (self.settings.channels, unit.channels)):
            reach = range(start, start + block.length)
            if addresses.start < reach.stop and reach.start < addresses.stop:
                if addresses[-1] not in reach or addresses.start not in reach:
                    raise Declined(ModbusCode.ILLEGAL_ADDRESS)
                words = block.words(self._hub, monotonic_ns())
                return words[addresses.start - start : addresses.stop - start]
        return None

    def _pass(
        self, unit: Unit, request: MbapRequest, addresses: range, reason: Unavailable, client: ModbusClient
    ) -> Awaitable[bytes]:
        """Pass a read on to the drive, if the settings allow it."""
        passing = self.settings.passing
        if passing == "off" and reason is Unavailable.UNPOLLED:
            raise Declined(ModbusCode.ILLEGAL_ADDRESS)
        if passing == "declared" and not unit.is_declared(request.function, addresses):
            raise Declined(ModbusCode.ILLEGAL_ADDRESS)
        if passing == "off" or self._hub.state(unit.drive.name) == SILENT:
            # not sent: the setting `passing` is "off", or the drive is silent
            raise Declined(ModbusCode.NO_RESPONSE)
        if client.is_full:
            raise Declined(ModbusCode.BUSY)
        share = self._shares.get(unit.line)
        if share is None:
            share = self._shares[unit.line] = LineShare()
        try:
            work = partial(self._ask, unit.drive.name, request.function, addresses.start, len(addresses))
            return self._passed(request, share.ask(client, work), len(addresses))
        except PassingBusy as busy:
            raise Declined(ModbusCode.BUSY) from busy

    async def _passed(self, request: MbapRequest, asked: Awaitable[list[int]], count: int) -> bytes:
        try:
            words = await asked
        except (BusError, ValueError, PassingBusy) as failure:
            return request.exception(code_of(failure))
        if len(words) != count:
            return request.exception(ModbusCode.NO_RESPONSE)
        return request.reply(reply_data(request.function, words))
