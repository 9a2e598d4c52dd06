"""Tool ports: interfaces through which a drive vendor's PC tool reaches the drives of a line.

A tool port behaves like the line itself: a request to an unused address, or to a silent drive, gets no reply.
Reads are sent to the drive one at a time, in the line's spare time. Writes obey the same rules as those of
Modbus TCP clients.
"""

from __future__ import annotations

import asyncio
import logging
import socket
import sys
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from multidrop import BusError, Plant, PlantLine
from multidrop.core import Framing
from multidrop.drive import DEVICE_ID, MEI_DEVICE_ID, SERVER_ID, STATUS
from multidrop.gateway.commands import Commands
from multidrop.gateway.http.connections import listen
from multidrop.gateway.http.rights import Right
from multidrop.gateway.live.hub import SILENT, Hub
from multidrop.gateway.modbus_server.passed_requests import ClientWrites, LineShare, Standstill
from multidrop.gateway.modbus_server.protocol import (
    WRITES,
    Declined,
    MbapRequest,
    ModbusCode,
    PassingBusy,
    code_of,
    read_range,
    reply_data,
)
from multidrop.gateway.modbus_server.settings import (
    NETWORK,
    ROLES,
    Unit,
    client_mistakes,
    is_allowed,
    listen_mistakes,
)
from multidrop.gateway.modbus_server.tool_connections import (
    EXCEPTION,
    Connection,
    End,
    RequestCutter,
    Terminal,
    rtu_reply,
)
from multidrop.gateway.parts import Ask, PartContext
from multidrop.gateway.settings import refuse
from multidrop.printable import did_you_mean
from multidrop.supervisor import supervisor
from multidrop.toml_check import ADDRESS, parse_address

RTU_EXAMPLE = 'rtu = { hall = "127.0.0.1:4001" }'
LEAST_TIMEOUT_S, MOST_TIMEOUT_S = 0.05, 10.0
_TEXT = {"type": "string", "minLength": 1}
WAY = "tool"
# limits of the PC tools' share of a line's bus time: on a line that polling uses fully, and on an idle line
LEAST_SHARE, MOST_SHARE = 0.1, 0.5
MOST_TOOLS = 8  # limit of TCP connections to one line
# pause, in s, between two reads from a PC tool, so that it cannot keep the event loop busy
PAUSE_S = 0.005
REST_S = 0.2  # in s: an incomplete request is dropped if no byte arrives for this long
PLAN_S = 60.0  # time limit, in s, for computing the share of bus time that polling uses
IDLE_S = 300.0  # in s: a TCP connection without a request for this long is closed
SWEEP_S = 1.0  # interval, in s, of checking for idle connections
# Share of `timeout` after which a request is answered at the latest: a stop although the motor still runs,
# and a read although the line was not free.
WAIT_SHARE = 0.75
# Exception codes for a drive that cannot be reached. The PC tool gets no reply then, as on a real line.
_UNREACHABLE = (ModbusCode.NO_PATH, ModbusCode.NO_RESPONSE)
_log = logging.getLogger("multidrop.gateway")
# A function that starts a request. It returns None if the request gets no answer. Else it returns an
# awaitable of the answer's frame, or of None if it turns out that no answer is sent.
Serve = Callable[[MbapRequest, "Tool"], Awaitable["bytes | None"] | None]


