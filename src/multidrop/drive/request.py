"""Build the requests that read and write registers."""

from __future__ import annotations

import struct
from typing import Any

from multidrop.core import Message
from multidrop.drive.family import Drive
from multidrop.drive.register import Carrier, Register, Table

_WRITE_COILS, _WRITE_WORDS = 0x0F, 0x10  # several at once


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
