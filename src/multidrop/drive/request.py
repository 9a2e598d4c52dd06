"""Build the requests that read and write registers."""

from __future__ import annotations

import struct
from typing import Any

from multidrop.core import Framing, Message
from multidrop.drive.family import Drive
from multidrop.drive.read_limits import FUNCTIONS, function_limit
from multidrop.drive.register import Register
from multidrop.drive.table import Carrier, Table

_WRITE_COILS, _WRITE_WORDS = 0x0F, 0x10  # several at once
_ADDRESSES = 0x10000  # of each of a drive's four tables (application protocol V1.1b3, 4.3)


def read_request(drive: Drive, table: Table, start: int, count: int) -> Message:
    """Return the request that reads `count` addresses of a table; ValueError where none can."""
    if table.read is None:
        raise ValueError(f"a {table.name} cannot be read")
    if table.carrier in (Carrier.LONG, Carrier.NUMBER):
        return Message(drive.address, table.read, start, data=bytes(4))
    return Message(drive.address, table.read, start, count)


def write_request(drive: Drive, register: Register[Any], raw: float, address: int | None = None) -> Message:
    """Return the request that writes a raw count to a register, or to its RAM alias where it has one.

    `address` takes the place of the drive's own, for a broadcast. Raises ValueError where the register
    cannot be written.
    """
    table = register.table
    if not register.writable or table.write is None:
        raise ValueError(
            f"{register.name} of {drive.name} cannot be written: it is a {register.access.value}"
        )
    to = drive.address if address is None else address
    at = register.address if register.ram_address is None else register.ram_address
    if table.carrier is Carrier.NUMBER:
        return Message(to, table.write, start=int(raw), data=bytes(4))
    if table.carrier is Carrier.LONG:
        return Message(to, table.write, at, data=struct.pack(">I", int(raw)))
    if table.carrier is Carrier.BIT:
        if table.write == _WRITE_COILS:
            return Message(to, table.write, at, count=1, data=bytes([int(raw)]))
        return Message(to, table.write, at, data=b"\xff\x00" if raw else b"\x00\x00")
    words = register.coding.pack(raw)
    if register.words == 1:
        return Message(to, table.write, at, count=1 if table.write == _WRITE_WORDS else 0, data=words)
    return Message(to, _WRITE_WORDS, at, count=register.words, data=words)


def check_no_read(drive: Drive, request: Message) -> None:
    """Raise ValueError for a read of Modbus.

    One that waits as long as a write may return the late reply to another read.
    """
    if drive.framing is not Framing.DELIXI and request.function in FUNCTIONS:
        asked = f"{request.function}, {request.start}, {request.count}"
        raise ValueError(
            f"function {request.function:02X}H is a read, which bus.raw does not send: call "
            f"bus.ask(drive, {asked}), which returns no late reply to another request"
        )


def any_read(drive: Drive, function: int, start: int, count: int) -> Message:
    """Return the request that reads addresses by one of Modbus' functions 01 to 04, declared or not.

    Raises TypeError for what is no whole number, and ValueError for another function, a drive that speaks no
    Modbus, and a span that no request, or no request to this family, can read.
    """
    for name, number in (("function", function), ("start", start), ("count", count)):
        if isinstance(number, bool) or not isinstance(number, int):
            raise TypeError(f"{name} = {number!r} is no whole number")
    if drive.framing is Framing.DELIXI:
        raise ValueError(f"{drive.name} speaks Delixi's own protocol, which has none of Modbus' functions")
    if function not in FUNCTIONS:
        raise ValueError(f"function = {function} is none of those that read: 1, 2, 3 and 4")
    if not 0 <= start < _ADDRESSES:
        raise ValueError(f"start = {start} is no address from 0 to {_ADDRESSES - 1}")
    most = function_limit(drive, function)
    if not 1 <= count <= most:
        raise ValueError(f"count = {count} is not from 1 to {most}, which {drive.name} reads in one request")
    if start + count > _ADDRESSES:
        raise ValueError(f"start + count = {start + count}: the last address is {_ADDRESSES - 1}")
    return Message(drive.address, function, start, count)
