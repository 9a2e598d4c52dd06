"""ParameterSpace: a family's rule that computes a parameter's address from its code, such as P05.31.

A drive class has the rule as `parameter_space`. The rule is enough to save and restore parameters as raw
counts, even if they are not declared as registers. A declared register adds name, unit, limits and factory
value.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from fnmatch import fnmatchcase
from functools import lru_cache
from typing import Any

from multidrop.drive.register import HOLDING, Access, Kept, Register, Table
from multidrop.errors import Unsupported

READING = "this library only reads it; set it on the panel"
LINE_PARAMETER = "it changes the drive's end of the line"
PASSWORD = "it is a password"


@dataclass(frozen=True)
class ParameterGroup:
    """Parameters with consecutive addresses. Each code is `prefix` and an index of at least `digits` digits.

    With `as_hex`, the index's decimal digits are sent as hex digits: F170 is at `start` + 0170H.
    """

    prefix: str
    start: int
    indices: range
    digits: int = 2
    as_hex: bool = False

    def codes(self) -> Mapping[str, int]:
        """Return the address of each parameter, by its code."""
        base = 16 if self.as_hex else 10
        return {
            f"{self.prefix}{index:0{self.digits}d}": self.start + int(str(index), base)
            for index in self.indices
        }


@dataclass(frozen=True)
class ParameterSpace:
    """The parameters of a family. A code in these fields may be a pattern, such as "P05.*"."""

    groups: tuple[ParameterGroup, ...] = ()  # the rule that computes an address from a code
    # without `groups`: a regular expression that finds a parameter's code in the `place` of its register,
    # which is the section of the manual
    named: str = ""
    table: Table = HOLDING
    monitors: tuple[str, ...] = ()  # codes that the drive itself changes; neither saved nor compared
    # codes of the drive's address, baud rate, format and protocol, in the order in which they are written
    line: tuple[str, ...] = ()
    passwords: tuple[str, ...] = ()
    never: Mapping[str, str] = field(default_factory=dict)  # reason for each code that is never written
    firmware: str = ""  # name of the register with the firmware version

    def codes(self, registers: Mapping[str, Register[Any]]) -> dict[str, tuple[int, Table]]:
        """Return the address and table of each parameter, by code; `registers` are those of the family."""
        found = {code: (at, self.table) for group in self.groups for code, at in group.codes().items()}
        if self.named:
            for register in registers.values():
                match = re.search(self.named, register.place)
                if match and register.access is Access.SETTING:
                    found[match[1]] = register.address, register.table
        return {code: place for code, place in found.items() if not self.is_monitor(code)}

    def is_monitor(self, code: str) -> bool:
        """Return True if the drive itself changes this parameter's value."""
        return _matches(code, self.monitors)

    def reason(self, code: str) -> str:
        """Return why the parameter with this code is never written; "" if it may be written."""
        if _matches(code, self.line):
            return LINE_PARAMETER
        if _matches(code, self.passwords):
            return PASSWORD
        return next((why for pattern, why in self.never.items() if fnmatchcase(code, pattern)), "")


def _matches(code: str, patterns: tuple[str, ...]) -> bool:
    return any(fnmatchcase(code, pattern) for pattern in patterns)


@dataclass(frozen=True, eq=False)
class Parameter(Register[Any]):
    """A parameter of a drive, as a register.

    The family declares the register, or its address is computed from the parameter's code. A parameter is
    always written to permanent memory, even if the register also has a RAM address.
    """

    code: str = ""
    family: Any = None
    is_declared: bool = False
    is_line: bool = False  # True for the drive's address, baud rate, format or protocol

    def changed(self, **facts: Any) -> Parameter:
        """Return a copy of the parameter in which these attributes have other values."""
        own = {one.name: getattr(self, one.name) for one in fields(self) if one.init}
        copy = Parameter(**own | facts)
        copy.__set_name__(self.family, self.name)
        return copy

    def text(self, raw: int) -> str:
        """Return a raw count as text: a value with its unit, or the count if nothing is declared."""
        if not self.is_declared:
            return str(raw)
        return self.format(self.decode(raw)) if self.step is not None else f"{raw} raw"

    @property
    def default_raw(self) -> int | None:
        """The factory value as a raw count; None if the manual does not state it."""
        return None if self.default is None else int(self.coding.count_of(self.default))


def parameters_of(family: Any) -> Mapping[str, Parameter]:
    """Return a family's parameters by code, in the manual's order; `family` is the class of a drive.

    Raises Unsupported if the family has no rule for the addresses of its parameters.
    """
    return _parameters_of(family)


@lru_cache(maxsize=64)
def _parameters_of(family: Any) -> Mapping[str, Parameter]:
    space: ParameterSpace | None = family.parameter_space
    if space is None:
        raise Unsupported(
            f"the addresses of parameters are not known for {family.model or family.__name__}: "
            "read and write its declared registers instead"
        )
    declared = {
        (register.table.read_space, register.address): register
        for register in family.registers.values()
        if register.words == 1 and register.part is None
    }
    found: dict[str, Parameter] = {}
    for code, (address, table) in space.codes(family.registers).items():
        register = declared.get((table.read_space, address))
        if register is None:
            made = Parameter(address, Access.SETTING, table=table, kept=Kept.EEPROM, code=code, family=family)
            name = code
        else:
            facts = {one.name: getattr(register, one.name) for one in fields(register) if one.init}
            if register.access is not Access.SETTING:
                facts |= {"access": Access.SETTING, "never": READING}
            if register.ram_address is not None:
                facts |= {"ram_address": None, "kept": Kept.EEPROM}
            made = Parameter(**facts, code=code, family=family, is_declared=True)
            name = register.name
        is_line = _matches(code, space.line)
        made = made.changed(never=space.reason(code) or made.never, is_line=is_line)
        made.__set_name__(family, name)
        found[code] = made
    return found
