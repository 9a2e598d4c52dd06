"""PDU: the data of requests and replies, checked against the application protocol V1.1b3, section 6."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

from multidrop.drive import Carrier
from multidrop.gateway.modbus_server.codes import Declined, ModbusCode
from multidrop.gateway.modbus_server.mbap import MbapRequest

MOST_READ = {1: 2000, 2: 2000, 3: 125, 4: 125}  # in one request: 6.1 to 6.4
MOST_WRITTEN = {0x0F: 1968, 0x10: 123}  # the same: 6.11 and 6.12
ADDRESSES = 0x10000


class WriteRequest(NamedTuple):
    """The words or bits that a request writes."""

    carrier: Carrier
    address: int
    size: int  # words or bits
    data: bytes


def read_range(request: MbapRequest) -> range:
    """Return the addresses that a request reads; raises Declined for what cannot be read."""
    if request.function not in MOST_READ:
        raise Declined(ModbusCode.ILLEGAL_FUNCTION)
    if len(request.data) != 4:
        raise Declined(ModbusCode.ILLEGAL_VALUE)
    start, count = struct.unpack(">HH", request.data)
    if not 1 <= count <= MOST_READ[request.function]:
        raise Declined(ModbusCode.ILLEGAL_VALUE)
    if start + count > ADDRESSES:
        raise Declined(ModbusCode.ILLEGAL_ADDRESS)
    return range(start, start + count)


def reply_data(function: int, words: list[int]) -> bytes:
    """Return a reply's data: words, or bits of which the first is the least significant of the first byte."""
    if function in (3, 4):
        return struct.pack(f">B{len(words)}H", 2 * len(words), *words)
    size = (len(words) + 7) // 8
    bits = sum(1 << at for at, bit in enumerate(words) if bit)
    return bytes([size]) + bits.to_bytes(size, "little")


def _one_coil(request: MbapRequest) -> WriteRequest:
    if len(request.data) != 4 or request.data[2:] not in (b"\xff\0", b"\0\0"):
        raise Declined(ModbusCode.ILLEGAL_VALUE)
    return WriteRequest(Carrier.BIT, int.from_bytes(request.data[:2]), 1, bytes([request.data[2] & 1]))


def _one_word(request: MbapRequest) -> WriteRequest:
    if len(request.data) != 4:
        raise Declined(ModbusCode.ILLEGAL_VALUE)
    return WriteRequest(Carrier.WORD, int.from_bytes(request.data[:2]), 1, request.data[2:])


def _several(carrier: Carrier, request: MbapRequest) -> WriteRequest:
    """Return the words or bits that functions 15 and 16 write."""
    if len(request.data) < 5:
        raise Declined(ModbusCode.ILLEGAL_VALUE)
    address, count, size = struct.unpack_from(">HHB", request.data)
    needed = (count + 7) // 8 if carrier is Carrier.BIT else 2 * count
    data = request.data[5:]
    if not 1 <= count <= MOST_WRITTEN[request.function] or not size == needed == len(data):
        raise Declined(ModbusCode.ILLEGAL_VALUE)
    if address + count > ADDRESSES:
        raise Declined(ModbusCode.ILLEGAL_ADDRESS)
    return WriteRequest(carrier, address, count, data)


WRITES: Mapping[int, Callable[[MbapRequest], WriteRequest]] = {
    0x05: _one_coil,
    0x06: _one_word,
    0x0F: partial(_several, Carrier.BIT),
    0x10: partial(_several, Carrier.WORD),
}
