"""Modbus TCP: frames, request data and exception codes.

Sources: MODBUS Messaging on TCP/IP Implementation Guide V1.0b, section 3.1.3 (frames); MODBUS Application
Protocol Specification V1.1b3, sections 6 (requests) and 7 (exception codes).
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from enum import IntEnum
from functools import partial
from typing import NamedTuple

from multidrop import (
    BadReply,
    CancelledByStop,
    DriveException,
    Expired,
    LineError,
    NoReply,
    NotMaster,
    NotVerified,
    Unconfirmed,
    Unsupported,
    WriteForbidden,
)
from multidrop.control import NotAttached
from multidrop.drive import Carrier
from multidrop.gateway.commands import BUSY, STOOD_STILL
from multidrop.gateway.http.rights import NOT_ALLOWED, NOT_LISTED

MOST_DATA = 253  # limit, in bytes, of a function code with its data (application protocol V1.1b3, 4.1)
_HEADER = struct.Struct(">HHHB")
_FUNCTION = _HEADER.size  # offset of the function code in a frame


class InvalidHeader(ValueError):
    """Received bytes that are not a valid header of Modbus TCP."""


class MbapRequest(NamedTuple):
    """One request of a client."""

    transaction: int
    unit: int
    function: int
    data: bytes  # the bytes after the function code

    @property
    def text(self) -> str:
        """Unit id, function code and data as hexadecimal digits."""
        return bytes([self.unit, self.function, *self.data]).hex(" ").upper()

    def reply(self, data: bytes) -> bytes:
        return _HEADER.pack(self.transaction, 0, 2 + len(data), self.unit) + bytes([self.function]) + data

    def exception(self, code: int) -> bytes:
        return _HEADER.pack(self.transaction, 0, 3, self.unit) + bytes([self.function | 0x80, code])


def take_frame(buffer: bytearray) -> bytes | None:
    """Remove the first frame from the buffer and return it; None if the frame is incomplete.

    Raises InvalidHeader for an invalid header, after which the start of the next frame is unknown.
    """
    if len(buffer) >= 4 and buffer[2:4] != b"\0\0":
        raise InvalidHeader(f"protocol id {int.from_bytes(buffer[2:4]):04X}H, but in Modbus TCP it is 0")
    if len(buffer) < 6:
        return None
    length = int.from_bytes(buffer[4:6])
    if not 2 <= length <= 1 + MOST_DATA:
        raise InvalidHeader(f"the length field is {length}; it must be 2 to {1 + MOST_DATA}")
    if len(buffer) < 6 + length:
        return None
    frame = bytes(buffer[: 6 + length])
    del buffer[: 6 + length]
    return frame


def function_of(frame: bytes) -> int:
    return frame[_FUNCTION]


def request_of(frame: bytes) -> MbapRequest:
    transaction, _, _, unit = _HEADER.unpack_from(frame)
    return MbapRequest(transaction, unit, frame[_FUNCTION], frame[_FUNCTION + 1 :])


def take_request(buffer: bytearray) -> MbapRequest | None:
    """Remove the first request from the buffer and return it; None if it is incomplete.

    Raises InvalidHeader for an invalid header.
    """
    frame = take_frame(buffer)
    return None if frame is None else request_of(frame)


class ModbusCode(IntEnum):
    """Exception codes of a reply (application protocol V1.1b3, section 7)."""

    ILLEGAL_FUNCTION = 0x01
    ILLEGAL_ADDRESS = 0x02
    ILLEGAL_VALUE = 0x03
    DEVICE_FAILURE = 0x04
    ACKNOWLEDGE = 0x05
    BUSY = 0x06
    NO_PATH = 0x0A
    NO_RESPONSE = 0x0B


class PassingBusy(Exception):
    """A request was dropped: the queue was full, or the line was not free in time."""


class Declined(Exception):
    """Raised for a request that is answered with this exception code."""

    def __init__(self, code: int) -> None:
        super().__init__(f"exception {code:02X}H")
        self.code = code


# Exception codes by type of the error. The first type that matches decides.
_CODES: tuple[tuple[type[BaseException], ModbusCode], ...] = (
    (PassingBusy, ModbusCode.BUSY),
    (Expired, ModbusCode.BUSY),
    (CancelledByStop, ModbusCode.BUSY),
    (LineError, ModbusCode.NO_PATH),
    (NotMaster, ModbusCode.NO_PATH),
    (NotAttached, ModbusCode.NO_PATH),
    (NoReply, ModbusCode.NO_RESPONSE),
    (BadReply, ModbusCode.NO_RESPONSE),
    (Unconfirmed, ModbusCode.NO_RESPONSE),
    (Unsupported, ModbusCode.ILLEGAL_FUNCTION),
    (NotVerified, ModbusCode.DEVICE_FAILURE),
    (ValueError, ModbusCode.ILLEGAL_VALUE),
)
# Exception codes of a WriteForbidden, by its rule.
_RULES: Mapping[str, ModbusCode] = {
    NOT_ALLOWED: ModbusCode.ILLEGAL_FUNCTION,
    NOT_LISTED: ModbusCode.ILLEGAL_ADDRESS,
    BUSY: ModbusCode.BUSY,
    STOOD_STILL: ModbusCode.BUSY,
}


def code_of(error: BaseException | None) -> int:
    """Return the exception code that reports an error. An exception reply of a drive keeps its code."""
    if isinstance(error, DriveException):
        return error.code if 1 <= error.code <= 0x7F else ModbusCode.DEVICE_FAILURE
    if isinstance(error, WriteForbidden) and (code := _RULES.get(error.rule)):
        return code
    if isinstance(error, WriteForbidden) and error.is_budget:
        return ModbusCode.BUSY
    return next((code for kind, code in _CODES if isinstance(error, kind)), ModbusCode.DEVICE_FAILURE)


# limits of the bits or words in one request, by function (application protocol, 6.1 to 6.4)
MOST_READ = {1: 2000, 2: 2000, 3: 125, 4: 125}
# limits of the bits or words in one request, by function (application protocol, 6.11 and 6.12)
MOST_WRITTEN = {0x0F: 1968, 0x10: 123}
ADDRESSES = 0x10000


class WriteRequest(NamedTuple):
    """The words or bits that a request writes."""

    carrier: Carrier
    address: int
    size: int  # number of words or bits
    data: bytes


def read_range(request: MbapRequest) -> range:
    """Return the addresses that a request reads. Raises Declined for an invalid request."""
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
    """Return the data of a reply: words, or bits packed into bytes with the first bit lowest."""
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
    """Return the words or bits that a request of function 15 or 16 writes."""
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
