"""Find each register's scale register, and check that one request can read both."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import Any

from multidrop.core import NumberFormat
from multidrop.drive.register import Access, Register, Table

MOST_WORDS = 125  # of one request


def scale_errors(
    registers: Mapping[str, Register[Any]],
    most: Mapping[Table, int],
    gaps: Mapping[Table, Collection[int]],
) -> list[str]:
    """Tie registers to their scale registers; return a sentence for each that cannot be.

    `most` are the registers of a table that one request may read, `gaps` the reserved addresses that it may
    read across.
    """
    found = []
    for name, register in registers.items():
        if not register.scale_register:
            continue
        wrong = list(_wrong(register, registers))
        if not wrong:
            _tie(register, registers[register.scale_register])
            wrong = list(_apart(register, registers, most, gaps))
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
    if scale.table.space != register.table.space:
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


def _apart(
    register: Register[Any],
    registers: Mapping[str, Register[Any]],
    most: Mapping[Table, int],
    gaps: Mapping[Table, Collection[int]],
) -> Iterator[str]:
    limit = most.get(register.table, MOST_WORDS)
    if len(register.reach) > limit:
        shown = f"{len(register.reach)} registers with its scale register {register.scale_register}"
        yield f"one request reads at most {limit} registers, and these are {shown}"
        return
    known = set(gaps.get(register.table, ()))
    for other in registers.values():
        if other.table.space == register.table.space and other.readable:
            known.update(range(other.address, other.address + other.words))
    unknown = [address for address in register.reach if address not in known]
    if unknown:
        yield (
            f"address {unknown[0]:04X}H between it and its scale register {register.scale_register} is not "
            "declared: declare it, or the gap in readable_gaps"
        )
