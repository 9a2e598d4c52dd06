"""Find each register's scale register, and check that one request can read both."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from multidrop.core import NumberFormat
from multidrop.drive.read_limits import may_be_crossed, read_limit
from multidrop.drive.register import Access, Register


def scale_errors(family: Any) -> list[str]:
    """Tie a class's registers to their scale registers; return a sentence for each that cannot be."""
    registers: Mapping[str, Register[Any]] = family.registers
    found = []
    for name, register in registers.items():
        if not register.scale_register:
            continue
        wrong = list(_wrong(register, registers))
        if not wrong:
            _tie(register, registers[register.scale_register])
            wrong = list(_apart(register, family))
        found += [f"{name}: {sentence}" for sentence in wrong]
    return found


def _wrong(register: Register[Any], registers: Mapping[str, Register[Any]]) -> Iterator[str]:
    scale = registers.get(register.scale_register)
    if scale is None:
        yield f"its scale register {register.scale_register} is not declared"
        return
    if scale.number_format is not NumberFormat.I16 or not scale.readable:
        yield f"its scale register {scale.name} is no I16 that can be read: it holds a power of ten"
    elif scale.part or scale.offset or scale.step != 1 or scale.scale_register or scale.values:
        yield f"its scale register {scale.name} is no plain count: it holds a power of ten"
    if scale.table.read_space != register.table.read_space:
        yield f"its scale register {scale.name} is in another table: one request reads both"
    if register.access is not Access.READING:
        yield "a register with a scale register is never written: the device may change the scale meanwhile"
    if register.values is not None or register.offset:
        yield "a register with a scale register has neither names nor an offset"
    if register.scaled_by not in (None, scale):
        yield f"its scale register {scale.name} was declared anew: declare this one anew as well"


def _tie(register: Register[Any], scale: Register[Any]) -> None:
    object.__setattr__(register, "scaled_by", scale)
    vars(register).pop("reach", None)


def _apart(register: Register[Any], family: Any) -> Iterator[str]:
    limit = read_limit(family, register.table)
    if len(register.reach) > limit:
        shown = f"{len(register.reach)} registers with its scale register {register.scale_register}"
        yield f"one request reads at most {limit} registers, and these are {shown}"
        return
    scale = register.scaled_by
    own = {*range(register.address, register.address + register.words), scale and scale.address}
    between = [address for address in register.reach if address not in own]
    unknown = [address for address in between if not may_be_crossed(family, register.table, [address])]
    if unknown:
        yield (
            f"address {unknown[0]:04X}H between it and its scale register {register.scale_register} is not "
            "declared: declare it, or the gap in readable_gaps"
        )
