"""Check the attributes and registers of a drive class when the class is defined, with tables of rules."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping
from enum import IntEnum, IntFlag
from fractions import Fraction
from numbers import Real
from typing import Any

from multidrop.core import MOST_INVALID, Framing, NumberFormat
from multidrop.drive.line_settings import LONGEST_SILENCE, Settings
from multidrop.drive.number_format import FLOATS, ORDERS, WORDS, width
from multidrop.drive.register import LANGUAGES, Access, Carrier, Kept, Option, Register, Table
from multidrop.drive.request import LONGEST_INTERVAL, STANDARD_LIMITS, may_be_crossed, read_limit
from multidrop.drive.text import Text
from multidrop.printable import is_whole

LAST_ADDRESS = 0xFFFF
LONGEST_TIME = 60.0  # limit of times in s: a larger number was probably meant in ms
MOST_CHARACTERS = 1000
UNIT_IDS = range(256)  # unit ids on Modbus TCP; a serial line has fewer addresses
EXCEPTION_CODES = range(1, 256)
# Maps the function code that writes one coil or register to the code that writes several.
_SAME_SPACE = {0x05: 0x0F, 0x06: 0x10}
_TAKEN = "reserved name: every drive has an attribute with this name"

# For each attribute of a register: its name, a function that checks the value, and the end of the error
# sentence, which starts with "NAME = VALUE".
Rules = tuple[tuple[str, Callable[[Any], Any], str], ...]


class DeclarationError(ValueError):
    """Raised for a drive class with errors; `mistakes` has a sentence for each, with the register's name."""

    def __init__(self, owner: str, mistakes: Collection[str]) -> None:
        super().__init__("\n".join(f"{owner}.{mistake}" for mistake in mistakes))
        self.mistakes = tuple(mistakes)


# ---- tests of values ----


def _is_a(kind: type | tuple[type, ...]) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, kind)


def _is_real(number: object) -> bool:
    return isinstance(number, Real) and not isinstance(number, bool)


def _is_number(number: object) -> bool:
    return isinstance(number, Real) and not isinstance(number, bool) and math.isfinite(number)


def _is_number_to(most: float) -> Callable[[Any], bool]:
    return lambda value: _is_number(value) and 0 <= value <= most


def _is_truth(value: object) -> bool:
    return value is True or value is False


