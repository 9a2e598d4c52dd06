"""Check the declarations of a drive's class: all that is wrong with them is found when the class is made."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping
from enum import IntEnum, IntFlag
from numbers import Real
from typing import Any

from multidrop.core import MOST_INVALID, NumberFormat
from multidrop.drive.number_check import number_errors
from multidrop.drive.number_format import ORDERS, WORDS
from multidrop.drive.register import Access, Register
from multidrop.drive.table import Carrier, Kept, Table

LAST_ADDRESS = 0xFFFF
_TEXTS = ("unit", "scale_register", "at_least", "at_most", "never", "place", "outside", "note")
_TRUTHS = ("while_running", "moves")
_COUNTS = ("broadcast", "harmless", "never_together")
# Function codes that write the same registers: one at a time, and several at once.
_SAME_SPACE = {0x05: 0x0F, 0x06: 0x10}


class DeclarationError(ValueError):
    """All errors in a drive's class; `mistakes` has each as a sentence with the register's name."""

    def __init__(self, owner: str, mistakes: Collection[str]) -> None:
        super().__init__("\n".join(f"{owner}.{mistake}" for mistake in mistakes))
        self.mistakes = tuple(mistakes)


def declaration_errors(
    registers: Mapping[str, Register[Any]], taken: Collection[str], bounds: Collection[str]
) -> list[str]:
    """Return a sentence for each error in a class's registers.

    `taken` are names that every drive uses for something else; `bounds` are those of the class's options.
    """
    found, sound = [], []
    for name, register in registers.items():
        if name in taken:
            found.append(f"{name}: this is a name that every drive has for something else; call it otherwise")
        if register.name != name:
            found.append(f"{name}: this is the register {register.name} already; declare one of its own")
        wrong = [sentence for check in _CHECKS for sentence in check(register)]
        wrong = wrong or list(_later(register, registers, bounds))
        found += [f"{name}: {sentence}" for sentence in wrong]
        if not wrong:
            sound.append(register)
    return [*found, *_shared(sound)]


# ---- one register, each fact by itself ----


def _kinds(register: Register[Any]) -> Iterator[str]:
    if not isinstance(register.table, Table):
        yield f"table = {register.table!r} is no table: HOLDING, INPUT, COIL, DISCRETE or a Table(…)"
    if register.order not in ORDERS:
        yield f"order = {register.order!r} is none of {', '.join(ORDERS)}"
    if not isinstance(register.number_format, NumberFormat):
        given = register.number_format
        yield f"number_format = {given!r} is no number format: write {' or '.join(_near(given))}"
    if not isinstance(register.kept, Kept):
        yield f"kept = {register.kept!r} is none of Kept.RAM, Kept.EEPROM and Kept.UNKNOWN"
    for name in _TEXTS:
        if not isinstance(getattr(register, name), str):
            yield f"{name} = {getattr(register, name)!r} is no text"
    for name in _TRUTHS:
        if getattr(register, name) not in (None, True, False):
            yield f"{name} = {getattr(register, name)!r} is neither True nor False"
    for name in _COUNTS:
        if (counts := getattr(register, name)) is not None and not _are_counts(counts):
            yield f"{name} = {counts!r} is no tuple of raw counts, such as (0,)"
    values = register.values
    if values is not None and not (isinstance(values, type) and issubclass(values, (IntEnum, IntFlag))):
        yield f"{values!r} is neither a unit nor an IntEnum or IntFlag of its values"


def _near(number_format: object) -> list[str]:
    named = (
        [str(number_format).upper()]
        if str(number_format).upper() in NumberFormat.__members__
        else list(NumberFormat.__members__)
    )
    return [f"NumberFormat.{name}" for name in named]


def _are_counts(counts: object) -> bool:
    return isinstance(counts, (tuple, list, range, frozenset)) and all(_is_whole(count) for count in counts)


def _is_whole(number: object) -> bool:
    return isinstance(number, int) and not isinstance(number, bool)


def _is_real(number: object) -> bool:
    return isinstance(number, Real) and not isinstance(number, bool)


def _is_number(number: object) -> bool:
    return isinstance(number, Real) and not isinstance(number, bool) and math.isfinite(number)


def _step(register: Register[Any]) -> Iterator[str]:
    step = register.step
    if step is not None and not _is_number(step):
        yield f"step = {step!r} is no number, such as 0.1; where the manual does not state it, it is None"
    elif step == 0:
        yield "step = 0: every value would be 0; where the manual does not state it, it is None"


def _offset(register: Register[Any]) -> Iterator[str]:
    if not _is_number(register.offset):
        yield f"offset = {register.offset!r} is no number, such as -40"


def _invalid(register: Register[Any]) -> Iterator[str]:
    counts = register.invalid
    if not isinstance(counts, (tuple, list, frozenset)) or not all(_is_real(count) for count in counts):
        yield f"invalid = {counts!r} is no tuple of raw counts, such as (0x7FFF,)"
    elif len(counts) > MOST_INVALID // 2:
        yield f"invalid has {len(counts)} counts, and the most is {MOST_INVALID // 2}"


def _part(register: Register[Any]) -> Iterator[str]:
    part = register.part
    if part is None:
        return
    if not isinstance(part, (tuple, list)) or len(part) != 2 or not all(_is_whole(bit) for bit in part):
        yield f"part = {part!r} is not the lowest and the highest bit, such as (0, 7)"
    elif not 0 <= part[0] <= part[1]:
        yield f"part = ({part[0]}, {part[1]}) is the wrong way round, or below bit 0"


def _span(register: Register[Any]) -> Iterator[str]:
    span = register.span
    if span is None:
        return
    if not (isinstance(span, (tuple, list)) and len(span) == 2 and all(_is_number(end) for end in span)):
        yield f"span = {span!r} is not two numbers, such as (0, 50)"
    elif span[0] > span[1]:
        yield f"span = ({span[0]:g}, {span[1]:g}) is the wrong way round: the smallest comes first"
    elif register.default is not None and not _is_number(register.default):
        return
    elif register.default is not None and not span[0] <= register.default <= span[1]:
        yield f"default = {register.default:g} is outside its span of {span[0]:g} to {span[1]:g}"


def _default(register: Register[Any]) -> Iterator[str]:
    if register.default is not None and not _is_number(register.default):
        yield f"default = {register.default!r} is no number"


def _places(register: Register[Any]) -> Iterator[str]:
    for name in ("address", "ram_address"):
        at = getattr(register, name)
        if at is None and name == "ram_address":
            continue
        if not _is_whole(at) or not 0 <= at <= LAST_ADDRESS:
            shown = f"{at:X}H" if _is_whole(at) and at >= 0 else repr(at)
            yield f"{name} {shown} is outside 0 to FFFFH"


_CHECKS: tuple[Callable[[Register[Any]], Iterator[str]], ...] = (
    *(_kinds, _step, _offset, _invalid, _part, _span, _default, _places),
)


# ---- one register, its facts together ----


def _later(
    register: Register[Any], registers: Mapping[str, Register[Any]], bounds: Collection[str]
) -> Iterator[str]:
    yield from _format(register)
    yield from _functions(register)
    yield from _access(register)
    for name in filter(None, (register.at_least, register.at_most)):
        other = registers.get(name)
        if name not in bounds and (other is None or not other.readable or other.values is not None):
            yield f"its bound {name} is neither an option nor a number that can be read"


def _format(register: Register[Any]) -> Iterator[str]:
    carrier, number_format = register.table.carrier, register.number_format
    wanted = {
        Carrier.BIT: (NumberFormat.BIT,),
        Carrier.WORD: tuple(WORDS),
    }.get(carrier, (NumberFormat.U32,))
    if number_format not in wanted:
        yield f"number_format = NumberFormat.{number_format.name} does not fit a {register.table.name}"
        return
    for name, at in (("address", register.address), ("ram_address", register.ram_address)):
        if at is not None and at + register.words - 1 > LAST_ADDRESS:
            yield f"{name} {at:04X}H: its {register.words} words reach beyond FFFFH"
    if register.ram_address == register.address:
        yield "its ram_address is its own address, which is the one that wears the EEPROM"
    yield from number_errors(register)
    if register.is_float and register.values is not None:
        names = register.values.__name__
        yield f"number_format = {number_format.name} is for numbers, and {names} names whole ones"
    if number_format is NumberFormat.U32_EITHER and register.writable:
        yield "number_format = U32_EITHER leaves the order of its words open: it is never written"
    if register.span is not None and register.writable and register.values is None:
        for end in register.span:
            try:
                register.encode(end)
            except ValueError as mistake:
                yield f"an end of its span cannot be written: {mistake}"


# The function codes that read and write bits, and words (application protocol V1.1b3, section 6).
_FUNCTIONS = {Carrier.BIT: ((0x01, 0x02), (0x05, 0x0F)), Carrier.WORD: ((0x03, 0x04), (0x06, 0x10))}


def _functions(register: Register[Any]) -> Iterator[str]:
    table = register.table
    for word, code, known in zip(
        ("read", "write"), (table.read, table.write), _FUNCTIONS.get(table.carrier, ()), strict=False
    ):
        if code is not None and code not in known:
            codes = " or ".join(f"{each:02X}H" for each in known)
            yield f"function {code!r} cannot {word} a {table.carrier.value}: its table has {codes} for it"


def _access(register: Register[Any]) -> Iterator[str]:
    """Find accesses for which the table has no function code."""
    table, word = register.table, register.access.value
    if register.access is not Access.COMMAND and table.read is None:
        yield f"{_a(table.name)} cannot be read, and so holds no {word}"
    if register.access is not Access.READING and table.write is None and not register.never:
        yield f"{_a(table.name)} cannot be written, and so holds no {word}"
    if register.access is Access.READING and (register.harmless or register.broadcast or register.moves):
        yield "a reading is never written: nothing can be harmless or move anything"


def _a(name: str) -> str:
    return f"an {name}" if name[0] in "aeiou" else f"a {name}"


# ---- several registers ----


def _shared(registers: list[Register[Any]]) -> Iterator[str]:
    """Find registers that are written at the same address and do not mean the same there.

    A reading may share its address with anything, and different tables may use the same addresses. A register
    that commands the motor shares its address with no alias in RAM, and with no register that has other
    harmless counts: a plain write would send what only verbs may send.
    """
    written = [one for one in registers if one.access is not Access.READING and one.table.write is not None]
    at: dict[tuple[object, int], list[Register[Any]]] = {}
    for other in written:
        places = [(_space(other.table), address) for address in _addresses(other)]
        for one in dict.fromkeys(one for place in places for one in at.get(place, ())):
            if _meaning(one) != _meaning(other):
                yield (
                    f"{other.name}: {one.name} is written at the same address "
                    f"with another format, step, access or harmless counts; one of the two is wrong"
                )
        for place in places:
            at.setdefault(place, []).append(other)
    for one in (each for each in written if each.ram_address is not None):
        alias = {(_space(one.table), address + _to_alias(one)) for address in _addresses(one)}
        for other in dict.fromkeys(other for place in alias for other in at.get(place, ())):
            if other.commands:
                yield f"{one.name}: its ram_address is that of {other.name}, which commands the motor"


def _space(table: Table) -> object:
    modbus = table.carrier in (Carrier.BIT, Carrier.WORD)
    return (table.carrier, _SAME_SPACE.get(table.write or 0, table.write)) if modbus else table


def _to_alias(register: Register[Any]) -> int:
    return (register.ram_address or 0) - register.address


def _addresses(register: Register[Any]) -> range:
    return range(register.address, register.address + register.words)


def _meaning(register: Register[Any]) -> object:
    coding = register.coding
    harmless = frozenset(register.harmless or ())
    return register.address, coding.core_format, coding.factors, register.access, register.commands, harmless
