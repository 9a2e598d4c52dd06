"""A server by another author: pymodbus answers at ADDRESS until killed, on PORT (9600 8N1) or by Modbus TCP.

Holding register n and input register n start as 1000 + n, coil n as n % 2. It prints "ready", and for Modbus
TCP its port, a free one.
Usage: pymodbus_server.py ADDRESS tcp | pymodbus_server.py ADDRESS rtu|ascii PORT
"""

import asyncio
import sys

from pymodbus import FramerType
from pymodbus.exceptions import NoSuchIdException
from pymodbus.server import ModbusSerialServer, ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice


async def silent(*_: object) -> None:
    """Make pymodbus ignore requests to other addresses."""
    raise NoSuchIdException("not here")


async def serve(address: int, framing: str, *port: str) -> None:
    bits = [SimData(0, values=[bool(n % 2) for n in range(64)], datatype=DataType.BITS)]
    words = [SimData(0, values=[1000 + n for n in range(256)], datatype=DataType.REGISTERS)]
    device = SimDevice(id=address, simdata=(bits, bits, words, words))
    other = SimDevice(id=0, simdata=(bits, bits, words, words), action=silent)
    if framing == "tcp":
        tcp = ModbusTcpServer([device, other], address=("127.0.0.1", 0), ignore_missing_devices=True)
        await tcp.serve_forever(background=True)
        assert tcp.transport
        print("ready", tcp.transport.sockets[0].getsockname()[1], flush=True)
    else:
        server = ModbusSerialServer(
            [device, other],
            framer=FramerType(framing),
            port=port[0],
            baudrate=9600,
            ignore_missing_devices=True,
        )
        await server.serve_forever(background=True)
        print("ready", flush=True)
    await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(serve(int(sys.argv[1]), *sys.argv[2:]))
