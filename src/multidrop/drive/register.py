"""Registers: what a drive's manual says about one quantity, as a typed declaration without I/O.

Three words carry the access: a `reading` can be read, a `setting` read and written, a `command`
only written. `Register[float]` has a unit and a step, `Register[E]` has the names of an enumeration.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, field
from decimal import Decimal
from enum import Enum, Flag, IntEnum, IntFlag
from fractions import Fraction
from functools import cached_property
from typing import Any, Generic, NotRequired, TypedDict, TypeVar, Unpack, cast, overload

from multidrop.core import NumberFormat
from multidrop.drive import float32

__all__ = [
    "COIL",
    "DISCRETE",
    "HOLDING",
    "INPUT",
    "Access",
    "Carrier",
    "Kept",
    "NumberFormat",
    "Register",
    "Table",
    "command",
    "reading",
    "setting",
]

T = TypeVar("T", bound=float)
E = TypeVar("E", bound=IntEnum | IntFlag)


class Access(Enum):
    READING = "reading"
    SETTING = "setting"
    COMMAND = "command"


class Kept(Enum):
    """Where a drive keeps what is written: EEPROM bears a limited number of writes."""

    RAM = "RAM"
    EEPROM = "EEPROM"
    UNKNOWN = "not stated"


class Carrier(Enum):
    """Where in a frame a table's values travel."""

    BIT = "bit"
    WORD = "word"
    LONG = "four bytes"  # Delixi's D3..D0
    NUMBER = "parameter number"  # Delixi's P1P0


@dataclass(frozen=True)
class Table:
    """One of a drive's address spaces, the function codes that reach it, and what a write there wears."""

    name: str
    read: int | None
    write: int | None
    carrier: Carrier = Carrier.WORD
    kept: Kept = Kept.UNKNOWN  # where the function code alone decides it


HOLDING = Table("holding register", 0x03, 0x06)
INPUT = Table("input register", 0x04, None)
COIL = Table("coil", 0x01, 0x05, Carrier.BIT)
DISCRETE = Table("discrete input", 0x02, None, Carrier.BIT)

FLOAT_WIRES = (NumberFormat.F32, NumberFormat.F32_SWAPPED)
_LONG_WIRES = (
    NumberFormat.U32,
    NumberFormat.I32,
    NumberFormat.U32_SWAPPED,
    NumberFormat.I32_SWAPPED,
    NumberFormat.U32_EITHER,
    *FLOAT_WIRES,
)
_LARGEST_FLOAT = float.fromhex("0x1.fffffep127")


class Details(TypedDict):
    """What a declaration may say besides address and unit; all of it may be left out.

    step: value of one raw count; None where the document does not state it
    span: smallest and largest value that may be written
    at_least, at_most: the register or option whose present value bounds it besides
    number_format: how the number lies in the frame
    table: address space and function codes
    kept: RAM or EEPROM; that of the table where the table has one
    ram_address: where the same quantity can be written without wearing the EEPROM
    default: value from the factory
    while_running: may be changed while the motor turns; None where not stated
    broadcast: the raw counts that are documented and harmless as a broadcast
    moves: a write to it may start, stop or reset something, and is left to the verbs; if not stated, a
        command does, and a setting does not unless it has `harmless`
    harmless: of a register that moves the motor, the raw counts that anyone may write at any time,
        and again when their answer is lost; all others are for verbs, which send them once
    never: why the library never writes it
    never_together: masks of bits that are never set in one write
    place: where the manual says so
    outside: the source, where it is not the family's own document
    note: what else a user must know
    """

    step: NotRequired[float | None]
    span: NotRequired[tuple[float, float]]
    at_least: NotRequired[str]
    at_most: NotRequired[str]
    number_format: NotRequired[NumberFormat]
    table: NotRequired[Table]
    kept: NotRequired[Kept]
    ram_address: NotRequired[int]
    default: NotRequired[float]
    while_running: NotRequired[bool]
    broadcast: NotRequired[tuple[int, ...]]
    moves: NotRequired[bool]
    harmless: NotRequired[tuple[int, ...]]
    never: NotRequired[str]
    never_together: NotRequired[tuple[int, ...]]
    place: NotRequired[str]
    outside: NotRequired[str]
    note: NotRequired[str]


