"""A server by another author: pymodbus answers at ADDRESS on PORT (9600 8N1) until killed.

Holding register n and input register n start as 1000 + n, coil n as n % 2.
Usage: pymodbus_server.py PORT ADDRESS rtu|ascii
"""

import asyncio
import sys

from pymodbus import FramerType
from pymodbus.exceptions import NoSuchIdException
from pymodbus.server import ModbusSerialServer
from pymodbus.simulator import DataType, SimData, SimDevice


async def silent(*_: object) -> None:
    """Make pymodbus ignore requests to other addresses."""
    raise NoSuchIdException("not here")


async def serve(port: str, address: int, framing: str) -> None:
    bits = [SimData(0, values=[bool(n % 2) for n in range(64)], datatype=DataType.BITS)]
    words = [SimData(0, values=[1000 + n for n in range(256)], datatype=DataType.REGISTERS)]
    device = SimDevice(id=address, simdata=(bits, bits, words, words))
    other = SimDevice(id=0, simdata=(bits, bits, words, words), action=silent)
    server = ModbusSerialServer(
        [device, other], framer=FramerType(framing), port=port, baudrate=9600, ignore_missing_devices=True
    )
    await server.serve_forever(background=True)
    print("ready", flush=True)
    await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(serve(sys.argv[1], int(sys.argv[2]), sys.argv[3]))
