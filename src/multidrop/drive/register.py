"""Register: one quantity of a drive, as its manual describes it, and its values in replies and requests.

A `Register[float]` has a unit and a step. A `Register[E]` has the values of the enumeration E. Declare them
with `reading`, `setting` and `command`. Option: a property of a drive that only its owner knows.
"""

from __future__ import annotations

import math
import re
import sys
import tomllib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from decimal import Decimal
from enum import Enum, Flag, IntEnum, IntFlag
from fractions import Fraction
from functools import cache, cached_property
from importlib.resources import files
from typing import Any, Generic, Protocol, Self, TypedDict, TypeVar, Unpack, cast, overload

from multidrop.core import Extra, Field, NumberFormat
from multidrop.drive.number_format import (
    FLOATS,
    MOST_POWER,
    SHORT_FLOATS,
    WHOLE,
    WORDS,
    Coding,
    bits_of,
    shortest,
)
from multidrop.printable import plain_number, plain_whole


class Kept(Enum):
    """The memory that holds a written value; EEPROM tolerates a limited number of writes."""

    RAM = "RAM"
    EEPROM = "EEPROM"
    UNKNOWN = "not stated"

    __hash__ = object.__hash__  # ten times as fast as Enum's own hash, which hashes the name


class Carrier(Enum):
    """The kind of data that a frame carries for one address, such as a bit or a 16-bit word."""

    BIT = "bit"
    WORD = "word"
    LONG = "four bytes"  # Delixi's D3..D0
    NUMBER = "parameter number"  # Delixi's P1P0

    __hash__ = object.__hash__  # ten times as fast as Enum's own hash


@dataclass(frozen=True)
class Table:
    """One of a drive's address spaces, and the function codes that read and write it."""

    name: str
    read: int | None
    write: int | None
    carrier: Carrier = Carrier.WORD
    kept: Kept = Kept.UNKNOWN  # memory that holds the values, if all addresses of the table use the same

    @property
    def read_space(self) -> tuple[Carrier, int | None]:
        """A key that is equal for tables that one request can read together."""
        return self.carrier, self.read


HOLDING = Table("holding register", 0x03, 0x06)
# writes use function 10H, even for a single register
HOLDING_MULTIPLE = Table("holding register", 0x03, 0x10)
INPUT = Table("input register", 0x04, None)
COIL = Table("coil", 0x01, 0x05, Carrier.BIT)
DISCRETE = Table("discrete input", 0x02, None, Carrier.BIT)

T = TypeVar("T", bound=float)
# words that stay in capitals in the texts of named values
ACRONYMS = frozenset({"DC", "EEPROM", "PID", "PWM"})


class Worded(IntEnum):
    """Named numbers. If a name is only the manual's code, such as E07, `words` says what it means."""

    words: str

    def __new__(cls, value: int, words: str = "") -> Self:
        member = int.__new__(cls, value)
        member._value_ = value
        member.words = words
        return member


class Access(Enum):
    READING = "reading"
    SETTING = "setting"
    COMMAND = "command"


