"""Modbus TCP server: answers the requests of clients such as SCADA systems.

Reads are answered from polled rows if possible. Writes obey the same rules as all commands, and never start
a motor.
"""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from collections.abc import Awaitable
from contextlib import suppress
from functools import partial
from typing import Any

from multidrop import Batch, BusError, Plant, Register
from multidrop.drive import Carrier
from multidrop.gateway.clock import monotonic_ns
from multidrop.gateway.commands import Commands
from multidrop.gateway.http.connections import listen
from multidrop.gateway.http.rights import Caller, Right
from multidrop.gateway.live.hub import Hub
from multidrop.gateway.modbus_server.clients import SWEEP_S, Answer, ModbusClient, ModbusPort, RoundShare
from multidrop.gateway.modbus_server.common_block import STOP
from multidrop.gateway.modbus_server.line_share import LineShare, PassingBusy
from multidrop.gateway.modbus_server.protocol import (
    WRITES,
    Declined,
    MbapRequest,
    ModbusCode,
    code_of,
    read_range,
    reply_data,
)
from multidrop.gateway.modbus_server.settings import ModbusSettings
from multidrop.gateway.modbus_server.unit_ids import MAIN, StopWrite, Unit, Units
from multidrop.gateway.modbus_server.words import Lack
from multidrop.gateway.parts import Ask, PartContext
from multidrop.supervisor import supervisor

STOP_WAIT_S = 0.4  # how long a stop's answer waits for the motor: less than the usual timeout of clients
MOST_STOPS = 8  # limit of concurrent stops of a drive; further requests are only acknowledged

Settings = ModbusSettings

_log = logging.getLogger("multidrop.gateway")


def build(settings: ModbusSettings, context: PartContext) -> ModbusServer:
    """Return the listening server. Raises OSError if a port cannot be opened."""
    server = ModbusServer(context.plant, context.hub, context.commands, settings, context.ask)
    server.listen()
    return server


