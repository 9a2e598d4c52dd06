"""Pass arbitrary bytes to the Modbus TCP server: each request gets one answer of the right shape."""

from __future__ import annotations

import asyncio
import struct
import sys
from functools import cache
from inspect import isawaitable
from pathlib import Path
from typing import Any

sys.path.extend(map(str, (Path(__file__).parents[1] / "support").iterdir()))

from controlled_loop import ControlledLoop
from modbus_gateway import FakeCommands, FakeHub, FakeLine, plant_of

from multidrop.families import ErmanERG220, InvtCHE
from multidrop.gateway.modbus_server.protocol import InvalidHeader, MbapRequest, take_request
from multidrop.gateway.modbus_server.server import ModbusServer
from multidrop.gateway.modbus_server.settings import ModbusSettings

MOST = 260  # bytes; limit of a frame's length
UNITS = {1: InvtCHE(1, name="mill"), 2: ErmanERG220(2, name="well")}
REFUSED = 0x80


class FakeClient:
    """The attributes of a client that the server uses."""

    is_full = False
    address = "127.0.0.1"


@cache
def loop() -> ControlledLoop:
    return ControlledLoop()


def read_requests(path: Path) -> None:
    """Parse and answer the requests in a file, whose first byte is the size of the pieces to pass on."""
    data = path.read_bytes()
    size, stream = (data[:1] or b"\1")[0] % 64 + 1, data[1:]
    found = list(taken(stream, size))
    assert found == plain(stream)
    loop().run_until_complete(answered(found))


def taken(stream: bytes, size: int) -> list[MbapRequest]:
    """Return the requests that the server finds in pieces of `size` bytes, until invalid bytes."""
    buffer, found = bytearray(), []
    for at in range(0, len(stream), size):
        buffer += stream[at : at + size]
        try:
            while request := take_request(buffer):
                found.append(request)
        except InvalidHeader:
            break
    return found


def plain(stream: bytes) -> list[MbapRequest]:
    """Return the requests in a stream, up to the first invalid bytes, by an independent parser."""
    found = []
    while len(stream) >= 8:
        transaction, protocol, length, unit, function = struct.unpack(">HHHBB", stream[:8])
        if protocol or not 2 <= length <= MOST - 6 or len(stream) < 6 + length:
            break
        found.append(MbapRequest(transaction, unit, function, stream[8 : 6 + length]))
        stream = stream[6 + length :]
    return found


@cache
def served() -> tuple[ModbusServer, FakeCommands]:
    """Return a server and its fake commands. Only every second register of its drives has a value."""
    hub, commands, line = FakeHub(), FakeCommands(), FakeLine()
    plant = plant_of(*(("hall", drive) for drive in UNITS.values()))
    hub.values = {
        (drive.name, register.name): 1.0
        for drive in UNITS.values()
        for register in list(drive.registers.values())[::2]
    }
    settings = ModbusSettings(may="write")
    return ModbusServer(plant, hub, commands, settings, line.ask), commands


async def answered(requests: list[MbapRequest]) -> None:
    """Let a server answer the requests, and check the answers and the resulting commands."""
    server, commands = served()
    commands.written.clear()
    commands.stopped.clear()
    client: Any = FakeClient()
    for request in requests[:20]:
        answer = server.serve("", request, client)
        if isawaitable(answer):
            answer = await answer
        if answer is None:
            assert request.unit == 0
        else:
            check(request, answer)
    for drive, name, _, _ in commands.written:
        register = next(one for one in UNITS.values() if one.name == drive).register(name)
        assert register.writable
        assert not register.commands
    for drives, _ in commands.stopped:
        assert drives in (["mill"], ["well"])
    await asyncio.sleep(1)


def check(request: MbapRequest, answer: bytes) -> None:
    """Check the answer's header against its request, and the answer's length against its header."""
    transaction, protocol, length, unit, function = struct.unpack(">HHHBB", answer[:8])
    assert (transaction, protocol, unit) == (request.transaction, 0, request.unit)
    assert len(answer) == 6 + length <= MOST
    if function & REFUSED and function == request.function | REFUSED and length == 3:
        assert answer[8] in (1, 2, 3, 4, 5, 6, 10, 11)
        return
    assert function == request.function
    assert unit in UNITS
    count = int.from_bytes(request.data[2:4])
    if function in (1, 2):
        assert answer[8] == len(answer) - 9 == (count + 7) // 8
    elif function in (3, 4):
        assert answer[8] == len(answer) - 9 == 2 * count
    else:
        assert function in (5, 6, 15, 16)
        assert answer[8:] == request.data[:4]
