"""A server by another author: pymodbus answers at ADDRESS over Modbus TCP until killed.

Registers and coils are those of pymodbus_server.py. It prints its port, a free one, as "ready PORT".
Usage: modbus_tcp_server.py ADDRESS
"""

import asyncio
import sys

from pymodbus.exceptions import NoSuchIdException
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice


async def silent(*_: object) -> None:
    """Make pymodbus ignore requests to other units."""
    raise NoSuchIdException("not here")


async def serve(address: int) -> None:
    bits = [SimData(0, values=[bool(n % 2) for n in range(64)], datatype=DataType.BITS)]
    words = [SimData(0, values=[1000 + n for n in range(256)], datatype=DataType.REGISTERS)]
    device = SimDevice(id=address, simdata=(bits, bits, words, words))
    other = SimDevice(id=0, simdata=(bits, bits, words, words), action=silent)
    server = ModbusTcpServer([device, other], address=("127.0.0.1", 0), ignore_missing_devices=True)
    await server.serve_forever(background=True)
    assert server.transport
    print("ready", server.transport.sockets[0].getsockname()[1], flush=True)
    await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(serve(int(sys.argv[1])))
