"""Decode a block's reply: all of its plain numbers at once, and the others one by one."""

from __future__ import annotations

from functools import lru_cache
from operator import add, itemgetter, mul, truediv
from struct import Struct
from typing import Any

from multidrop.core import DATA_AT, Completion, NumberFormat
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
    """Return True where every count is a value, with no more than a multiplier, an addend and a divisor."""
    coding = register.coding
    is_whole_number = coding.number_format in _CODES and coding.part is None and not ORDERS[coding.order]
    return is_whole_number and not coding.invalid_patterns and register.scaled_by is None


class BlockDecoder:
    """The places of registers in the reply of a block that begins at this address, found once."""

    def __init__(self, registers: tuple[Register[Any], ...], start: int) -> None:
        self._places = [(register, register.address - start) for register in registers]
        self._others: list[tuple[Register[Any], int]] = []
        plain: list[Register[Any]] = []
        codes, end = ">", 0
        for register, at in sorted(self._places, key=itemgetter(1)):
            number_format = register.coding.number_format
            if at < end or not _is_plain(register):
                self._others.append((register, at))
                continue
            codes += f"{2 * (at - end)}x{_CODES[number_format]}"
            end = at + WORDS[number_format]
            plain.append(register)
        self._numbers = Struct(codes)
        # side by side, and not in the registers: a thread that reads finds its caches cold
        self.plain = tuple(register.name for register in plain)
        self._multipliers, self._addends, self._divisors = (
            tuple(register.coding.factors[which] for register in plain) for which in range(3)
        )
        self._is_affine = any(self._addends) or any(factor != 1 for factor in self._multipliers)
        self._whole = [  # a float would not hold it
            (register.name, at)
            for at, register in enumerate(plain)
            if self._divisors[at] == 1 and register.coding.number_format in WHOLE
        ]
        self._named = [(register.name, register.decode) for register in plain if register.values is not None]
        self._is_scaled = not (self._is_affine or self._whole or self._named or self._others)

    def decode(self, reply: Completion) -> dict[str, Any]:
        """Return the values by the registers' names; None where the drive gave none."""
        if reply.size < self._numbers.size:
            data = reply.data
            return {register.name: register.value_in(data, at) for register, at in self._places}
        counts = self._numbers.unpack_from(reply.memory, DATA_AT)
        if self._is_scaled:
            return dict(zip(self.plain, map(truediv, counts, self._divisors), strict=True))
        if self._is_affine:
            counts = tuple(map(add, map(mul, counts, self._multipliers), self._addends))
        found: dict[str, Any] = dict(zip(self.plain, map(truediv, counts, self._divisors), strict=True))
        for name, at in self._whole:
            found[name] = counts[at]
        for name, decode in self._named:
            found[name] = decode(found[name])
        if self._others:
            data = reply.data
            for register, at in self._others:
                found[register.name] = register.value_in(data, at)
        return found


@lru_cache(maxsize=256)
def _shared(registers: tuple[Register[Any], ...], start: int) -> BlockDecoder:
    return BlockDecoder(registers, start)


def decoder_of(block: Block) -> BlockDecoder:
    """Return the block's decoder, which all drives of a kind share."""
    return _shared(block.registers, block.start)