class ModbusServer:
    """The Modbus TCP server of a plant: a port for each line in `ports`, one for all others.

    `ask` reads words or bits from a drive: drive, function, start, count, expiry in s. Raises ValueError with
    all mistakes if unit ids clash.
    """

    def __init__(
        self,
        plant: Plant,
        hub: Hub,
        commands: Commands,
        settings: ModbusSettings,
        ask: Ask,
    ) -> None:
        self.settings = settings
        self.answered: Counter[str] = Counter()  # requests by kind of answer
        self.ports: dict[str, int] = {}  # a line's own TCP port; MAIN: that of all other lines
        self._hub = hub
        self._commands = commands
        self._ask = ask
        self._units = Units(plant, settings)
        self._role = Right[settings.may.upper()]
        self._shares: dict[str, LineShare] = {}
        self._sockets: dict[str, Any] = {}  # listening sockets by line
        self._listening: list[ModbusPort] = []
        self._stops: dict[str, set[asyncio.Task[int]]] = {}  # stops in progress, by drive

    # ---- start and end ----

    def listen(self) -> None:
        """Open all ports, or none. Raises OSError for the first port that cannot be opened."""
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
            for port in self._listening:
                port.sweep()

    def take(self, batch: Batch) -> None:
        """Ignore the batch: the hub has the rows."""

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
        """Use another plant. Raises ValueError, and keeps the old one, if its unit ids clash."""
        self._units = Units(plant, self.settings)

    @property
    def clients(self) -> int:
        """The number of connections."""
        return sum(len(port.clients) for port in self._listening)

    # ---- requests ----

    def serve(self, port: str, request: MbapRequest, client: ModbusClient) -> Answer:
        """Return the answer to a request, or an awaitable of it; None for a broadcast, which is forbidden."""
        if request.unit == 0:
            self.answered["broadcast"] += 1
            return None
        unit = self._units.find(port, request.unit)
        if unit is None:
            return self._exception(request, ModbusCode.NO_PATH)
        answer = self._write if request.function in WRITES else self._read
        try:
            return answer(unit, request, client)
        except Declined as declined:
            return self._exception(request, declined.code)

    def _exception(self, request: MbapRequest, code: int) -> bytes:
        self.answered[f"exception {code:02X}"] += 1
        return request.exception(code)

    async def _later(self, request: MbapRequest, task: asyncio.Task[int], wait_s: float | None) -> bytes:
        """Return the answer to a command, or "acknowledge" after `wait_s`; the command continues anyway."""
        done, _ = await asyncio.wait([task], timeout=wait_s)
        code = task.result() if done else ModbusCode.ACKNOWLEDGE  # the command is still in progress
        return self._exception(request, code) if code else request.reply(request.data[:4])

    # ---- reading ----

    def _read(self, unit: Unit, request: MbapRequest, client: ModbusClient) -> bytes | Awaitable[bytes]:
        addresses = read_range(request)
        function, common = request.function, self.settings.common_addresses
        if function in (3, 4) and addresses.start < common.stop and common.start < addresses.stop:
            words = self._common(unit, addresses)
        else:
            found = unit.words.read(
                function,
                addresses,
                partial(self._hub.newest, unit.drive.name),
                monotonic_ns(),
                max(self._commands.ended_ns(unit.drive.name), self._hub.woke_ns()),
            )
            if isinstance(found, Lack):
                return self._pass(unit, request, addresses, found, client)
            words = found
        self.answered["cached"] += 1
        return request.reply(reply_data(function, words))

    def _common(self, unit: Unit, addresses: range) -> list[int]:
        common = self.settings.common_addresses
        if addresses[-1] not in common or addresses.start not in common:
            raise Declined(ModbusCode.ILLEGAL_ADDRESS)
        words = unit.common.words(self._hub, monotonic_ns())
        return words[addresses.start - common.start : addresses.stop - common.start]

    def _pass(
        self, unit: Unit, request: MbapRequest, addresses: range, lack: Lack, client: ModbusClient
    ) -> Awaitable[bytes]:
        """Pass a read on to the drive itself, if the settings allow it."""
        passing = self.settings.passing
        if passing == "off" and lack is Lack.UNPOLLED:
            raise Declined(ModbusCode.ILLEGAL_ADDRESS)
        if passing == "declared" and not unit.is_declared(request.function, addresses):
            raise Declined(ModbusCode.ILLEGAL_ADDRESS)
        if passing == "off" or self._hub.state(unit.drive.name) == "silent":
            raise Declined(ModbusCode.NO_RESPONSE)  # polling notices when the drive answers again
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
            return self._exception(request, code_of(failure))
        if len(words) != count:
            return self._exception(request, ModbusCode.NO_RESPONSE)
        self.answered["passed"] += 1
        return request.reply(reply_data(request.function, words))

    # ---- writing ----

    def _write(self, unit: Unit, request: MbapRequest, client: ModbusClient) -> Awaitable[bytes]:
        if self._role < Right.STOP:
            raise Declined(ModbusCode.ILLEGAL_FUNCTION)  # clients may only read
        carrier, address, count, data = written = WRITES[request.function](request)
        common, register = self.settings.common_addresses, unit.writable(carrier, address)
        is_one = count == (register.words if register else 1)
        if not is_one and unit.has_stop_in(written, common.start + STOP):
            with suppress(Declined):  # raised if too many stops are in progress already
                self._begin_stop(unit, client)
            raise Declined(ModbusCode.ILLEGAL_VALUE)  # other registers in the request may start a motor
        if carrier is Carrier.WORD and address in common:
            if address != common.start + STOP:
                raise Declined(ModbusCode.ILLEGAL_ADDRESS)
            if count != 1 or data == b"\0\0":
                raise Declined(ModbusCode.ILLEGAL_VALUE)
            return self._stop(unit, request, client)
        if register is None:
            raise Declined(
                ModbusCode.ILLEGAL_ADDRESS if self._role >= Right.WRITE else ModbusCode.ILLEGAL_FUNCTION
            )
        raw = register.coding.raw_in(data, 0) if is_one else None
        if raw is not None and StopWrite(register.name, raw) in unit.stops:
            return self._stop(unit, request, client)
        if self._role < Right.WRITE:
            raise Declined(ModbusCode.ILLEGAL_FUNCTION)
        if raw is None or register.commands:
            raise Declined(ModbusCode.ILLEGAL_VALUE)
        if client.is_full:
            raise Declined(ModbusCode.BUSY)
        task = supervisor().start("modbus write", self._write_one(unit, register, raw, self._caller(client)))
        return self._later(request, task, None)

    async def _write_one(self, unit: Unit, register: Register[Any], raw: float, caller: Caller) -> int:
        """Write a register; return 0 or an exception code."""
        value = raw if register.values is not None else register.decode(raw)
        result = await self._commands.write(unit.drive.name, register.name, value, caller)
        self.answered["written" if result.ok else "not written"] += 1
        return 0 if result.ok else code_of(result.error)

    def _stop(self, unit: Unit, request: MbapRequest, client: ModbusClient) -> Awaitable[bytes]:
        return self._later(request, self._begin_stop(unit, client), STOP_WAIT_S)

    def _begin_stop(self, unit: Unit, client: ModbusClient) -> asyncio.Task[int]:
        """Start a stop immediately. Raises Declined if MOST_STOPS of this drive are in progress."""
        self.answered["stop"] += 1
        name = unit.drive.name
        under_way = self._stops.setdefault(name, set())
        if len(under_way) >= MOST_STOPS:
            raise Declined(ModbusCode.ACKNOWLEDGE)
        task = supervisor().start("modbus stop", self._stop_one(unit, self._caller(client)))
        under_way.add(task)
        task.add_done_callback(under_way.discard)
        return task

    async def _stop_one(self, unit: Unit, caller: Caller) -> int:
        name = unit.drive.name
        try:
            result = (await self._commands.stop([name], caller))[name]
        except Exception:
            _log.exception("stop of %s by a modbus client", name)
            return ModbusCode.NO_RESPONSE
        if result.ok:
            return 0
        code = code_of(result.error)
        return ModbusCode.NO_RESPONSE if code == ModbusCode.DEVICE_FAILURE else code

    def _caller(self, client: ModbusClient) -> Caller:
        return Caller("anyone", "modbus", client.address, self._role)