@dataclass(frozen=True, eq=False)
class Register(Generic[T]):
    """One quantity of a drive: its address, meaning and limits. See `Details` for each attribute."""

    address: int
    access: Access
    unit: str = ""
    values: type[T] | None = None
    step: float | None = 1
    offset: float = 0
    invalid: tuple[float, ...] = ()
    part: tuple[int, int] | None = None
    order: str = "ABCD"
    scale_register: str = ""
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
    titles: Mapping[str, str] = field(default_factory=dict)
    name: str = field(default="", init=False)
    # the register that holds the power of ten for this value
    scaled_by: Register[float] | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        carrier = getattr(self.table, "carrier", Carrier.WORD)  # a table of a wrong type is reported later
        if self.number_format == NumberFormat.U16 and carrier is not Carrier.WORD:
            object.__setattr__(
                self, "number_format", NumberFormat.BIT if carrier is Carrier.BIT else NumberFormat.U32
            )
        table_kept = getattr(self.table, "kept", Kept.UNKNOWN)
        if self.access is not Access.READING and table_kept is not Kept.UNKNOWN:
            if self.kept not in (Kept.UNKNOWN, table_kept):
                raise ValueError(
                    f"register {self.address:04X}H cannot be kept in {self.kept.value}: all registers of its "
                    f"table {self.table.name!r} are kept in {table_kept.value}"
                )
            object.__setattr__(self, "kept", table_kept)

    def __set_name__(self, owner: type, name: str) -> None:
        if not self.name:  # the first attribute with this register gives it its name
            object.__setattr__(self, "name", name)

    def __str__(self) -> str:
        return self.name

    def __repr__(self) -> str:
        table = getattr(self.table, "name", self.table)  # a table of a wrong type is reported later
        unit = f", {self.unit}" if self.unit else ""
        return f"<Register {self.name or '(no name)'}: {self.access.value}, {table} {self.address}{unit}>"

    @property
    def title(self) -> str:
        """The English title: the register's name with spaces instead of underscores."""
        return self.name.replace("_", " ")

    def title_in(self, language: str) -> str:
        """Return the title in a language such as "ru"; the English title if there is none."""
        return self.titles.get(language) or catalogue(language).get(self.name) or self.title

    @cached_property
    def words(self) -> int:
        """Number of addresses that the register occupies in its table."""
        return WORDS[self.number_format] if self.table.carrier is Carrier.WORD else 1

    @cached_property
    def reach(self) -> range:
        """Addresses that one request must read to get the value; they include the scale register."""
        own = range(self.address, self.address + self.words)
        if self.scaled_by is None:
            return own
        other = self.scaled_by.address
        return range(min(own.start, other), max(own.stop, other + 1))

    @cached_property
    def coding(self) -> Coding:
        """The encoding of the value in the register's words, with the exact scale."""
        offset = Fraction(str(self.offset))
        return Coding(self.number_format, self.order, self.part, self.invalid, self.scale, offset)

    @property
    def readable(self) -> bool:
        return self.access is not Access.COMMAND and self.table.read is not None

    @property
    def writable(self) -> bool:
        return (
            self.access is not Access.READING
            and self.table.write is not None
            and not self.never
            and self.part is None
            and not self.scale_register
        )

    @property
    def is_float(self) -> bool:
        """True if the raw count is a float."""
        return self.table.carrier is Carrier.WORD and self.number_format in FLOATS

    @property
    def is_bit(self) -> bool:
        """True for a coil or a discrete input without names: its values are bool."""
        return self.values is None and self.table.carrier is Carrier.BIT

    @property
    def commands(self) -> bool:
        """True if a write to the register may move the motor. Only verbs write such a register."""
        if self.moves is None:
            return self.access is Access.COMMAND or self.harmless is not None
        return self.moves

    @cached_property
    def scale(self) -> Fraction:
        """The step as an exact fraction, because 3 * 0.1 as floats is not 0.3; 1 if the step is unknown."""
        return Fraction(str(self.step)) if self.step is not None else Fraction(1)

    @property
    def value_unit(self) -> str:
        """The unit of the values in Python: `unit`, or "raw count" if the manual does not state the scale."""
        return self.unit if self.values is not None or self.step is not None else "raw count"

    @property
    def decimals(self) -> int:
        """Number of decimal places that the step and the offset need."""
        parts = (Decimal(f"{float(part):.6g}") for part in (self.scale, self.coding.offset))
        return max(0, *(-int(part.normalize().as_tuple().exponent) for part in parts))

    def number_in(self, data: bytes, at: int) -> float | None:
        """Return the number at index `at` of a reply's data, or None. `at` counts words, or bits for coils.

        The number is as in polled rows: in the register's unit, or the raw count of a named value.
        """
        raw = self.coding.raw_in(data, at)
        if raw is None or self.scaled_by is None:
            return None if raw is None else self.coding.value_of(raw)
        power = self.scaled_by.coding.raw_in(data, at + self.scaled_by.address - self.address)
        if power is None or abs(power) > MOST_POWER:
            return None
        return self.coding.value_of(raw, int(power))

    def value_in(self, data: bytes, at: int) -> T | None:
        """Return the value at index `at` of a reply's data, or None. `at` counts words, or bits for coils."""
        number = self.number_in(data, at)
        if number is None:
            return None
        return cast(T, number) if self.values is None and not self.is_bit else self.decode(number)

    def decode(self, raw: float) -> T:
        """Return the value of a raw count: in the unit, or as a member of the enumeration if it has one.

        A raw count without a member is returned as an int.
        """
        if self.values is not None:
            try:
                return self.values(int(raw))
            except ValueError:
                return cast(T, int(raw))
        return cast(T, bool(raw) if self.is_bit else self.coding.value_of(raw))

    def encode(self, value: T) -> float:
        """Return the raw count of a value: a whole number, or for a float register the nearest float.

        Raises ValueError if the value is outside the span, TypeError if it is not a number.
        """
        if self.values is not None:
            return self._encode_name(value)
        if (isinstance(value, bool) and not self.is_bit) or not isinstance(value, (int, float)):
            raise TypeError(f"{self.name} takes a number, not {value!r}")
        if not abs(value) < math.inf:
            raise ValueError(f"{self.name} takes a finite number, not {value!r}")
        if self.span is not None and not self.span[0] <= value <= self.span[1]:
            low, high = self.span
            raise ValueError(
                f"{self.name} = {_short(value)} is outside {low:g} to {high:g} {self.unit}".rstrip()
            )
        bottom, top = self.coding.raw_span
        try:
            raw = self._raw(value)
        except OverflowError:
            raw = math.inf
        if not bottom <= raw <= top:
            least, most = sorted(float(end * self.scale + self.coding.offset) for end in (bottom, top))
            raise ValueError(
                f"{self.name} = {_short(value)} does not fit: the register holds {least:g} to {most:g} "
                f"{self.unit}".rstrip()
            )
        self._check_valid(raw, value)
        return raw

    def _check_valid(self, raw: float, value: float) -> None:
        if self.invalid and self.coding.raw_of(bits_of(raw, self.number_format)) is None:
            raise ValueError(
                f"{self.name} = {_short(value)} cannot be written: its raw count stands for a missing value"
            )

    def _raw(self, value: float) -> float:
        if abs(value) > sys.float_info.max:
            raise OverflowError
        if self._counts and not self.is_float and self.coding.exact_count(value).denominator != 1:
            raise ValueError(f"{self.name} takes a whole number, not {value:g}")
        return self.coding.count_of(value)

    def takes(self, value: T) -> bool:
        """Return True if `value` is one of the named values, or within the register's limits."""
        if self.values is not None:
            return isinstance(value, self.values)
        if self.span is None:
            return True
        low, high = self.span
        # the drive rounds a limit to a float, which may lie just outside the span
        if self.is_float:
            low, high = (self.coding.value_of(self.coding.count_of(end)) for end in self.span)
        return low <= value <= high

    @property
    def _counts(self) -> bool:
        """True if the values are choices or raw counts, which are never rounded."""
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
            raw = int(cast(Any, value).value)
            self._check_valid(raw, raw)
            return raw
        choices = ", ".join(member.name for member in values)
        raise TypeError(f"{self.name} takes one of {choices}, not {value!r}")

    def parse(self, text: str) -> T:
        """Return the value that a user typed: a number, or names joined by "|".

        Raises ValueError for an invalid text.
        """
        if self.values is None:
            try:
                return cast(T, _number_in(text) if self.number_format in WHOLE else plain_number(text))
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
        """Return the value as text, with its unit."""
        if isinstance(value, Flag):
            named = "|".join(str(member.name) for member in value)
            return ", ".join(filter(None, (named, *unnamed_bits(value)))) or "none"
        if isinstance(value, IntEnum):
            return value.name
        unit = self.unit if self.step is not None else "(scale not stated)"
        return f"{self._number(value)} {unit}".rstrip()

    def in_words(self, value: T) -> str:
        """Return a named value in plain words, such as "motor overload"; other values as `format` does."""
        if isinstance(value, Flag):
            names = [_spaced(str(member.name)) for member in value]
            return ", ".join([*names, *unnamed_bits(value)]) or "none"
        if isinstance(value, Worded) and value.words:
            return value.words
        return _spaced(value.name) if isinstance(value, Enum) else self.format(value)

    def _number(self, value: float) -> str:
        if self.number_format in WHOLE and isinstance(value, int) and not self.decimals:
            return str(value)
        if self.number_format in SHORT_FLOATS and not self.offset:
            return shortest(value, self.scale, self.number_format)
        if self.scale_register:
            return f"{value:.12g}"
        return repr(value).removesuffix(".0") if self.is_float else f"{value:.{self.decimals}f}"