@dataclass(frozen=True)
class ToolSettings:
    """The settings of the ports for vendors' PC tools. Raises ValueError with a line for each mistake."""

    # Path of the symbolic link to a line's pseudo-terminal, by line.
    pty: Mapping[str, str] = field(default_factory=dict, metadata={"additionalProperties": _TEXT})
    # Host and port where the gateway accepts RTU over TCP for a line, by line.
    rtu: Mapping[str, str] = field(
        default_factory=dict, metadata={"additionalProperties": {**_TEXT, **ADDRESS}}
    )
    # The role of all connected PC tools: "look", "stop" or "write".
    may: str = field(default="look", metadata={"enum": [*ROLES]})
    # Addresses and networks that may connect to the TCP ports in `rtu`; empty: only this computer.
    clients: Sequence[str] = field(default=(), metadata={"items": {"type": "string", "pattern": NETWORK}})
    # Time limit, in s, for the answer to a request. It should be shorter than the tool's own timeout.
    timeout: float = field(default=0.4, metadata={"minimum": LEAST_TIMEOUT_S, "maximum": MOST_TIMEOUT_S})

    def __post_init__(self) -> None:
        refuse(self._mistakes())

    def check(self, plant: Plant) -> Iterator[str]:
        """Yield an error for each line in `pty` or `rtu` that is unknown or has no Modbus drives."""
        lines = {line.name: line for line in plant.lines}
        for key, given in (("pty", self.pty), ("rtu", self.rtu)):
            for name in given if lines else ():
                line = lines.get(name)
                if line is None:
                    yield f"{key}: there is no line {name!r}; {did_you_mean(name, lines)}"
                elif all(polled.drive.framing is Framing.DELIXI for polled in line.drives):
                    yield f"{key}: all drives of line {name} speak Delixi's own protocol; tools need Modbus"

    def may_connect(self, address: str) -> bool:
        return is_allowed(address, self.clients)

    @property
    def addresses(self) -> dict[str, tuple[str, int]]:
        """The host and port of each listening socket, by the setting's key, such as "rtu.hall"."""
        return {f"rtu.{line}": parse_address(where, RTU_EXAMPLE) for line, where in self.rtu.items()}

    @property
    def lines(self) -> list[str]:
        return [*dict.fromkeys((*self.pty, *self.rtu))]

    def _mistakes(self) -> Iterator[str]:
        if sys.platform == "win32":
            yield "Windows has no tool ports, because its event loop cannot watch their sockets; use Linux"
        if not self.lines:
            yield 'pty and rtu are empty; write pty = { hall = "/run/multidrop/hall" } with a line\'s name'
        if self.may not in ROLES:
            yield f"may = {self.may!r} is not one of {', '.join(ROLES)}"
        if not LEAST_TIMEOUT_S <= self.timeout <= MOST_TIMEOUT_S:
            yield f"timeout = {self.timeout:g} is not from {LEAST_TIMEOUT_S} to {MOST_TIMEOUT_S:g} s"
        yield from client_mistakes(self.clients)
        for key, given in (("pty", self.pty), ("rtu", self.rtu)):
            owners: dict[str, str] = {}
            for line, where in given.items():
                if not isinstance(where, str) or not where:
                    yield f"{key}: {line} = {where!r} is not a text"
                    continue
                if key == "rtu":
                    yield from listen_mistakes(where, RTU_EXAMPLE, self.clients)
                if where in owners and not where.endswith(":0"):
                    yield f"{key}: {line} = {where!r} is in use by {owners[where]}"
                owners[where] = line


def build(settings: ToolSettings, context: PartContext) -> ToolPorts:
    """Open and return the ports for vendors' PC tools. Raises OSError if one cannot be opened."""
    plant, hub, commands, folder = context.plant, context.hub, context.commands, context.folder
    ports = ToolPorts(plant, hub, commands, settings, context.ask, folder)
    ports.listen()
    return ports


