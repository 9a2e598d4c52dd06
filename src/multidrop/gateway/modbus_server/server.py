"""Modbus TCP server: answers clients such as SCADA systems, with polled values if possible."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable
from functools import partial
from typing import Any

from multidrop import BusError, Plant
from multidrop.gateway.commands import Commands
from multidrop.gateway.http.connections import listen
from multidrop.gateway.http.rights import Right
from multidrop.gateway.live.hub import SILENT, Hub
from multidrop.gateway.modbus_server.address_map import AddressRow, address_map
from multidrop.gateway.modbus_server.clients import SWEEP_S, Answer, ModbusClient, ModbusPort, RoundShare
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
from multidrop.gateway.modbus_server.settings import MAIN, ModbusSettings, Unit, Units
from multidrop.gateway.modbus_server.words import Unavailable
from multidrop.gateway.parts import Ask, PartContext


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

    # ---- requests ----

    def serve(self, port: str, request: MbapRequest, client: ModbusClient) -> Answer:
        """Return the answer to a request, or an awaitable that returns the answer.

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
            name, since_ns = unit.drive.name, self._commands.ended_ns(unit.drive.name)
            found = unit.words.read(function, addresses, lambda one: self._hub.fresh(name, one, since_ns))
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
                words = block.words(self._hub)
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
