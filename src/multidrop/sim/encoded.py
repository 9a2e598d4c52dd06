"""EncodedDrive: a drive whose values name their source, so that a misattributed one is found."""

from __future__ import annotations

import math
from typing import Any

from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.drive.table import Carrier, Table
from multidrop.sim.drive import SimulatedDrive
from multidrop.sim.memory import MemoryCell


def encoded(address: int, table: Table, register_address: int) -> int:
    """Return the count of an EncodedDrive: it names drive, table and register (a coil: its lowest bit)."""
    return (address * 257 + register_address * 31 + (table.read or table.write or 0)) & 0x7FFF


def proof(drive: Drive, register: Register[Any]) -> float:
    """Return the register's value on an EncodedDrive, as a row has it; NaN: a count that means no value."""
    if register in drive.known_counts():
        return register.coding.value_of(_known(drive, register))
    size = 2 if register.table.carrier is Carrier.WORD else 4
    data = b"".join(encoded(drive.address, register.table, at).to_bytes(size) for at in register.reach)
    number = register.number_in(data, register.address - register.reach.start)
    return math.nan if number is None else number


def _known(drive: Drive, register: Register[Any]) -> int:
    """Return a raw count within the range that the family's document states."""
    least, most = drive.known_counts()[register]
    raw = encoded(drive.address, register.table, register.address)
    return least + raw % (most - least + 1)


class EncodedDrive(SimulatedDrive):
    """A drive whose every count names drive, table and register: see `encoded`.

    Writes are confirmed and forgotten.
    """

    def refresh(self, cell: MemoryCell) -> None:
        if cell.register and cell.register in self.drive.known_counts():
            cell.raw = _known(self.drive, cell.register)
            return
        bits = 1 if cell.table.carrier is Carrier.BIT else 0x7FFF
        cell.raw = encoded(self.drive.address, cell.table, cell.address) & bits

    def accept(self, cell: MemoryCell, raw: int) -> int:
        return cell.raw