class Tool:
    """A connected PC tool of a drive vendor. Only its newest request is answered.

    A tool sends a request only after it has given up the previous one. A reply that comes more than `timeout`
    seconds after its request is dropped, because the tool could take it for the reply to its next request.
    """

    is_full = False  # a single tool has no limit of concurrent writes; its line has one

    def __init__(self, end: End, serve: Serve, timeout: float) -> None:
        self.address = end.address
        self.is_open = True
        self._end = end
        self._serve = serve
        self._timeout = timeout
        self._cutter = RequestCutter()
        self._newest: MbapRequest | None = None
        self._answering: asyncio.Task[None] | None = None
        self._rest: asyncio.TimerHandle | None = None  # timer that drops an incomplete request
        self._loop = asyncio.get_running_loop()
        self.last_request = self._loop.time()
        self._listen()

    def _listen(self) -> None:
        if self.is_open:
            self._loop.add_reader(self._end.fileno(), self._receive)

    def _receive(self) -> None:
        self._loop.remove_reader(self._end.fileno())
        if self._take_in():
            self._loop.call_later(PAUSE_S, self._listen)

    def _take_in(self) -> bool:
        """Read bytes from the PC tool, and start their requests. Return False if it has disconnected."""
        try:
            data = self._end.read()
        except OSError as failure:
            _log.warning("tool port %s is closed: %s", self.address, failure)
            data = b""
        if data == b"":
            self.close()
            return False
        if data:
            self._cutter.add(data)
            self._begin_all()
            self._stop_waiting()
            if self._cutter.has_rest:
                self._rest = self._loop.call_later(REST_S, self._drop_rest)
        return True

    def _begin_all(self) -> None:
        while (request := self._cutter.take()) is not None:
            try:
                self._begin(request)
            except Exception:  # continue, because a later request may be a stop
                _log.exception("a request of tool %s failed", self.address)

    def _drop_rest(self) -> None:
        """Read from the PC tool once more. If that brings nothing, drop the incomplete request.

        Then serve the complete requests that follow it, because a stop may be among them.
        """
        self._rest = None
        if self._take_in() and self._rest is None:
            while self._cutter.skip():
                self._begin_all()

    def _stop_waiting(self) -> None:
        if self._rest is not None:
            self._rest.cancel()
            self._rest = None

    def _begin(self, request: MbapRequest) -> None:
        """Start a request. A pending answer to the previous request will not be sent."""
        self._give_up()
        self._end.discard()
        self.last_request = self._loop.time()
        self._newest = request
        answer = self._serve(request, self)
        if answer is not None:
            self._answering = supervisor().start("tool answer", self._answer(request, answer))

    def _give_up(self) -> None:
        if self._answering is not None and not self._answering.done():
            # Give a new task time to start. Without a start it would not cancel the request that it awaits.
            self._loop.call_soon(self._answering.cancel)
        self._answering = None

    async def _answer(self, request: MbapRequest, answer: Awaitable[bytes | None]) -> None:
        until = self._loop.time() + self._timeout
        try:
            async with asyncio.timeout_at(until):
                frame = await answer
        except TimeoutError:
            return
        if frame is None or not self.is_open or request is not self._newest:
            return
        self._end.write(rtu_reply(frame))
        await asyncio.sleep(max(0.0, until - self._loop.time()))
        if self.is_open:
            self._end.discard()

    def close(self) -> None:
        """Close the connection; a pending answer is not sent, but writes in progress continue."""
        if not self.is_open:
            return
        self.is_open = False
        self._give_up()
        self._stop_waiting()
        self._loop.remove_reader(self._end.fileno())
        self._end.close()


