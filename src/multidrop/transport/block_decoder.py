"""Decode a block's reply: by the core, all at once, but for registers that need exact arithmetic."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from multidrop.core import Completion, RowLayout
from multidrop.drive.number_format import FLOATS
from multidrop.drive.register import Register, row_field
from multidrop.planning.blocks import Block

MOST_EXACT = 1 << 53  # a float holds every whole number up to it


def _is_exact(register: Register[Any]) -> bool:
    """Return True where the core, which reckons in floats, finds the same value as `Register.value_in`."""
    coding = register.coding
    if register.scaled_by is not None:
        return False
    if coding.number_format in FLOATS:
        return True
    multiplier, addend, divisor = coding.factors
    most = max(map(abs, coding.raw_span)) * abs(multiplier) + abs(addend)
    return most <= MOST_EXACT and divisor <= MOST_EXACT


class BlockDecoder:
    """The places of registers in the reply of a block that begins at this address, found once."""

    def __init__(self, registers: tuple[Register[Any], ...], start: int) -> None:
        places = [(register, register.address - start) for register in registers]
        exact = [(register, at) for register, at in places if _is_exact(register)]
        self.names = tuple(register.name for register, _ in exact)  # of what the core reads
        self.layout = RowLayout(0, [row_field(register, at, 0) for register, at in exact])
        self.count = len(exact)
        self._named = [(one.name, one.decode) for one, _ in exact if one.values is not None]
        self._others = [(register, at) for register, at in places if not _is_exact(register)]
        self.is_plain = not (self._named or self._others)

    def decode(self, reply: Completion) -> dict[str, Any]:
        """Return the values by the registers' names; None where the drive gave none."""
        found: dict[str, Any] = dict(zip(self.names, reply.values_of(self.layout), strict=True))
        for name, decode in self._named:
            if found[name] is not None:
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