@dataclass(frozen=True, eq=False)
class Register(Generic[T]):
    """One quantity of a drive: where it is, what it means, what may be done with it."""

    address: int
    access: Access
    unit: str = ""
    values: type[T] | None = None
    step: float | None = 1
    span: tuple[float, float] | None = None
    at_least: str = ""
    at_most: str = ""
    number_format: NumberFormat = NumberFormat.U16
    table: Table = HOLDING
    kept: Kept = Kept.UNKNOWN
    ram_address: int | None = None
    default: float | None = None
    while_running: bool | None = None
    broadcast: tuple[int, ...] = ()
    moves: bool | None = None
    harmless: tuple[int, ...] | None = None
    never: str = ""
    never_together: tuple[int, ...] = ()
    place: str = ""
    outside: str = ""
    note: str = ""
    name: str = field(default="", init=False)

    def __post_init__(self) -> None:
        carrier = getattr(self.table, "carrier", Carrier.WORD)  # a wrong table is told with the class
        if self.number_format == NumberFormat.U16 and carrier is not Carrier.WORD:
            object.__setattr__(
                self, "number_format", NumberFormat.BIT if carrier is Carrier.BIT else NumberFormat.U32
            )
        table_kept = getattr(self.table, "kept", Kept.UNKNOWN)
        if self.access is not Access.READING and table_kept is not Kept.UNKNOWN:
            if self.kept not in (Kept.UNKNOWN, table_kept):
                table = f"{self.table.name!r} is kept in {table_kept.value}"
                raise ValueError(f"register {self.address:04X}H: a {table}, not in {self.kept.value}")
            object.__setattr__(self, "kept", table_kept)

    def __set_name__(self, owner: type, name: str) -> None:
        if not self.name:  # a second name would take the first one away
            object.__setattr__(self, "name", name)

    def __str__(self) -> str:
        return self.name

    @cached_property
    def words(self) -> int:
        """Addresses that it takes in its table."""
        return 2 if self.table.carrier is Carrier.WORD and self.number_format in _LONG_WIRES else 1

    @property
    def readable(self) -> bool:
        return self.access is not Access.COMMAND and self.table.read is not None

    @property
    def writable(self) -> bool:
        return self.access is not Access.READING and self.table.write is not None and not self.never

    @property
    def is_float(self) -> bool:
        """True where the raw count is a float32."""
        return self.table.carrier is Carrier.WORD and self.number_format in FLOAT_WIRES

    @property
    def commands(self) -> bool:
        """True where a write may move the motor: verbs alone send it, but for what is `harmless`."""
        if self.moves is None:
            return self.access is Access.COMMAND or self.harmless is not None
        return self.moves

    @cached_property
    def scale(self) -> Fraction:
        """The step as an exact fraction, 1 where it is unknown: 3 * 1/10 is 0.3, not 0.30000000000000004."""
        return Fraction(str(self.step)) if self.step is not None else Fraction(1)

    @property
    def decimals(self) -> int:
        """Digits after the point that the step needs."""
        exponent = Decimal(f"{float(self.scale):.6g}").normalize().as_tuple().exponent
        return max(0, -int(exponent))

    def decode(self, raw: float) -> T:
        """The value of a raw count."""
        if self.values is not None:
            try:
                return self.values(int(raw))
            except ValueError:
                return cast(T, int(raw))
        return cast(T, raw * self.scale.numerator / self.scale.denominator + 0.0)  # never -0.0

    def encode(self, value: T) -> float:
        """Return the raw count of a value: a whole number, or in a float register the nearest float32.

        Raises ValueError outside the span, TypeError for what is no number.
        """
        if self.values is not None:
            return self._encode_name(value)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise TypeError(f"{self.name} takes a number, not {value!r}")
        if not abs(value) < math.inf:
            raise ValueError(f"{self.name} takes a finite number, not {value!r}")
        if self.span is not None and not self.span[0] <= value <= self.span[1]:
            low, high = self.span
            raise ValueError(
                f"{self.name} = {_short(value)} is outside {low:g} to {high:g} {self.unit}".rstrip()
            )
        bottom, top = self._raw_span()
        try:
            raw = self._raw(value)
        except OverflowError:
            raw = math.inf
        if not bottom <= raw <= top:
            least, most = sorted((float(bottom * self.scale), float(top * self.scale)))
            raise ValueError(
                f"{self.name} = {_short(value)} does not fit: {least:g} to {most:g} {self.unit}".rstrip()
            )
        return raw

    def _raw(self, value: float) -> float:
        if abs(value) > sys.float_info.max:
            raise OverflowError
        count = Fraction(str(value)) / self.scale
        if self.is_float:
            return float32.nearest(count)
        if count.denominator != 1 and self._counts:
            raise ValueError(f"{self.name} takes a whole number, not {value:g}")
        return round(count)

    def takes(self, value: T) -> bool:
        """Return True for a value that a drive may have been given: it has a name, or is in the span."""
        if self.values is not None:
            return isinstance(value, self.values)
        if self.span is None:
            return True
        low, high = self.span
        if self.is_float:  # a drive holds the float32 nearest to an end
            low, high = (float(self.scale * Fraction(float32.nearest(end / self.scale))) for end in self.span)
        return low <= value <= high

    @property
    def _counts(self) -> bool:
        """Its numbers are choices or raw counts, of which the nearest one may mean something else."""
        return self.step is None or (self.step == 1 and not self.unit)

    def _encode_name(self, value: T) -> int:
        values = cast(Any, self.values)
        known = set(values)
        if isinstance(value, values):
            if issubclass(values, Flag):
                reserved = cast(Any, value).value & ~sum(member.value for member in known)
                if reserved:
                    raise ValueError(f"{self.name}: bits {reserved:#x} are reserved and must stay 0")
                for mask in self.never_together:
                    if cast(Any, value).value & mask == mask:
                        apart = values(mask).name.replace("|", " and ")
                        raise ValueError(f"{self.name}: {apart} are never written together")
            return int(cast(Any, value).value)
        choices = ", ".join(member.name for member in values)
        raise TypeError(f"{self.name} takes one of {choices}, not {value!r}")

    def _raw_span(self) -> tuple[Fraction, Fraction]:
        low, high = self._whole_span() if not self.is_float else (-_LARGEST_FLOAT, _LARGEST_FLOAT)
        return Fraction(low), Fraction(high)

    def _whole_span(self) -> tuple[int, int]:
        if self.number_format is NumberFormat.BIT:
            return 0, 1
        bits = 16 if self.number_format in (NumberFormat.U16, NumberFormat.I16) else 32
        if self.number_format in (NumberFormat.I16, NumberFormat.I32, NumberFormat.I32_SWAPPED):
            return -(1 << bits - 1), (1 << bits - 1) - 1
        return 0, (1 << bits) - 1

    def parse(self, text: str) -> T:
        """The value that a person typed: a number, or names joined by "|"; ValueError if it is neither."""
        if self.values is None:
            try:
                return cast(T, float(text))
            except ValueError:
                unit = self.unit or "counts"
                raise ValueError(f"{self.name} takes a number in {unit}, not {text!r}") from None
        values = cast(Any, self.values)
        names = {member.name.lower(): member for member in values}
        try:
            found = [names[part.strip().lower().replace("-", "_")] for part in text.split("|")]
        except KeyError as unknown:
            raise ValueError(f"{self.name} has no {unknown}; it takes {', '.join(names)}") from None
        if len(found) > 1 and not issubclass(values, Flag):
            raise ValueError(f"{self.name} takes one of {', '.join(names)}")
        total = found[0]
        for member in found[1:]:
            total |= member
        return cast(T, total)

    def format(self, value: T) -> str:
        """The value as a person reads it, with its unit."""
        if isinstance(value, Flag):
            return "|".join(str(member.name) for member in value) or "none"
        if isinstance(value, IntEnum):
            return value.name
        unit = self.unit if self.step is not None else "(scale not stated)"
        number = float32.shortest(value, self.scale) if self.is_float else f"{value:.{self.decimals}f}"
        return f"{number} {unit}".rstrip()


