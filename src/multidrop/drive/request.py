"""Build requests that read and write registers, within the family's limits.

In every function `family` is a drive's class, or a drive object that may have limits of its own.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from functools import lru_cache
from typing import Any

from multidrop.core import Framing, Message
from multidrop.drive.register import Carrier, Register, Table
from multidrop.printable import is_whole

# Limit of registers in one read (application protocol V1.1b3, 6.1 to 6.4). A frame of Delixi's own protocol
# holds one.
STANDARD_LIMITS = {Carrier.BIT: 2000, Carrier.WORD: 125, Carrier.LONG: 1, Carrier.NUMBER: 1}
FUNCTIONS = {1: Carrier.BIT, 2: Carrier.BIT, 3: Carrier.WORD, 4: Carrier.WORD}  # function codes that read
# functions that read no addresses (application protocol V1.1b3, 6.7, 6.13, 6.21)
STATUS, SERVER_ID, DEVICE_ID = 0x07, 0x11, 0x2B
READS = frozenset({*FUNCTIONS, STATUS, SERVER_ID, DEVICE_ID})
MEI_DEVICE_ID = 0x0E  # first data byte of a request with function 2BH, "read device identification"
LONGEST_INTERVAL = 10.0  # s


def stated_limit(family: Any, table: Table) -> int | None:
    """Return the family's limit of registers in one read of this table; None if it states none."""
    stated = [most for other, most in family.most_registers.items() if other.read_space == table.read_space]
    return min(stated, default=None)


def read_limit(family: Any, table: Table) -> int:
    """Return the limit of registers in one read of this table: the family's limit, else the Modbus limit."""
    stated = stated_limit(family, table)
    return STANDARD_LIMITS[table.carrier] if stated is None else stated


def function_limit(family: Any, function: int) -> int:
    """Return the limit of addresses in one read with this Modbus function code.

    The longest register of the family can always be read whole.
    """
    standard = STANDARD_LIMITS[FUNCTIONS[function]]
    stated: list[int] = [most for table, most in family.most_registers.items() if table.read == function]
    if not stated:
        return standard
    held = [len(register.reach) for register in family.registers.values() if register.table.read == function]
    return min(standard, max(min(stated), *held, 1))


def stated_gaps(family: Any, table: Table) -> list[range]:
    """Return the ranges of undeclared addresses that a read may include."""
    return [gap for other, gap in family.readable_gaps.items() if other.read_space == table.read_space]


@lru_cache(maxsize=256)
def readable_addresses(family: Any, table: Table) -> frozenset[int]:
    """Return the addresses of the family's readable registers in this table."""
    return frozenset(
        address
        for register in family.registers.values()
        if register.table.read_space == table.read_space and register.readable
        for address in range(register.address, register.address + register.words)
    )


def may_be_crossed(family: Any, table: Table, addresses: Iterable[int]) -> bool:
    """Return True if one read may include all these addresses, even those that are not needed."""
    declared = family if isinstance(family, type) else type(family)
    readable, gaps = readable_addresses(declared, table), stated_gaps(family, table)
    return all(at in readable or any(at in gap for gap in gaps) for at in addresses)


# ---- requests ----

_WRITE_COILS, _WRITE_WORDS = 0x0F, 0x10  # function codes: write multiple coils, write multiple registers
_ADDRESSES = 0x10000  # number of addresses in each of the four tables (application protocol V1.1b3, 4.3)


def read_request(drive: Any, table: Table, start: int, count: int) -> Message:
    """Return the request that reads `count` addresses of a table.

    Raises ValueError if the table cannot be read.
    """
    if table.read is None:
        raise ValueError(f"a {table.name} cannot be read")
    if table.carrier in (Carrier.LONG, Carrier.NUMBER):
        return Message(drive.address, table.read, start, data=bytes(4))
    return Message(drive.address, table.read, start, count)


def write_request(drive: Any, register: Register[Any], raw: float, address: int | None = None) -> Message:
    """Return the request that writes a raw count to a register.

    If the register has a RAM address, the request uses that address. `address` replaces the drive's own
    address, as for a broadcast. Raises ValueError if the register cannot be written.
    """
    table = register.table
    if not register.writable or table.write is None:
        raise ValueError(
            f"{register.name} of {drive.name} cannot be written: it is declared as a {register.access.value}"
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


def check_no_read(drive: Any, request: Message) -> None:
    """Raise ValueError for a Modbus read: `send_raw` could return the late reply to an earlier read."""
    if drive.framing is not Framing.DELIXI and request.function in READS:
        asked = f"{request.function}, {request.start}, {request.count}"
        raise ValueError(
            f"send_raw() does not send function {request.function:02X}H, which reads: call "
            f"drive.read_raw({asked}) instead"
        )


def any_read(drive: Any, function: int, start: int, count: int) -> Message:
    """Return a request that reads with any Modbus function. The addresses need not be declared.

    The functions 01 to 04 read addresses. The functions 07, 11H and 2BH do not, so `count` must be 0.
    With 07 and 11H `start` must be 0 too. With 2BH it is the device id code times 256 plus the id of the
    first object.

    Raises TypeError unless all three are whole numbers. Raises ValueError for another function, a drive that
    does not speak Modbus, and more addresses than one request to this family may read.
    """
    for name, number in (("function", function), ("start", start), ("count", count)):
        if not is_whole(number):
            raise TypeError(f"{name} = {number!r} is not a whole number")
    if drive.framing is Framing.DELIXI:
        raise ValueError(f"{drive.name} speaks Delixi's own protocol, which has no Modbus functions")
    if function not in READS:
        raise ValueError(f"function = {function} is not a function that reads; use 1, 2, 3, 4, 7, 17 or 43")
    if not 0 <= start < _ADDRESSES:
        raise ValueError(f"start = {start} is not an address from 0 to {_ADDRESSES - 1}")
    if function not in FUNCTIONS:
        if count or (start and function != DEVICE_ID):
            raise ValueError(
                f"start = {start}, count = {count}: omit both, function {function} reads no addresses"
            )
        data = bytes([MEI_DEVICE_ID]) + start.to_bytes(2) if function == DEVICE_ID else b""
        return Message(drive.address, function, data=data)
    most = function_limit(drive, function)
    if not 1 <= count <= most:
        raise ValueError(f"count = {count} is outside 1 to {most}, the limit of one request to {drive.name}")
    if start + count > _ADDRESSES:
        raise ValueError(f"start + count = {start + count} is beyond the last address, {_ADDRESSES - 1}")
    return Message(drive.address, function, start, count)
