"""A server by another author: pymodbus answers at ADDRESS until killed, on PORT (9600 8N1) or by Modbus TCP.

Holding register n and input register n start as 1000 + n, coil n as n % 2. It prints "ready", and for Modbus
TCP its port, a free one. A meter has the contents of VALUES: a JSON file with its floats by input register
address, and its serial number at holding register FC00H, which pymodbus converts to words. Other addresses up
to 17FH hold 0; with `refusing` they are rejected.
Usage: pymodbus_server.py ADDRESS {tcp | rtu PORT | ascii PORT | meter PORT VALUES [refusing]}
"""

import asyncio
import json
import sys
from pathlib import Path

from pymodbus import FramerType, ModbusDeviceIdentification
from pymodbus.exceptions import NoSuchIdException
from pymodbus.server import ModbusSerialServer, ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

IDENTITY = ModbusDeviceIdentification(info={0: "pymodbus", 1: "server", 2: "3"})
SERIAL_NUMBER, LAST = 0xFC00, 0x17F


async def silent(*_: object) -> None:
    """Make pymodbus ignore requests to other addresses."""
    raise NoSuchIdException("not here")


async def serve(address: int, framing: str, *port: str) -> None:
    bits = [SimData(0, values=[bool(n % 2) for n in range(64)], datatype=DataType.BITS)]
    words = [SimData(0, values=[1000 + n for n in range(256)], datatype=DataType.REGISTERS)]
    device = SimDevice(id=address, simdata=(bits, bits, words, words))
    other = SimDevice(id=0, simdata=(bits, bits, words, words), action=silent)
    if framing == "tcp":
        tcp = ModbusTcpServer(
            [device, other], address=("127.0.0.1", 0), identity=IDENTITY, ignore_missing_devices=True
        )
        await tcp.serve_forever(background=True)
        assert tcp.transport
        print("ready", tcp.transport.sockets[0].getsockname()[1], flush=True)
    else:
        server = ModbusSerialServer(
            [device, other],
            framer=FramerType(framing),
            port=port[0],
            baudrate=9600,
            identity=IDENTITY,
            ignore_missing_devices=True,
        )
        await server.serve_forever(background=True)
        print("ready", flush=True)
    await asyncio.Event().wait()


def floats(values: dict[int, float], *, refusing: bool) -> list[SimData]:
    found = [SimData(at, values=value, datatype=DataType.FLOAT32) for at, value in values.items()]
    held = {word for at in values for word in (at, at + 1)}
    between = [] if refusing else [at for at in range(LAST + 1) if at not in held]
    found += [SimData(at, values=0, datatype=DataType.REGISTERS) for at in between]
    return sorted(found, key=lambda block: block.address)


async def serve_meter(address: int, port: str, path: str, *options: str) -> None:
    document = json.loads(Path(path).read_text())
    bits = [SimData(0, values=[False] * 16, datatype=DataType.BITS)]
    serial = [SimData(SERIAL_NUMBER, values=document["serial_number"], datatype=DataType.UINT32)]
    values = {int(at): value for at, value in document["floats"].items()}
    device = SimDevice(
        id=address, simdata=(bits, bits, serial, floats(values, refusing="refusing" in options))
    )
    server = ModbusSerialServer([device], framer=FramerType.RTU, port=port, baudrate=9600)
    await server.serve_forever(background=True)
    print("ready", flush=True)
    await asyncio.Event().wait()


if __name__ == "__main__":
    address, kind, *words = sys.argv[1:]
    asyncio.run(serve_meter(int(address), *words) if kind == "meter" else serve(int(address), kind, *words))