class ToolLine:
    """Serves the requests of PC tools to the drives of one line."""

    def __init__(
        self,
        line: PlantLine,
        hub: Hub,
        commands: Commands,
        settings: ToolSettings,
        ask: Ask,
        standstill: Standstill,
    ) -> None:
        self.share = LineShare(LEAST_SHARE)
        self._name = line.name
        self._units = {polled.drive.address: Unit(line.name, polled) for polled in line.drives}
        self._hub = hub
        self._commands = commands
        self._ask = ask
        self._timeout = settings.timeout
        role = Right[settings.may.upper()]
        self._writes = ClientWrites(commands, role, WAY, None, standstill)

    def serve(self, request: MbapRequest, tool: Tool) -> Awaitable[bytes | None] | None:
        """Start a request. Return an awaitable of its reply, or None if the request gets no reply."""
        unit, is_write = self._units.get(request.unit), request.function in WRITES
        if request.unit == 0 and is_write:
            self._writes.note_refused(self._name, "all", request, "a broadcast is never passed on", tool)
        if unit is None:
            return None
        try:
            return self._written(unit, request, tool) if is_write else self._read(unit, request, tool)
        except Declined as declined:
            if is_write and declined.code != ModbusCode.ACKNOWLEDGE:
                why = f"answered with exception {declined.code:02X}H"
                self._writes.note_refused(self._name, unit.drive.name, request, why, tool)
            return _at_once(_exception(request, declined.code))

    def _written(self, unit: Unit, request: MbapRequest, tool: Tool) -> Awaitable[bytes | None]:
        answer = self._writes.begin(unit, request, tool, WAIT_SHARE * self._timeout)

        async def finish() -> bytes | None:
            frame = await answer
            return None if frame[7] & EXCEPTION and frame[8] in _UNREACHABLE else frame

        return finish()

    # ---- reading ----

    def _read(self, unit: Unit, request: MbapRequest, tool: Tool) -> Awaitable[bytes | None]:
        start, count = _asked(request)
        if unit.drive.framing is Framing.DELIXI:
            raise Declined(ModbusCode.ILLEGAL_FUNCTION)  # the drive's protocol has no Modbus functions
        if self._hub.state(unit.drive.name) == SILENT:
            # a silent drive gets no reads: polling will notice when it answers again
            raise Declined(ModbusCode.NO_RESPONSE)
        return self._passed(unit, request, start, count, tool)

    async def _passed(
        self, unit: Unit, request: MbapRequest, start: int, count: int, tool: Tool
    ) -> bytes | None:
        """Read from the drive, and return the answer to the PC tool.

        The read may have to wait, because PC tools get only a share of the line's time. If it has not started
        within WAIT_SHARE of the timeout, the answer is "busy".
        """
        is_begun = False
        until = asyncio.get_running_loop().time() + self._timeout

        async def read(seconds: float) -> list[int]:
            nonlocal is_begun
            is_begun = True
            left = max(until - asyncio.get_running_loop().time(), 0.001)
            name, function = unit.drive.name, request.function
            return await self._ask(name, function, start, count, min(seconds, left))

        asked: asyncio.Future[list[int]] | None = None
        try:
            asked = self.share.ask(tool, read)
            await asyncio.wait([asked], timeout=WAIT_SHARE * self._timeout)
            if not is_begun and not asked.done():
                return _exception(request, ModbusCode.BUSY)
            found = await asked
        except (BusError, ValueError, PassingBusy) as failure:
            return _exception(request, code_of(failure))
        finally:
            if asked is not None:
                asked.cancel()  # cancels the read only if it has not started yet
        if count:
            return request.reply(reply_data(request.function, found))
        length = bytes([len(found)]) if request.function == SERVER_ID else b""
        return request.reply(length + bytes(found))


def _exception(request: MbapRequest, code: int) -> bytes | None:
    """Return the frame of an exception reply; None if the drive cannot be reached."""
    return None if code in _UNREACHABLE else request.exception(code)


async def _at_once(frame: bytes | None) -> bytes | None:
    return frame


def _asked(request: MbapRequest) -> tuple[int, int]:
    """Return the first address and the count of a read request.

    Raises Declined for an invalid or unknown request.
    """
    function, data = request.function, request.data
    if function in (STATUS, SERVER_ID) and not data:
        return 0, 0
    if function == DEVICE_ID and len(data) == 3 and data[0] == MEI_DEVICE_ID:
        return int.from_bytes(data[1:]), 0
    addresses = read_range(request)
    return addresses.start, len(addresses)


