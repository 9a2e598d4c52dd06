"""Declare registers: a `reading` can be read, a `setting` read and written, a `command` only written."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum, IntFlag
from typing import Any, Protocol, TypedDict, TypeVar, Unpack, cast, overload

from multidrop.core import NumberFormat
from multidrop.drive.register import Access, Register
from multidrop.drive.table import Kept, Table

E = TypeVar("E", bound=IntEnum | IntFlag)


class Details(TypedDict, total=False):
    """Facts of a declaration besides address and unit; each may be left out."""

    step: float | None  #: value of one raw count; None where the document does not state it
    offset: float  #: value of the raw count 0: value = raw * step + offset
    #: Raw counts that mean "no value". One outside the format's span names the bits: 0x8000 of an I16.
    invalid: float | tuple[float, ...]
    #: Lowest and highest bit of a reading that is only a part of the number in its words. `invalid` counts
    #: that do not fit into the part are compared with the whole number.
    part: tuple[int, int]
    order: str  #: bytes as they come on the wire, A the most significant: ABCD, CDAB, BADC, DCBA; AB, BA
    scale_register: str  #: reading whose signed count is this one's power of ten; one request reads both
    span: tuple[float, float]  #: smallest and largest value that may be written
    at_least: str  #: register or option whose present value is the least that may be written
    at_most: str  #: register or option whose present value is the most
    number_format: NumberFormat  #: width, sign and kind of the number in the frame
    table: Table  #: address space and function codes
    kept: Kept  #: RAM or EEPROM; that of the table where the table has one
    ram_address: int  #: address at which the same quantity is written without wearing the EEPROM
    default: float  #: value from the factory
    while_running: bool  #: may be changed while the motor turns; None where not stated
    broadcast: tuple[int, ...]  #: raw counts that are documented and harmless as a broadcast
    #: A write may start, stop or reset something, so only verbs write it. Unless stated, this holds for
    #: commands, and for settings that have `harmless`.
    moves: bool
    #: Of a register that moves the motor, the raw counts that anyone may write at any time, and again when
    #: the reply is lost. All others are for verbs, which send them once.
    harmless: tuple[int, ...]
    never: str  #: reason why the library never writes it
    never_together: tuple[int, ...]  #: masks of bits that are never set in one write
    place: str  #: section of the manual
    outside: str  #: source, where it is not the family's own document
    note: str  #: further facts for users


class Declaration(Protocol):
    """A function that declares registers, each with its unit or the enumeration of its values."""

    @overload
    def __call__(self, address: int, unit: str = "", /, **details: Unpack[Details]) -> Register[float]: ...
    @overload
    def __call__(self, address: int, values: type[E], /, **details: Unpack[Details]) -> Register[E]: ...


def declaration(declare: Callable[..., Register[Any]]) -> Declaration:
    """Decorate a function that takes an address, a unit or an enumeration, and details."""
    return cast(Declaration, declare)


@declaration
def reading(address: int, what: str | type = "", /, **details: Unpack[Details]) -> Register[Any]:
    """Declare a quantity that can only be read, with its unit or the enumeration of its values."""
    return _declare(Access.READING, address, what, details)


@declaration
def setting(address: int, what: str | type = "", /, **details: Unpack[Details]) -> Register[Any]:
    """Declare a quantity that can be read and written, with its unit or the enumeration of its values."""
    return _declare(Access.SETTING, address, what, details)


@declaration
def command(address: int, what: str | type = "", /, **details: Unpack[Details]) -> Register[Any]:
    """Declare a quantity that can only be written, with its unit or the enumeration of its values."""
    return _declare(Access.COMMAND, address, what, details)


def _declare(access: Access, address: int, what: Any, given: Details) -> Register[Any]:
    details = cast(Any, given)
    if isinstance(details.get("invalid"), (int, float)):
        details = {**details, "invalid": (details["invalid"],)}
    if isinstance(what, str):
        return Register(address, access, unit=what, **details)
    return Register(address, access, values=what, **details)
