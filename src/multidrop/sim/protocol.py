"""Carry out the function codes of a protocol on a simulated drive.

The protocols are Modbus (application protocol V1.1b3) and Delixi's own (the third part of Delixi's document
"RS-485 communication protocol").
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

from multidrop.core import Framing, Message

if TYPE_CHECKING:
    from multidrop.sim.drive import SimulatedDrive

COIL_ON, COIL_OFF = b"\xff\x00", b"\x00\x00"

# Delixi's function codes K.
COMMAND, STATE, SETPOINT, SET, STORE, QUERY = 0x02, 0x03, 0x04, 0x05, 0x06, 0x07
NO_DATA = bytes(4)  # unused D3..D0


class Reason(Enum):
    """A reason to refuse a request. Each family has an exception code for the reason, or does not reply."""

    FUNCTION = "no such function"
    READ_ADDRESS = "nothing to be read there"
    WRITE_ADDRESS = "nothing to be written there"
    COUNT = "too many or none at all"
    VALUE = "outside its span"
    LOCKED = "not while the motor runs"
    CANNOT = "not in this state"
    BUSY = "storing"
    DAMAGED = "wrong checksum"


class Refusal(Exception):
    """Raised when the drive refuses a request, with the reason."""

    def __init__(self, reason: Reason) -> None:
        super().__init__(reason.value)
        self.reason = reason


@dataclass(frozen=True)
class DriveProtocol:
    """A protocol's functions and usual exception codes. If a reason has no code, the drive does not reply."""

    answers: Mapping[int, Callable[[SimulatedDrive, Message], Message]]
    codes: Mapping[Reason, int]
    octets: int  # bytes of a request for one register, without checksum
    no_data: bytes = b""  # data of an exception reply


def _with_data(request: Message, data: bytes) -> Message:
    return Message(request.address, request.function, request.start, request.count, data)


def _read_words(sim: SimulatedDrive, request: Message) -> Message:
    raws = sim.read(request.function, request.start, request.count)
    return _with_data(request, b"".join(raw.to_bytes(2) for raw in raws))


def _read_bits(sim: SimulatedDrive, request: Message) -> Message:
    raws = sim.read(request.function, request.start, request.count)
    bits = sum(raw << at for at, raw in enumerate(raws))
    return _with_data(request, bits.to_bytes((request.count + 7) // 8, "little"))


def _write_one(sim: SimulatedDrive, request: Message) -> Message:
    sim.write(request.function, request.start, [int.from_bytes(request.data)])
    return request


def _write_coil(sim: SimulatedDrive, request: Message) -> Message:
    if request.data not in (COIL_ON, COIL_OFF):
        raise Refusal(Reason.VALUE)
    sim.write(request.function, request.start, [int(request.data == COIL_ON)])
    return request


def _write_words(sim: SimulatedDrive, request: Message) -> Message:
    raws = [int.from_bytes(request.data[at : at + 2]) for at in range(0, len(request.data), 2)]
    return _write_several(sim, request, raws)


def _write_coils(sim: SimulatedDrive, request: Message) -> Message:
    bits = int.from_bytes(request.data, "little")
    return _write_several(sim, request, [bits >> at & 1 for at in range(request.count)])


def _write_several(sim: SimulatedDrive, request: Message, raws: list[int]) -> Message:
    # writes have the same length limit as reads
    sim.check_count({0x0F: 0x01, 0x10: 0x03}[request.function], request.count)
    sim.write(request.function, request.start, raws)
    return Message(request.address, request.function, request.start, request.count)


def _return_query_data(sim: SimulatedDrive, request: Message) -> Message:
    if request.start != 0:  # only subfunction 0 is simulated
        raise Refusal(Reason.FUNCTION)
    return request


def _command(sim: SimulatedDrive, request: Message) -> Message:
    sim.write(COMMAND, 0, [request.start])
    return request


def _state(sim: SimulatedDrive, request: Message) -> Message:
    (raw,) = sim.read(STATE, 0, 1)
    return Message(request.address, STATE, start=raw, data=NO_DATA)


def _query(sim: SimulatedDrive, request: Message) -> Message:
    (raw,) = sim.read(QUERY, request.start, 1)
    return Message(request.address, QUERY, request.start, data=raw.to_bytes(4))


MODBUS = DriveProtocol(
    {
        0x01: _read_bits,
        0x02: _read_bits,
        0x03: _read_words,
        0x04: _read_words,
        0x05: _write_coil,
        0x06: _write_one,
        0x08: _return_query_data,
        0x0F: _write_coils,
        0x10: _write_words,
    },
    {
        Reason.FUNCTION: 1,
        Reason.READ_ADDRESS: 2,
        Reason.WRITE_ADDRESS: 2,
        Reason.COUNT: 3,
        Reason.VALUE: 3,
        Reason.LOCKED: 4,
        Reason.CANNOT: 4,
        Reason.BUSY: 6,
    },
    octets=6,
)
DELIXI = DriveProtocol(
    {
        COMMAND: _command,
        STATE: _state,
        SETPOINT: _write_one,
        SET: _write_one,
        STORE: _write_one,
        QUERY: _query,
    },
    {
        Reason.FUNCTION: 0xF0,
        Reason.CANNOT: 0xF0,
        Reason.READ_ADDRESS: 0xFC,
        Reason.WRITE_ADDRESS: 0xFC,
        Reason.VALUE: 0xFD,
        Reason.LOCKED: 0xFE,
        Reason.DAMAGED: 0xFF,
    },
    octets=8,
    no_data=NO_DATA,
)
PROTOCOLS = {Framing.RTU: MODBUS, Framing.ASCII: MODBUS, Framing.TCP: MODBUS, Framing.DELIXI: DELIXI}