def _short(value: float) -> str:
    """Return a number as a sentence shows it; it may be larger than any float."""
    return f"{value:g}" if abs(value) <= sys.float_info.max else "a number of this size"


@overload
def reading(address: int, unit: str = "", /, **details: Unpack[Details]) -> Register[float]: ...
@overload
def reading(address: int, values: type[E], /, **details: Unpack[Details]) -> Register[E]: ...
def reading(address: int, what: Any = "", /, **details: Unpack[Details]) -> Register[Any]:
    """A quantity that can only be read, with its unit or the enumeration of its values."""
    return _declare(Access.READING, address, what, details)


@overload
def setting(address: int, unit: str = "", /, **details: Unpack[Details]) -> Register[float]: ...
@overload
def setting(address: int, values: type[E], /, **details: Unpack[Details]) -> Register[E]: ...
def setting(address: int, what: Any = "", /, **details: Unpack[Details]) -> Register[Any]:
    """A quantity that can be read and written, with its unit or the enumeration of its values."""
    return _declare(Access.SETTING, address, what, details)


@overload
def command(address: int, unit: str = "", /, **details: Unpack[Details]) -> Register[float]: ...
@overload
def command(address: int, values: type[E], /, **details: Unpack[Details]) -> Register[E]: ...
def command(address: int, what: Any = "", /, **details: Unpack[Details]) -> Register[Any]:
    """A quantity that can only be written, with its unit or the enumeration of its values."""
    return _declare(Access.COMMAND, address, what, details)


def _declare(access: Access, address: int, what: Any, details: Details) -> Register[Any]:
    if isinstance(what, str):
        return Register(address, access, unit=what, **details)
    return Register(address, access, values=what, **details)
