"""A simulated drive's memory: the cells of its tables, as the drive's class declares them.

A cell is found by function code and address. Function codes that access the same table (03, 06 and 10) share
one address space. A cell holds a bit, a 16-bit word, or Delixi's four bytes.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from multidrop.core import Framing
from multidrop.drive.family import Drive
from multidrop.drive.number_format import arranged, bits_of
from multidrop.drive.register import Access, Carrier, Register, Table
from multidrop.drive.text import Text

# function codes that write several cells, by the code that writes one cell
_ALSO_WRITES = {0x05: 0x0F, 0x06: 0x10}
# the function codes 05 (RAM) and 06 (EEPROM) write the same parameters
_DELIXI_ALSO_WRITES = {0x05: 0x06, 0x06: 0x05}
_DELIXI_STORES = 0x06
_MASKS = {Carrier.BIT: 0x1, Carrier.WORD: 0xFFFF, Carrier.NUMBER: 0xFFFF, Carrier.LONG: 0xFFFF_FFFF}
_BYTES = {Carrier.BIT: 1, Carrier.WORD: 2, Carrier.NUMBER: 4, Carrier.LONG: 4}


@dataclass(eq=False)
class MemoryCell:
    """The bit or word at one address of one table. `register` is None for a reserved address."""

    table: Table
    address: int
    register: Register[Any] | None = None
    raw: int = 0

    @property
    def name(self) -> str:
        return self.register.name if self.register else f"{self.table.name} {self.address:04X}H"


class Memory:
    """The cells of one drive, which are found by function code and address."""

    def __init__(self, drive: type[Drive], framing: Framing) -> None:
        self._framing = framing
        self._also = _DELIXI_ALSO_WRITES if framing is Framing.DELIXI else _ALSO_WRITES
        # by read function and address, because tables with the same read function share their cells
        self._cells: dict[tuple[object, int], MemoryCell] = {}
        # cells by function and address; None: a read that includes this address is refused
        self._read: dict[tuple[int, int], MemoryCell | None] = {}
        self._gaps = [(table.read, table, addresses) for table, addresses in drive.readable_gaps.items()]
        self._written: dict[tuple[int, int], MemoryCell] = {}
        # function and address of writes that go to RAM, although the register is kept in EEPROM
        self.aliases: set[tuple[int, int]] = set()
        for register in drive.registers.values():
            self.declare(register)
        for text in drive.texts.values():
            self.make_readable(text.table, self._addresses(text))

    def _cell(self, table: Table, address: int) -> MemoryCell:
        place = _space(table), address
        cell = self._cells.get(place)
        if cell is None:
            cell = self._cells[place] = MemoryCell(table, address)
        return cell

    def declare(self, register: Register[Any]) -> None:
        """Add the words or bits of the register, with its factory value."""
        table = register.table
        for at in range(register.words):
            cell = self._cell(table, register.address + at)
            if _is_better(register, cell.register):
                cell.register = register
            if table.read is not None and register.access is Access.COMMAND:
                # a read of this address is refused, unless another register makes it readable
                self._read.setdefault((table.read, cell.address), None)
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
        """Return the cell that this function code writes at this address; None if there is none."""
        return self._written.get((function, address))

    def get(self, register: Register[Any]) -> Any:
        """Return the register's value in its unit; None if its raw count means "no value"."""
        reach = register.reach
        cells = [self._cell(register.table, address) for address in reach]
        data = b"".join(pack(register.table, cell.raw) for cell in cells)
        return register.value_in(data, register.address - reach.start)

    def set(self, register: Register[Any], value: float | None) -> None:
        """Store this value, rounded to the register's step; bits that do not fit are dropped.

        None stores the count that means "no value". Raises ValueError if the register has no such count.
        """
        coding = register.coding
        if value is None:
            self._put(register, *_no_value(register))
        elif register.values is not None:
            self.set_raw(register, _placed(register, int(value)))
        elif register.is_float:
            offset = float(coding.offset)
            self.set_raw(register, bits_of((value - offset) / coding.step, register.number_format))
        else:
            multiplier, addend, divisor = coding.factors
            power = self._power(register)
            multiplier, divisor = multiplier * 10 ** max(power, 0), divisor * 10 ** max(-power, 0)
            count = value * divisor - addend
            exact = Fraction(count, multiplier) if isinstance(count, int) else count / multiplier
            self.set_raw(register, _placed(register, round(exact)))

    def _power(self, register: Register[Any]) -> int:
        return 0 if register.scaled_by is None else int(self.get(register.scaled_by) or 0)

    def set_raw(self, register: Register[Any], raw: int) -> None:
        """Store this raw count. If the register uses only some bits of its word, the other bits are kept."""
        self._put(register, raw, register.coding.mask)

    def _put(self, register: Register[Any], raw: int, mask: int) -> None:
        cells = self.of(register)
        size = _BYTES[register.table.carrier]
        order = "AB" if register.table.carrier is Carrier.BIT else register.coding.order
        before = arranged(b"".join(pack(cell.table, cell.raw) for cell in cells), order)
        bits = (int.from_bytes(before) & ~mask) | (raw & mask)
        data = arranged(bits.to_bytes(len(before)), order)
        for at, cell in enumerate(cells):
            cell.raw = int.from_bytes(data[size * at : size * (at + 1)]) & _MASKS[register.table.carrier]

    def get_text(self, text: Text) -> str:
        """Return the characters in the registers of a text parameter, up to the first NUL."""
        cells = (self._cell(text.table, address) for address in self._addresses(text))
        return text.decode(b"".join(pack(cell.table, cell.raw) for cell in cells))

    def set_text(self, text: Text, value: str) -> None:
        """Store `value` in the registers of a text parameter. Raises ValueError if it does not fit."""
        data = text.encode(value)
        for at, address in enumerate(self._addresses(text)):
            self._cell(text.table, address).raw = int.from_bytes(data[2 * at : 2 * at + 2])

    @staticmethod
    def _addresses(text: Text) -> range:
        return range(text.address, text.address + text.length)

    def of(self, register: Register[Any]) -> list[MemoryCell]:
        """Return the register's cells in the order of their addresses."""
        return [self._cell(register.table, register.address + at) for at in range(register.words)]


def _space(table: Table) -> object:
    return table if table.read is None else table.read_space


def _is_better(register: Register[Any], known: Register[Any] | None) -> bool:
    """Return True if `register` should replace `known`, a register at the same address.

    A writable register takes precedence, then a register that uses all bits of its words.
    """
    if known is None or register.access is not Access.READING:
        return True
    return known.part is not None and register.part is None


def _placed(register: Register[Any], raw: int) -> int:
    """Return the bits of a raw count, shifted to the register's place in its word."""
    if register.part is None:
        return bits_of(raw, register.number_format)
    return raw << register.part[0] & register.coding.mask


def _no_value(register: Register[Any]) -> tuple[int, int]:
    """Return the bits that mean "no value" for this register, and their mask.

    Raises ValueError if there are none.
    """
    for mask, pattern in register.coding.invalid_patterns:
        return pattern, mask
    if register.is_float:
        return bits_of(math.nan, register.number_format), register.coding.mask
    raise ValueError(f"register {register.name} has no raw value that means 'no value'")


def pack(table: Table, raw: int) -> bytes:
    """Return the bytes that a reply has for a raw count."""
    return raw.to_bytes(_BYTES[table.carrier])


def decode(register: Register[Any], raw: int) -> Any:
    """Return the value of a one-word register whose raw number is `raw`; None for "no value"."""
    return register.value_in(pack(register.table, raw), 0)