def unnamed_bits(value: Flag) -> list[str]:
    """Return a text such as "bit 8" for each bit that is set and has no name."""
    rest = int(value.value)
    for member in value:
        rest &= ~int(member.value)
    return [f"bit {bit}" for bit in range(rest.bit_length()) if rest >> bit & 1]


def _spaced(name: str) -> str:
    return " ".join(part if part in ACRONYMS else part.lower() for part in name.split("_"))


def _number_in(text: str) -> float:
    """Return the number that `text` spells; whole numbers are exact. Raises ValueError for other texts."""
    try:
        return plain_whole(text)
    except ValueError:
        return plain_number(text)


def _short(value: float) -> str:
    """Return a number, which may be larger than any float, as short text for an error message."""
    return f"{value:g}" if abs(value) <= sys.float_info.max else "a number of this size"


E = TypeVar("E", bound=IntEnum | IntFlag)


class Details(TypedDict, total=False):
    """Optional attributes of a declared register, besides its address and unit."""

    step: float | None  #: quantity per raw count; None if the document does not state it
    offset: float  #: value of the raw count 0, so that value = raw count * step + offset
    #: Raw counts that mean "no value". A bit pattern is also accepted, such as 0x8000 for an I16.
    invalid: float | tuple[float, ...]
    #: Lowest and highest bit of a reading that is only a part of a number. A raw count in `invalid` that does
    #: not fit into these bits is compared with the whole number.
    part: tuple[int, int]
    #: order of the number's bytes on the wire, A the most significant: ABCD, CDAB, BADC, DCBA, AB or BA
    order: str
    #: name of the reading that holds this register's power of ten; one request reads both
    scale_register: str
    span: tuple[float, float]  #: smallest and largest value that may be written
    at_least: str  #: register or option whose present value is the smallest value that may be written
    at_most: str  #: register or option whose present value is the largest value that may be written
    number_format: NumberFormat  #: width, sign and kind of the number, such as U16 or F32
    table: Table  #: address space with its function codes, such as the holding registers
    kept: Kept  #: memory that holds the value, RAM or EEPROM; by default that of the table
    ram_address: int  #: address at which the same quantity is written without wearing the EEPROM
    default: float  #: factory value
    while_running: bool  #: whether the register may be changed while the motor turns; None if not stated
    broadcast: tuple[int, ...]  #: raw counts that the document allows in a broadcast, and that are harmless
    #: True if a write may start, stop or reset something. Only verbs (methods such as `start`) write such a
    #: register. The default is True for commands, and for settings with a list of `harmless` raw counts.
    moves: bool
    #: Raw counts that do not move the motor although the register can: any caller may write them at any time,
    #: and they are repeated if the reply is lost. Only verbs send other raw counts, and only once.
    harmless: tuple[int, ...]
    never: str  #: reason why the library never writes the register
    never_together: tuple[int, ...]  #: masks of bits that are never set in one write
    place: str  #: section of the manual that describes the register
    outside: str  #: source of this declaration, if it is not the family's own document
    note: str  #: further information for users
    titles: Mapping[str, str]  #: titles in other languages, by the language: `{"ru": "выходной ток"}`


