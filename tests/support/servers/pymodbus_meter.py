"""A meter by another author: pymodbus answers at ADDRESS on PORT (9600 8N1) until killed.

VALUES is a JSON file with its floats by input register address, and its serial number at holding register
FC00H. pymodbus converts both to words. Other addresses up to 17FH hold 0, as in the meter; with `refusing`
they are rejected.
Usage: pymodbus_meter.py PORT ADDRESS VALUES [refusing]
"""

import asyncio
import json
import sys
from pathlib import Path

from pymodbus import FramerType
from pymodbus.server import ModbusSerialServer
from pymodbus.simulator import DataType, SimData, SimDevice

SERIAL_NUMBER, LAST = 0xFC00, 0x17F


def floats(values: dict[int, float], *, refusing: bool) -> list[SimData]:
    found = [SimData(at, values=value, datatype=DataType.FLOAT32) for at, value in values.items()]
    held = {word for at in values for word in (at, at + 1)}
    between = [] if refusing else [at for at in range(LAST + 1) if at not in held]
    found += [SimData(at, values=0, datatype=DataType.REGISTERS) for at in between]
    return sorted(found, key=lambda block: block.address)


async def serve(port: str, address: int, path: str, *, refusing: bool) -> None:
    document = json.loads(Path(path).read_text())
    bits = [SimData(0, values=[False] * 16, datatype=DataType.BITS)]
    serial = [SimData(SERIAL_NUMBER, values=document["serial_number"], datatype=DataType.UINT32)]
    values = floats({int(at): value for at, value in document["floats"].items()}, refusing=refusing)
    device = SimDevice(id=address, simdata=(bits, bits, serial, values))
    server = ModbusSerialServer([device], framer=FramerType.RTU, port=port, baudrate=9600)
    await server.serve_forever(background=True)
    print("ready", flush=True)
    await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(serve(sys.argv[1], int(sys.argv[2]), sys.argv[3], refusing="refusing" in sys.argv[4:]))
