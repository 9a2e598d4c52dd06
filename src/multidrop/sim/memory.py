"""A drive's memory: the cells of its tables, as the drive's class declares them.

A cell is reached by function code and address; tables that several codes reach (03, 06 and 10) are one
space. It holds a bit, a word, or Delixi's four bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from typing import Any

from multidrop.core import Framing, NumberFormat, raw_value
from multidrop.drive.family import Drive
from multidrop.drive.number_format import nearest_or_infinite
from multidrop.drive.register import Access, Carrier, Register, Table

_ALSO_WRITES = {0x05: 0x0F, 0x06: 0x10}  # the same cells, several at once
_DELIXI_ALSO_WRITES = {0x05: 0x06, 0x06: 0x05}  # not stored, stored
_DELIXI_STORES = 0x06
_LOW_WORD_FIRST = (NumberFormat.U32_SWAPPED, NumberFormat.I32_SWAPPED, NumberFormat.F32_SWAPPED)
_MASKS = {Carrier.BIT: 0x1, Carrier.WORD: 0xFFFF, Carrier.NUMBER: 0xFFFF, Carrier.LONG: 0xFFFF_FFFF}
_BYTES = {Carrier.BIT: 1, Carrier.WORD: 2, Carrier.NUMBER: 4, Carrier.LONG: 4}


@dataclass(eq=False)
class MemoryCell:
    """One address of one table, and its register; None: a reserved address."""

    table: Table
    address: int
    register: Register[Any] | None = None
    raw: int = 0

    @property
    def name(self) -> str:
        return self.register.name if self.register else f"{self.table.name} {self.address:04X}H"


class Memory:
    """The cells of one drive, found by function code and address."""

    def __init__(self, drive: type[Drive], framing: Framing) -> None:
        self._framing = framing
        self._also = _DELIXI_ALSO_WRITES if framing is Framing.DELIXI else _ALSO_WRITES
        self._cells: dict[tuple[object, int], MemoryCell] = {}  # tables that are read alike share them
        self._read: dict[tuple[int, int], MemoryCell | None] = {}  # None: unreadable, also in a gap
        self._gaps = [(table.read, table, addresses) for table, addresses in drive.readable_gaps.items()]
        self._written: dict[tuple[int, int], MemoryCell] = {}
        self.aliases: set[tuple[int, int]] = set()  # where a write does not reach the EEPROM
        for register in drive.registers.values():
            self._declare(register)

    def _cell(self, table: Table, address: int) -> MemoryCell:
        return self._cells.setdefault((_space(table), address), MemoryCell(table, address))

    def _declare(self, register: Register[Any]) -> None:
        table = register.table
        for at in range(register.words):
            cell = self._cell(table, register.address + at)
            if cell.register is None or register.access is not Access.READING:  # a writable one has a span
                cell.register = register
            if table.read is not None and register.access is Access.COMMAND:
                self._read.setdefault((table.read, cell.address), None)  # unless a reading is there too
            elif table.read is not None:
                self._read[table.read, cell.address] = cell
            if register.access is Access.READING:
                continue
            self.make_writable(table, [cell.address])
            if register.ram_address is not None:
                for code in self._codes(table):
                    self._written[code, register.ram_address + at] = cell
                    self.aliases.add((code, register.ram_address + at))
        if register.default is not None:
            self.set(register, register.default)

    def make_readable(self, table: Table, addresses: Iterable[int]) -> None:
        for address in addresses:
            self._read[table.read or 0, address] = self._cell(table, address)

    def make_writable(self, table: Table, addresses: Iterable[int]) -> None:
        for address in addresses:
            for code in self._codes(table):
                self._written[code, address] = self._cell(table, address)
                if self._framing is Framing.DELIXI and code != _DELIXI_STORES:
                    self.aliases.add((code, address))

    def _codes(self, table: Table) -> set[int]:
        return set() if table.write is None else {table.write, self._also.get(table.write, table.write)}

    def readable(self, function: int, address: int) -> MemoryCell | None:
        key = function, address
        if key not in self._read:
            tables = (table for code, table, gap in self._gaps if code == function and address in gap)
            table = next(tables, None)
            if table is None:
                return None
            self._read[key] = self._cell(table, address)
        return self._read[key]

    def writable(self, function: int, address: int) -> MemoryCell | None:
        """Return the cell that a write there changes, with any function that the drive takes."""
        return self._written.get((function, address))

    def get(self, register: Register[Any]) -> Any:
        """Return the register's value in its own unit."""
        data = b"".join(pack(register.table, cell.raw) for cell in self.of(register))
        return register.decode(raw_value(data, 0, register.number_format))

    def set(self, register: Register[Any], value: float) -> None:
        """Hold this value, rounded to the register's step; bits that do not fit are lost."""
        if register.is_float:
            held = nearest_or_infinite(value / register.scale)
            raw = int.from_bytes(struct.pack(">f", held))
        elif register.values is not None:
            raw = int(value)
        else:
            numerator, denominator = _scale(register)
            raw = round(value * denominator / numerator)
        self.set_raw(register, raw)

    def set_raw(self, register: Register[Any], raw: int) -> None:
        cells = self.of(register)
        for cell in cells if register.number_format in _LOW_WORD_FIRST else reversed(cells):
            cell.raw = raw & _MASKS[register.table.carrier]
            raw >>= 16

    def of(self, register: Register[Any]) -> list[MemoryCell]:
        """Return the register's cells, in the order of their addresses."""
        space = _space(register.table)
        return [self._cells[space, register.address + at] for at in range(register.words)]


@cache
def _space(table: Table) -> object:
    return table if table.read is None else table.read_space


@cache  # needed at every request
def _scale(register: Register[Any]) -> tuple[int, int]:
    return register.scale.as_integer_ratio()


def pack(table: Table, raw: int) -> bytes:
    """Return the bytes of a raw count in a reply."""
    return raw.to_bytes(_BYTES[table.carrier])


def decode(register: Register[Any], raw: int) -> Any:
    """Return the value of a raw count that one cell holds."""
    return register.decode(raw_value(pack(register.table, raw), 0, register.number_format))