class Declaration(Protocol):
    """A function that declares a register: it takes the address, the unit or enumeration, and `Details`."""

    @overload
    def __call__(self, address: int, unit: str = "", **details: Unpack[Details]) -> Register[float]: ...
    @overload
    def __call__(self, address: int, values: type[E], **details: Unpack[Details]) -> Register[E]: ...


def declaration(declare: Callable[..., Register[Any]]) -> Declaration:
    """Decorator that gives a function such as `reading` the type Declaration."""
    return cast(Declaration, declare)


@declaration
def reading(address: int, what: str | type = "", /, **details: Unpack[Details]) -> Register[Any]:
    """Declare a quantity that can only be read, with its unit or the enumeration of its values."""
    return declare(Access.READING, address, what, details)


@declaration
def setting(address: int, what: str | type = "", /, **details: Unpack[Details]) -> Register[Any]:
    """Declare a quantity that can be read and written, with its unit or the enumeration of its values."""
    return declare(Access.SETTING, address, what, details)


@declaration
def command(address: int, what: str | type = "", /, **details: Unpack[Details]) -> Register[Any]:
    """Declare a quantity that can only be written, with its unit or the enumeration of its values."""
    return declare(Access.COMMAND, address, what, details)


def declare(access: Access, address: int, what: Any, given: Details) -> Register[Any]:
    """Declare a register; `what` is its unit, or the enumeration of its values."""
    details = cast(Any, given)
    if isinstance(details.get("invalid"), (int, float)):
        details = {**details, "invalid": (details["invalid"],)}
    key = "unit" if isinstance(what, str) else "values"
    return Register(address, access, **{key: what, **details})