class ToolPorts:
    """The ports through which drive vendors' PC tools reach the lines of a plant.

    A line has a pseudo-terminal, a TCP port, or both. Relative paths start from `folder`.
    """

    def __init__(
        self, plant: Plant, hub: Hub, commands: Commands, settings: ToolSettings, ask: Ask, folder: Path
    ) -> None:
        self.settings = settings
        self.lines: dict[str, ToolLine] = {}
        self.ports: dict[str, int] = {}  # TCP ports by line
        self._plant = plant
        self._folder = folder
        self._standstill = Standstill()
        self._make = partial(
            ToolLine, hub=hub, commands=commands, settings=settings, ask=ask, standstill=self._standstill
        )
        self._terminals: dict[str, Terminal] = {}
        self._listeners: dict[str, socket.socket] = {}
        self._at_terminals: list[Tool] = []
        self._tools: dict[str, list[Tool]] = {}  # PC tools that are connected over TCP, by line

    def listen(self) -> None:
        """Open all ports, or none. Raises OSError for the first port that cannot be opened."""
        try:
            for line, link in self.settings.pty.items():
                self._terminals[line] = Terminal(self._folder / link)
            for line, where in self.settings.rtu.items():
                self._listeners[line] = listen(*parse_address(where, RTU_EXAMPLE))
                self.ports[line] = self._listeners[line].getsockname()[1]
        except OSError:
            self._close_ends()
            raise

    async def run(self) -> None:
        loop = asyncio.get_running_loop()
        self.adopt(self._plant)
        self._at_terminals = [self._tool(line, terminal) for line, terminal in self._terminals.items()]
        for line in self._listeners:
            self._accept_on(line)
        while True:
            await asyncio.sleep(SWEEP_S)
            self._standstill.note()
            for tools in self._tools.values():
                self._sweep(tools, loop.time())

    def adopt(self, plant: Plant) -> None:
        """Continue with another plant. PC tools stay connected."""
        self._plant = plant
        before, self.lines = self.lines, {}
        for tools in before.values():
            tools.share.close()
        for line in plant.lines:
            if line.name in self.settings.lines:
                self.lines[line.name] = self._make(line)
                supervisor().start("tool share", self._learn_share(self.lines[line.name], line))

    async def _learn_share(self, tools: ToolLine, line: PlantLine) -> None:
        """Give the PC tools half of the line's bus time that polling leaves."""
        used = await supervisor().within("tool share", PLAN_S, partial(utilisation_of, self._plant, line))
        tools.share.share = min(MOST_SHARE, max(LEAST_SHARE, (1 - used) / 2))

    def _serve(self, line: str, request: MbapRequest, tool: Tool) -> Awaitable[bytes | None] | None:
        found = self.lines.get(line)
        return None if found is None else found.serve(request, tool)

    def _accept_on(self, line: str) -> None:
        listener = self._listeners.get(line)
        if listener is not None:
            asyncio.get_running_loop().add_reader(listener.fileno(), self._accept, line, listener)

    def _accept(self, line: str, listener: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        try:
            peer, (host, *_) = listener.accept()
        except OSError as failure:  # for example, too many files are open
            _log.warning("a tool could not connect to line %s: %s", line, failure)
            loop.remove_reader(listener.fileno())
            loop.call_later(SWEEP_S, self._accept_on, line)
            return
        tools = self._tools.setdefault(line, [])
        self._sweep(tools, loop.time())
        if not self.settings.may_connect(host):
            _log.warning("tool %s is refused: its address is not in clients", host)
        elif len(tools) >= MOST_TOOLS:
            _log.warning("tool %s is refused: %d are connected to line %s", host, MOST_TOOLS, line)
        else:
            _log.info("tool %s is connected to line %s", host, line)
            tools.append(self._tool(line, Connection(peer, host)))
            return
        peer.close()

    def _tool(self, line: str, end: End) -> Tool:
        return Tool(end, partial(self._serve, line), self.settings.timeout)

    def _sweep(self, tools: list[Tool], now: float) -> None:
        for tool in tools:
            if now - tool.last_request >= IDLE_S:
                tool.close()
        tools[:] = [tool for tool in tools if tool.is_open]

    async def close(self) -> None:
        """Close all ports and connections; writes and stops in progress continue."""
        loop = asyncio.get_running_loop()
        for listener in self._listeners.values():
            loop.remove_reader(listener.fileno())
        for tools in (self._at_terminals, *self._tools.values()):
            for tool in tools:
                tool.close()
        for line in self.lines.values():
            line.share.close()
        self._close_ends()

    def _close_ends(self) -> None:
        for terminal in self._terminals.values():
            terminal.close()
        for listener in self._listeners.values():
            listener.close()
        self._terminals, self._listeners, self.ports = {}, {}, {}


def utilisation_of(plant: Plant, line: PlantLine) -> float:
    """Return the share of the line's time that polling takes according to its plan."""
    return float(replace(plant, lines=(line,)).metadata()["planned"][line.name]["utilisation"])