def _is_sequence(right: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda given: isinstance(given, (tuple, list, range)) and bool(given) and all(map(right, given))


def _is_pair(given: Any, right: Callable[[Any], bool]) -> bool:
    return _is_sequence(right)(given) and len(given) == 2 and bool(given[0] <= given[1])


def _is_set(given: object, right: Callable[[Any], bool]) -> bool:
    return isinstance(given, (tuple, list, range, set, frozenset)) and all(map(right, given))


def _is_mapping(key: Callable[[Any], bool], value: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda given: isinstance(given, Mapping) and all(key(a) and value(b) for a, b in given.items())


def _is_settings(baudrate: Any, format: Any) -> bool:
    try:
        Settings(baudrate, format)
    except (TypeError, ValueError):
        return False
    return True


def _wrong_facts(owner: Any, rules: Rules) -> dict[str, str]:
    """Return an error sentence for each attribute with a wrong value, by the attribute's name."""
    facts = ((name, getattr(owner, name), is_right, rest) for name, is_right, rest in rules)
    return {
        name: f"{name} = {value!r} {rest}" for name, value, is_right, rest in facts if not is_right(value)
    }


# ---- attributes of a class other than its registers ----

_TIMES = {
    "silence": LONGEST_SILENCE,
    "response_delay": LONGEST_TIME,
    "answering_time": LONGEST_TIME,
    "turnaround_delay": LONGEST_TIME,
    "least_interval": LONGEST_INTERVAL,
}
_CHARACTERS = ("silence_characters", "response_delay_characters")
_TEXTS = (
    "model",
    "title",
    "manual",
    "remote",
    "line_terminals",
    "line_parameters",
    "no_broadcasts",
    "watchdog",
)
_TRUTHS = ("answers_every_read", "broadcasts", "has_motor", "identify_recognises")
_CLASS_RULES: Rules = (
    *(
        (name, _is_number_to(most), f"is not a number of s from 0 to {most:g}")
        for name, most in _TIMES.items()
    ),
    *(
        (name, _is_number_to(MOST_CHARACTERS), f"is not a number of characters from 0 to {MOST_CHARACTERS}")
        for name in _CHARACTERS
    ),
    (
        "response_timeout",
        lambda value: _is_number_to(LONGEST_TIME)(value) and value > 0,
        f"is not a number of s above 0, up to {LONGEST_TIME:g}",
    ),
    (
        "addresses",
        _is_sequence(lambda each: is_whole(each) and each in UNIT_IDS),
        "is not a range of addresses, such as range(1, 248)",
    ),
    (
        "baudrates",
        _is_sequence(lambda each: is_whole(each) and _is_settings(each, "8N1")),
        "is not a tuple of baud rates, such as (9600, 19200)",
    ),
    ("framings", _is_sequence(_is_a(Framing)), "is not a tuple of framings, such as (Framing.RTU,)"),
    (
        "formats",
        _is_mapping(_is_a(Framing), _is_sequence(lambda each: _is_settings(9600, each))),
        'is not a mapping, such as {Framing.RTU: ("8N1", "8E1")}',
    ),
    (
        "exceptions",
        _is_mapping(lambda code: is_whole(code) and code in EXCEPTION_CODES, _is_a(str)),
        'is not a mapping of codes, such as {1: "illegal function"}',
    ),
    *(
        (name, lambda given: _is_set(given, is_whole), "is not a set of codes, such as frozenset({6})")
        for name in ("damaged", "later")
    ),
    ("most_registers", _is_mapping(_is_a(Table), _is_a(object)), "is not a mapping, such as {HOLDING: 16}"),
    (
        "readable_gaps",
        _is_mapping(_is_a(Table), _is_a(range)),
        "is not a mapping, such as {HOLDING: range(0, 16)}",
    ),
    *((name, _is_truth, "is neither True nor False") for name in _TRUTHS),
    *((name, _is_a(str), "is not a text") for name in _TEXTS),
    ("setpoint_name", _is_a(str), "is not the name of a register"),
    ("options", _is_a(Mapping), 'is not a mapping, such as {"stop_time": Option("s", (1, 60), "…")}'),
)


def fact_errors(family: Any) -> list[str]:
    """Return an error sentence for each wrong attribute of a drive class, not including its registers."""
    wrong = _wrong_facts(family, _CLASS_RULES)
    is_known = not wrong.keys() & {"formats", "framings"}
    if is_known and family.formats and (first := family.framings[0]) not in family.formats:
        wrong["formats"] = f"formats has no list for {first}, the first framing"
    if "options" not in wrong:
        for name, option in family.options.items():
            if not isinstance(name, str) or not isinstance(option, Option):
                wrong["options"] = (
                    f'options[{name!r}] = {option!r} is not an option, such as Option("s", (1, 60), "…")'
                )
            elif not _is_pair(option.span, _is_number):
                wrong["options"] = (
                    f"options[{name!r}]: span = {option.span!r} is not the smallest and the largest value"
                )
    # A register that replaces such an attribute is reported elsewhere: its name is reserved.
    registers = {*family.registers, *family.texts}
    return [sentence for name, sentence in wrong.items() if name not in registers]


def text_errors(texts: Mapping[str, Text], taken: Collection[str]) -> list[str]:
    """Return an error sentence for each wrong text register of a class; `taken` are the reserved names."""
    found = [f"{name}: {_TAKEN}; rename the text" for name in texts if name in taken]
    return found + [
        f"{name}: this object is already the text {text.name}; declare a new one"
        for name, text in texts.items()
        if text.name != name
    ]


# ---- a register: each attribute by itself ----


def _or_none(right: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: value is None or right(value)


def _is_address(at: object) -> bool:
    return is_whole(at) and at in range(LAST_ADDRESS + 1)


def _is_names(values: object) -> bool:
    return isinstance(values, type) and issubclass(values, (IntEnum, IntFlag))


MOST_COUNTS = MOST_INVALID // 2
_REGISTER_RULES: Rules = (
    ("table", _is_a(Table), "is not a table: HOLDING, INPUT, COIL, DISCRETE or a Table(…)"),
    ("order", lambda value: isinstance(value, str) and value in ORDERS, f"is not one of {', '.join(ORDERS)}"),
    ("number_format", _is_a(NumberFormat), f"is not a NumberFormat: {', '.join(NumberFormat.__members__)}"),
    ("kept", _is_a(Kept), "is not one of Kept.RAM, Kept.EEPROM and Kept.UNKNOWN"),
    ("values", _or_none(_is_names), "is neither a unit nor an IntEnum or IntFlag"),
    (
        "step",
        _or_none(lambda value: _is_number(value) and value != 0),
        "is not a number, such as 0.1; if the manual states none, it is None",
    ),
    ("offset", _is_number, "is not a number, such as -40"),
    (
        "invalid",
        lambda value: _is_set(value, _is_real) and len(value) <= MOST_COUNTS,
        f"is not a tuple of at most {MOST_COUNTS} raw counts, such as (0x7FFF,)",
    ),
    (
        "part",
        _or_none(lambda value: _is_pair(value, is_whole) and value[0] >= 0),
        "is not the lowest and the highest bit, such as (0, 7)",
    ),
    (
        "span",
        _or_none(lambda value: _is_pair(value, _is_number)),
        "is not the smallest and the largest value, such as (0, 50)",
    ),
    ("default", _or_none(_is_number), "is not a number"),
    ("address", _is_address, "is not an address from 0 to FFFFH"),
    ("ram_address", _or_none(_is_address), "is not an address from 0 to FFFFH"),
    *(
        (name, _is_a(str), "is not a text")
        for name in ("unit", "scale_register", "at_least", "at_most", "never", "place", "outside", "note")
    ),
    ("titles", _is_mapping(LANGUAGES.__contains__, _is_a(str)), f"is not texts by {LANGUAGES}"),
    *((name, _or_none(_is_truth), "is neither True nor False") for name in ("while_running", "moves")),
    *(
        (
            name,
            _or_none(lambda value: _is_set(value, is_whole)),
            "is not a tuple of raw counts, such as (0,)",
        )
        for name in ("broadcast", "harmless", "never_together")
    ),
)


# ---- a register: attributes that must fit together ----


def _errors_together(
    register: Register[Any], registers: Mapping[str, Register[Any]], bounds: Collection[str]
) -> Iterator[str]:
    yield from _table_errors(register)
    if _fits_table(register):
        yield from _number_errors(register)
        yield from _written_errors(register)
    for name in filter(None, (register.at_least, register.at_most)):
        other = registers.get(name)
        if name not in bounds and (other is None or not other.readable or other.values is not None):
            yield f"its bound {name} is neither an option nor a register with a readable number"


# Function codes that read bits or 16-bit words, and codes that write them (application protocol V1.1b3, 6).
_READS = {Carrier.BIT: (0x01, 0x02), Carrier.WORD: (0x03, 0x04)}
_WRITES = {Carrier.BIT: (0x05, 0x0F), Carrier.WORD: (0x06, 0x10)}


def _table_errors(register: Register[Any]) -> Iterator[str]:
    """Yield an error sentence if the number format, a function code or the access does not fit the table."""
    table, access = register.table, register.access
    if not _fits_table(register):
        yield f"number_format = NumberFormat.{register.number_format.name} does not fit a {table.name}"
    for verb, code, known in (("read", table.read, _READS), ("write", table.write, _WRITES)):
        if code is not None and table.carrier in known and code not in known[table.carrier]:
            codes = " or ".join(f"{each:02X}H" for each in known[table.carrier])
            yield f"function {code!r} cannot {verb} a {table.carrier.value}: write {codes}"
    name = f"an {table.name}" if table.name[0] in "aeiou" else f"a {table.name}"
    if access is not Access.COMMAND and table.read is None:
        yield f"{name} cannot be read, so it cannot hold a {access.value}"
    if access is not Access.READING and table.write is None and not register.never:
        yield f"{name} cannot be written, so it cannot hold a {access.value}"
    if access is Access.READING and (register.harmless or register.broadcast or register.moves):
        yield "a reading is never written: remove harmless, broadcast and moves"


def _fits_table(register: Register[Any]) -> bool:
    if register.table.carrier is Carrier.WORD:
        return register.number_format in WORDS
    wanted = NumberFormat.BIT if register.table.carrier is Carrier.BIT else NumberFormat.U32
    return register.number_format is wanted


# number formats that allow a register to use only some of the number's bits
_PARTED = frozenset(
    {
        *(NumberFormat.U16, NumberFormat.U32, NumberFormat.U64),
        *(NumberFormat.I16, NumberFormat.I32, NumberFormat.I64),
    }
)
# Attributes that only registers of 16-bit words may set, not coils or discrete inputs, with their defaults.
_OF_WORDS = {"part": None, "invalid": (), "order": "ABCD", "scale_register": ""}


def _number_errors(register: Register[Any]) -> Iterator[str]:
    """Yield an error sentence for each attribute that does not fit the register's number format."""
    number_format, is_reading = register.number_format, register.access is Access.READING
    for name, at in (("address", register.address), ("ram_address", register.ram_address)):
        if at is not None and at + register.words - 1 > LAST_ADDRESS:
            yield f"{name} {at:04X}H: its {register.words} words reach beyond FFFFH"
    if register.ram_address == register.address:
        yield "its ram_address must differ from its address, where writes wear the EEPROM"
    if register.table.carrier is not Carrier.WORD:
        for name, common in _OF_WORDS.items():
            if getattr(register, name) != common:
                yield f"{name} is only for 16-bit registers, and not for a {register.table.name}"
        return
    if register.is_float and register.values is not None:
        names = register.values.__name__
        yield f"number_format = {number_format.name} is for decimal numbers, but {names} names whole numbers"
    if register.order == "BA" and register.words > 1:
        yield f"order = 'BA' is for one word, not for {register.words}: write CDAB, BADC or DCBA"
    if number_format is NumberFormat.I8 and not is_reading:
        yield "a register with number_format = I8 cannot be written: the other byte of its word is unknown"
    if number_format is NumberFormat.U32_EITHER and (register.order != "ABCD" or register.invalid):
        yield "number_format = U32_EITHER has no fixed word order: remove order and invalid"
    if number_format is NumberFormat.U32_EITHER and register.writable:
        yield "number_format = U32_EITHER has no fixed word order, so the register cannot be written"
    if register.part is not None:
        if number_format not in _PARTED:
            yield f"part is for whole numbers, not for number_format = {number_format.name}"
        elif register.part[1] >= width(number_format):
            bits = width(number_format) - 1
            yield f"its part ends at bit {register.part[1]}, but its number has only bits 0 to {bits}"
        if not is_reading:
            yield "a part of a word cannot be written, because other bits would change: declare a reading"
    yield from _invalid_errors(register)
    yield from _name_errors(register)


def _is_flags(register: Register[Any]) -> bool:
    return register.values is not None and issubclass(register.values, IntFlag)


def _counts(register: Register[Any]) -> tuple[Fraction, Fraction]:
    """Return the smallest and the largest raw count of the register."""
    # flags are never negative, even in a signed format: the highest bit may be a named flag
    if _is_flags(register):
        return Fraction(0), Fraction((1 << register.coding.mask.bit_count()) - 1)
    return register.coding.raw_span


def _written_errors(register: Register[Any]) -> Iterator[str]:
    """Yield an error sentence for each declared raw count, default or limit that cannot be written."""
    least, most = _counts(register)
    for key in ("harmless", "broadcast"):
        for count in getattr(register, key) or ():
            if not least <= count <= most:
                yield f"{key} = {count} is not within {least} to {most}, the raw counts of the register"
    for mask in register.never_together:
        if not _is_flags(register):
            yield f"never_together = {mask:04X}H has no effect on bits without names: name the bits"
        elif not 0 < mask <= most:
            yield f"never_together = {mask:X}H is not a mask of the register's bits"
    if register.values is not None:
        return
    lowest, highest = register.span or (-math.inf, math.inf)
    if register.default is not None and not lowest <= register.default <= highest:
        yield f"default = {register.default:g} is outside its span of {lowest:g} to {highest:g}"
    elif register.default is not None and (mistake := _encode_error(register, register.default)):
        yield f"its default is not valid: {mistake}"
    for end in register.span if register.span is not None and register.writable else ():
        if mistake := _encode_error(register, end):
            yield f"an end of its span cannot be written: {mistake}"


def _encode_error(register: Register[Any], value: Any) -> str:
    try:
        register.encode(value)
    except ValueError as mistake:
        return str(mistake)
    return ""


def _invalid_errors(register: Register[Any]) -> Iterator[str]:
    if register.number_format in FLOATS or register.number_format is NumberFormat.U32_EITHER:
        return
    bits = width(register.number_format)
    for count in register.invalid:
        if count != count:
            yield "invalid = nan is for floats, but the register holds a whole number"
        elif not -(1 << bits - 1) <= count < 1 << bits or count != int(count):
            yield f"invalid = {count:g} is not a raw count of {bits} bits"


def _name_errors(register: Register[Any]) -> Iterator[str]:
    """Yield an error sentence for each enumeration member whose number the register cannot hold."""
    if register.values is None or (register.part is not None and register.number_format not in _PARTED):
        return
    least, most = _counts(register)
    for member in register.values:
        if least <= member.value <= most:
            continue
        if _is_flags(register) and member.value > 0 and member.value.bit_count() == 1:
            last = register.coding.mask.bit_count() - 1
            yield f"{member.name} is bit {member.value.bit_length() - 1}, but its register has 0 to {last}"
        else:
            span = f"{least} to {most}, the raw counts of the register"
            yield f"{member.name} = {member.value} is not within {span}"


# ---- registers together ----


def declaration_errors(
    registers: Mapping[str, Register[Any]], taken: Collection[str], bounds: Collection[str]
) -> list[str]:
    """Return an error sentence for each mistake in a class's registers.

    `taken` are the reserved names. `bounds` are the class's options, which may limit a register's values.
    """
    found, sound = [], []
    for name, register in registers.items():
        if name in taken:
            found.append(f"{name}: {_TAKEN}; rename the register")
        if register.name != name:
            found.append(f"{name}: this object is already the register {register.name}; declare a new one")
        wrong = [*_wrong_facts(register, _REGISTER_RULES).values()] or list(
            _errors_together(register, registers, bounds)
        )
        found += [f"{name}: {sentence}" for sentence in wrong]
        if not wrong:
            sound.append(register)
    return [*found, *_sharing_errors(sound)]


def _sharing_errors(registers: list[Register[Any]]) -> Iterator[str]:
    """Yield an error sentence for each pair of registers that write different things to the same address.

    Otherwise a plain write of a setting could start the motor. A reading may share its address.
    """
    written = [one for one in registers if one.access is not Access.READING and one.table.write is not None]
    at: dict[tuple[object, int], list[Register[Any]]] = {}
    for other in written:
        places = [(_space(other.table), address) for address in _addresses(other, other.address)]
        for one in dict.fromkeys(one for place in places for one in at.get(place, ())):
            if _meaning(one) != _meaning(other):
                yield (
                    f"{other.name}: {one.name} is written at the same address "
                    "with another format, step, access or harmless counts; one of the two is wrong"
                )
        for place in places:
            at.setdefault(place, []).append(other)
    for one in written:
        if one.ram_address is None:
            continue
        alias = {(_space(one.table), address) for address in _addresses(one, one.ram_address)}
        for other in dict.fromkeys(other for place in alias for other in at.get(place, ())):
            if other.commands:
                yield f"{one.name}: its ram_address is that of {other.name}, which commands the motor"


def written_places(register: Register[Any]) -> list[tuple[object, int]]:
    """Return the table and the address of each coil or word that a write to this register may change."""
    if register.access is Access.READING:
        return []
    starts = [register.address, *([] if register.ram_address is None else [register.ram_address])]
    return [(_space(register.table), at) for start in starts for at in _addresses(register, start)]


def _space(table: Table) -> object:
    modbus = table.carrier in (Carrier.BIT, Carrier.WORD)
    return (table.carrier, _SAME_SPACE.get(table.write or 0, table.write)) if modbus else table


def _addresses(register: Register[Any], start: int) -> range:
    return range(start, start + register.words)


def _meaning(register: Register[Any]) -> object:
    coding = register.coding
    harmless = frozenset(register.harmless or ())
    return register.address, coding.core_format, coding.factors, register.access, register.commands, harmless


# ---- requests: scale registers, limits, registers that are read together ----


def request_errors(family: Any) -> list[str]:
    """Link registers to their scale registers; return the errors in scales, limits and groups."""
    wrong = list(_scale_errors(family)) or list(_limit_errors(family))
    if wrong:
        return wrong
    seen: set[str] = set()
    for group in family.read_together:
        wrong += _group_errors(family, group, seen)
        seen.update(name for name in group if isinstance(name, str))
    return wrong


def _scale_errors(family: Any) -> Iterator[str]:
    for name, register in family.registers.items():
        if not register.scale_register:
            continue
        wrong = list(_tie_errors(register, family.registers))
        if not wrong:
            object.__setattr__(register, "scaled_by", family.registers[register.scale_register])
            vars(register).pop("reach", None)
            wrong = list(_reach_errors(register, family))
        yield from (f"{name}: {sentence}" for sentence in wrong)


def _tie_errors(register: Register[Any], registers: Mapping[str, Register[Any]]) -> Iterator[str]:
    scale = registers.get(register.scale_register)
    if scale is None:
        yield f"its scale register {register.scale_register} is not declared"
        return
    if scale.number_format is not NumberFormat.I16 or not scale.readable:
        yield f"its scale register {scale.name} must be a readable I16, because it holds a power of ten"
    elif scale.part or scale.offset or scale.step != 1 or scale.scale_register or scale.values:
        yield f"its scale register {scale.name} must be a plain count, because it holds a power of ten"
    if scale.table.read_space != register.table.read_space:
        yield f"its scale register {scale.name} must be in the same table, because one request reads both"
    if register.access is not Access.READING:
        yield "a register with a scale register cannot be written: the device may change the scale"
    if register.values is not None or register.offset:
        yield "a register with a scale register cannot have names or an offset"
    if register.scaled_by not in (None, scale):
        yield f"its scale register {scale.name} was declared again: also declare this register again"


def _reach_errors(register: Register[Any], family: Any) -> Iterator[str]:
    limit = read_limit(family, register.table)
    if len(register.reach) > limit:
        shown = f"{len(register.reach)} registers with its scale register {register.scale_register}"
        yield f"one request reads at most {limit} registers, but these are {shown}"
        return
    own = {*_addresses(register, register.address), register.scaled_by and register.scaled_by.address}
    between = (address for address in register.reach if address not in own)
    unknown = [address for address in between if not may_be_crossed(family, register.table, [address])]
    if unknown:
        yield (
            f"address {unknown[0]:04X}H between it and its scale register {register.scale_register} is not "
            "declared: declare it, or the gap in readable_gaps"
        )


def _limit_errors(family: Any) -> Iterator[str]:
    for table, most in family.most_registers.items():
        standard = STANDARD_LIMITS[table.carrier]
        if not is_whole(most) or not 1 <= most <= standard:
            yield f"most_registers[{table.name}] = {most!r} is not a number from 1 to {standard}"
    groups = family.read_together
    if not isinstance(groups, (tuple, list)) or not all(isinstance(group, (tuple, list)) for group in groups):
        yield f'read_together = {groups!r} is not a tuple of groups, such as (("energy_high", "energy_low"),)'


def _group_errors(family: Any, group: Collection[Any], seen: Collection[str]) -> Iterator[str]:
    shown = f"read_together: {', '.join(map(str, group))}"
    known = [family.registers.get(name) for name in group if isinstance(name, str)]
    registers = [register for register in known if register is not None and register.readable]
    if not registers or len(registers) < len(group):
        yield f"{shown}: each must be the name of a readable register"
        return
    if again := {*seen} & {*group}:
        yield f"{shown}: {', '.join(sorted(again))} is in another group too; merge the two groups"
    table = registers[0].table
    if any(register.table.read_space != table.read_space for register in registers):
        yield f"{shown}: these registers must be in one table, because one request reads them"
        return
    start = min(register.reach.start for register in registers)
    stop = max(register.reach.stop for register in registers)
    longest, limit = max(len(register.reach) for register in registers), read_limit(family, table)
    if stop - start > max(limit, longest):
        yield f"{shown}: these registers span {stop - start} addresses, but one request reads at most {limit}"
    elif not may_be_crossed(family, table, range(start, stop)):
        yield (
            f"{shown}: there are undeclared addresses between these registers; "
            "declare them in readable_gaps if one request may read across them"
        )
