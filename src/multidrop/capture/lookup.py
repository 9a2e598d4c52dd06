"""Look up the registers of a request: the plant's by name where they are known, else raw ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from multidrop.core import Framing, Message, NumberFormat
from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.drive.table import Carrier
from multidrop.plant.model import Plant, PlantLine

_TABLES = {
    0x01: "coil",
    0x02: "discrete_input",
    0x03: "holding_register",
    0x04: "input_register",
    0x05: "coil",
    0x06: "holding_register",
    0x08: "loopback",
    0x0F: "coil",
    0x10: "holding_register",
}
_BITS = (0x01, 0x02, 0x05, 0x0F)
_MOST = {NumberFormat.BIT: 2000, NumberFormat.U16: 125}  # in a reply, whatever the request asks for
_WRITES = {0x05: (0x05,), 0x06: (0x06,), 0x0F: (0x05, 0x0F), 0x10: (0x06, 0x10)}  # by function
_DELIXI_WRITES = {0x02: (0x02,), 0x04: (0x04,), 0x05: (0x05, 0x06), 0x06: (0x05, 0x06)}


@dataclass(frozen=True)
class RegisterPlace:
    """A register, None for an unknown one, and its offset in an exchange's data, in words or bits."""

    name: str
    at: int
    number_format: NumberFormat
    register: Register[Any] | None = None


@dataclass(frozen=True)
class RequestTarget:
    """The drive that a request is for, and the registers that it reads or writes."""

    drive: str
    is_write: bool
    places: tuple[RegisterPlace, ...]


def line_of(plant: Plant | None, name: str) -> PlantLine | None:
    """Return the plant's line with this name; its only line matches any name."""
    lines = plant.lines if plant else ()
    named = [line for line in lines if line.name == name]
    return named[0] if named else lines[0] if len(lines) == 1 else None


class RegisterLookup:
    """The registers of one line's drives."""

    def __init__(self, line: PlantLine | None) -> None:
        drives = [polled.drive for polled in line.drives] if line else []
        self._drives = {(drive.address, drive.framing): drive for drive in drives}

    def find(self, framing: Framing, request: Message) -> RequestTarget:
        drive = self._drives.get((request.address, framing))
        name = drive.name if drive else f"address {request.address}"
        writes = _DELIXI_WRITES if framing is Framing.DELIXI else _WRITES
        is_write = request.function in writes
        functions = writes.get(request.function, (request.function,))
        known = _known(drive, request, functions, is_write) if drive else ()
        return RequestTarget(name, is_write, known or _raw(framing, request))


def _known(
    drive: Drive, request: Message, functions: tuple[int, ...], is_write: bool
) -> tuple[RegisterPlace, ...]:
    found = [
        RegisterPlace(register.name, at, register.number_format, register)
        for register in drive.registers.values()
        if (register.table.write if is_write else register.table.read) in functions
        and (is_write or register.readable)
        and (at := _offset(register, request)) is not None
    ]
    return tuple(sorted(found, key=lambda place: place.at))


def _offset(register: Register[Any], request: Message) -> int | None:
    """Return the register's offset in the data; None unless the request covers all that its value needs."""
    if register.table.carrier is Carrier.NUMBER:
        return 0
    end, reach = request.start + max(request.count, 1), register.reach
    for start in (reach.start, register.ram_address):
        if start is not None and request.start <= start and start + len(reach) <= end:
            return start - request.start + register.address - reach.start
    return None


def _raw(framing: Framing, request: Message) -> tuple[RegisterPlace, ...]:
    if framing is Framing.DELIXI:
        return (RegisterPlace(f"k{request.function}_{request.start:04X}", 0, NumberFormat.U32),)
    table = _TABLES[request.function]
    number_format = NumberFormat.BIT if request.function in _BITS else NumberFormat.U16
    count = min(max(request.count, 1), _MOST[number_format])
    return tuple(RegisterPlace(f"{table}_{request.start + at}", at, number_format) for at in range(count))