@dataclass(frozen=True)
class Option:
    """A property of a drive that only its owner knows, such as its maximum frequency.

    An option without a unit is a whole number.
    """

    unit: str
    span: tuple[float, float]
    meaning: str


def row_field(register: Register[Any], at: int, code: int) -> Field:
    """Return the Field with which the C core decodes this register in a reply.

    `at` is the index in the reply's data, in words, or in bits for coils. `code` is the number that stands
    for the register's name in polled rows.
    """
    multiplier, _, divisor = register.coding.factors
    return Field(at, register.coding.core_format, code, multiplier, divisor, _extra(register, at))


def _extra(register: Register[Any], at: int) -> Extra | None:
    coding, power = register.coding, register.scaled_by
    if not (register.offset or register.part or coding.invalid_patterns or power):
        return None
    low, high = register.part or (0, -1)
    return Extra(
        addend=coding.factors[1],
        low=low,
        bits=high - low + 1,
        scale_at=at + power.address - register.address if power else None,
        scale_format=power.coding.core_format if power else 0,
        invalid=coding.invalid_patterns,
        scale_invalid=power.coding.invalid_patterns if power else (),
    )


# ---- titles in other languages ----


LANGUAGES = ("ru", "zh")  # languages of the catalogue, besides English
ENGLISH = "en"
_CODE = re.compile(r"[A-Za-z]{2}(?![A-Za-z])")  # finds the language in a tag such as ru-RU or ru_RU.UTF-8


@cache
def catalogue(language: str) -> Mapping[str, str]:
    """Return the titles in a language, by register name. English has none, because the names are English."""
    if language not in LANGUAGES:
        return {}
    file = files("multidrop.drive") / "catalogue" / f"{language}.toml"
    return tomllib.loads(file.read_text("utf-8"))


def chosen_language(tags: Iterable[str]) -> str:
    """Return the first language of `tags` in which registers have titles; English if there is none.

    A tag may be `ru`, `zh-CN` or `ru_RU.UTF-8`, for example.
    """
    codes = (match[0].lower() for tag in tags if (match := _CODE.match(tag.strip())))
    return next((code for code in codes if code in (*LANGUAGES, ENGLISH)), ENGLISH)
