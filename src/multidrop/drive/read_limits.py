"""Limits of one read: how many registers, across which addresses, and which of them only together.

A `family` is the class, or a drive of it, which may have limits of its own.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import lru_cache
from math import isfinite
from typing import Any

from multidrop.drive.register import Register
from multidrop.drive.table import Carrier, Table

# The application protocol V1.1b3, 6.1 to 6.4; Delixi's own frames have room for one.
STANDARD_LIMITS = {Carrier.BIT: 2000, Carrier.WORD: 125, Carrier.LONG: 1, Carrier.NUMBER: 1}
FUNCTIONS = {1: Carrier.BIT, 2: Carrier.BIT, 3: Carrier.WORD, 4: Carrier.WORD}  # those that read, by code
LONGEST_INTERVAL = 10.0  # s


def stated_limit(family: Any, table: Table) -> int | None:
    """Return how many registers one read may take, as stated for this table; None where nothing is."""
    stated = [most for other, most in family.most_registers.items() if other.read_space == table.read_space]
    return min(stated, default=None)


def read_limit(family: Any, table: Table) -> int:
    """Return how many registers one read may take: as stated, else as many as the standard allows."""
    stated = stated_limit(family, table)
    return STANDARD_LIMITS[table.carrier] if stated is None else stated


def function_limit(family: Any, function: int) -> int:
    """Return how many addresses one read by this function may take, whatever lies there.

    That is the least limit that the family states for it, but enough for its longest register.
    """
    standard = STANDARD_LIMITS[FUNCTIONS[function]]
    stated: list[int] = [most for table, most in family.most_registers.items() if table.read == function]
    if not stated:
        return standard
    held = [len(register.reach) for register in family.registers.values() if register.table.read == function]
    return min(standard, max(min(stated), *held, 1))


def stated_gaps(family: Any, table: Table) -> list[range]:
    """Return the addresses without registers that may be read across."""
    return [gap for other, gap in family.readable_gaps.items() if other.read_space == table.read_space]


def read_span(family: Any, register: Register[Any]) -> range:
    """Return the addresses that a request for this register reads."""
    return register.reach


@lru_cache(maxsize=256)
def readable_addresses(family: Any, table: Table) -> frozenset[int]:
    """Return the addresses at which the family declares something to read."""
    return frozenset(
        address
        for register in family.registers.values()
        if register.table.read_space == table.read_space and register.readable
        for address in range(register.address, register.address + register.words)
    )


def may_be_crossed(family: Any, table: Table, addresses: Iterable[int]) -> bool:
    """Return True where all of these may be read."""
    declared = family if isinstance(family, type) else type(family)
    readable, gaps = readable_addresses(declared, table), stated_gaps(family, table)
    return all(at in readable or any(at in gap for gap in gaps) for at in addresses)


# ---- what is wrong with the declarations ----


def limit_errors(family: Any) -> Iterator[str]:
    """Yield a sentence for each error in a class's limits of reading."""
    interval = family.least_interval
    if not _is_number(interval) or not 0 <= interval <= LONGEST_INTERVAL:
        yield f"least_interval = {interval!r} is no time from 0 to {LONGEST_INTERVAL:g} s"
    for table, most in family.most_registers.items():
        standard = STANDARD_LIMITS[table.carrier]
        if isinstance(most, bool) or not isinstance(most, int) or not 1 <= most <= standard:
            yield f"most_registers[{table.name}] = {most!r} is no number from 1 to {standard}"
            return
    groups = family.read_together
    if not isinstance(groups, (tuple, list)) or not all(isinstance(group, (tuple, list)) for group in groups):
        yield f'read_together = {groups!r} is no tuple of groups, such as (("energy_high", "energy_low"),)'
        return
    seen: set[str] = set()
    for group in groups:
        yield from _group_errors(family, group, seen)
        seen.update(name for name in group if isinstance(name, str))


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and isfinite(value)


def _group_errors(family: Any, group: Iterable[Any], seen: set[str]) -> Iterator[str]:
    shown = f"read_together: {', '.join(map(str, group))}"
    known = [family.registers.get(name) for name in group if isinstance(name, str)]
    registers = [register for register in known if register is not None and register.readable]
    if not registers or len(registers) < len(list(group)):
        yield f"{shown}: each must be the name of a register that can be read"
        return
    if again := seen & set(group):
        yield f"{shown}: {', '.join(sorted(again))} is in another group too; make one of both"
    table = registers[0].table
    if any(register.table.read_space != table.read_space for register in registers):
        yield f"{shown}: one request reads one table, and these are in several"
        return
    spans = [read_span(family, register) for register in registers]
    start, stop = min(span.start for span in spans), max(span.stop for span in spans)
    longest, limit = max(map(len, spans)), read_limit(family, table)
    if stop - start > max(limit, longest):
        yield f"{shown}: they take {stop - start} addresses, and one request reads {limit} at most"
    elif not may_be_crossed(family, table, range(start, stop)):
        yield (
            f"{shown}: between them are addresses that are not declared; "
            f"one request may read across them only where readable_gaps says so"
        )
