"""Tables: a drive's address spaces, and the function codes that read and write them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Kept(Enum):
    """Memory in which a drive keeps what is written; EEPROM bears a limited number of writes."""

    RAM = "RAM"
    EEPROM = "EEPROM"
    UNKNOWN = "not stated"

    __hash__ = object.__hash__  # each member is one object: ten times as fast as by name, which Enum takes


class Carrier(Enum):
    """Field of a frame that carries a table's values."""

    BIT = "bit"
    WORD = "word"
    LONG = "four bytes"  # Delixi's D3..D0
    NUMBER = "parameter number"  # Delixi's P1P0

    __hash__ = object.__hash__  # as above


@dataclass(frozen=True)
class Table:
    """One of a drive's address spaces, and the function codes that read and write it."""

    name: str
    read: int | None
    write: int | None
    carrier: Carrier = Carrier.WORD
    kept: Kept = Kept.UNKNOWN  # where the function code alone decides it

    @property
    def read_space(self) -> tuple[Carrier, int | None]:
        """Key of the tables that are read alike: their registers may share a request."""
        return self.carrier, self.read


HOLDING = Table("holding register", 0x03, 0x06)
HOLDING_MULTIPLE = Table("holding register", 0x03, 0x10)  # also one register is written by 10H
INPUT = Table("input register", 0x04, None)
COIL = Table("coil", 0x01, 0x05, Carrier.BIT)
DISCRETE = Table("discrete input", 0x02, None, Carrier.BIT)
