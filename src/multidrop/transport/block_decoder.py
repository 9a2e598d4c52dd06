"""Decode a block's reply: all of its plain numbers at once, and the others one by one."""

from __future__ import annotations

from operator import itemgetter
from struct import Struct
from typing import Any

from multidrop.core import NumberFormat
from multidrop.drive.number_format import ORDERS, WHOLE, WORDS
from multidrop.drive.register import Register
from multidrop.planning.blocks import Block

_CODES = {
    NumberFormat.U16: "H",
    NumberFormat.I16: "h",
    NumberFormat.U32: "I",
    NumberFormat.I32: "i",
    NumberFormat.U64: "Q",
    NumberFormat.I64: "q",
}


def _is_plain(register: Register[Any]) -> bool:
    """Return True where any count of whole words is a value: count times multiplier, plus addend, divided."""
    coding = register.coding
    is_whole_number = coding.number_format in _CODES and coding.part is None and not ORDERS[coding.order]
    return is_whole_number and not coding.invalid_patterns and register.scaled_by is None


class BlockDecoder:
    """The places of a block's registers in its reply, found once."""

    def __init__(self, block: Block) -> None:
        self._places = [(register, block.offset(register)) for register in block.registers]
        self._plain: list[tuple[Register[Any], int, int, int, bool]] = []
        self._others: list[tuple[Register[Any], int]] = []
        codes, end = ">", 0
        for register, at in sorted(self._places, key=itemgetter(1)):
            number_format = register.coding.number_format
            if at < end or not _is_plain(register):
                self._others.append((register, at))
                continue
            codes += f"{2 * (at - end)}x{_CODES[number_format]}"
            end = at + WORDS[number_format]
            factors = register.coding.factors
            is_whole = factors[2] == 1 and number_format in WHOLE  # a float would not hold it
            self._plain.append((register, *factors, is_whole))
        self._numbers = Struct(codes)

    def decode(self, data: bytes) -> dict[str, Any]:
        """Return the values by the registers' names; None where the drive gave none."""
        is_whole_reply = len(data) >= self._numbers.size
        slowly = self._others if is_whole_reply else self._places
        found = {register.name: register.value_in(data, at) for register, at in slowly}
        if not is_whole_reply:
            return found
        counts = self._numbers.unpack_from(data)
        for count, (register, multiplier, addend, divisor, is_whole) in zip(counts, self._plain, strict=True):
            scaled = count * multiplier + addend
            number = scaled if is_whole else scaled / divisor + 0.0  # never -0.0
            found[register.name] = number if register.values is None else register.decode(number)
        return found
