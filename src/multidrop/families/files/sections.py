"""Parse the sections of a family file that declare no registers.

These are [family], [option], [text], [parameters] and [[identify]].
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from math import inf
from typing import Any

from multidrop.core import Framing
from multidrop.drive.declaration_check import UNIT_IDS
from multidrop.drive.family import TAKEN_NAMES, Drive
from multidrop.drive.line_settings import BAUDRATES, FORMAT, LONGEST_SILENCE, Settings
from multidrop.drive.parameters import ParameterGroup, ParameterSpace
from multidrop.drive.register import Option, Register, Table
from multidrop.drive.request import LONGEST_INTERVAL, STANDARD_LIMITS
from multidrop.drive.text import Text, text
from multidrop.drive.verbs import Script, read, verb
from multidrop.errors import WriteForbidden
from multidrop.families.files.notation import TABLES, Counting
from multidrop.families.files.registers import ADDRESS, BESIDE, FINITE, WRITES, converted, shown, unusable
from multidrop.printable import is_number, is_whole
from multidrop.toml_check import ASCENDING, Key, TomlPlace, duration_of, duration_up_to, json_schema

MOST_TOGETHER = {name: STANDARD_LIMITS[table.carrier] for name, table in TABLES.items()}
_FORMATS = {"type": "array", "minItems": 1, "items": {"type": "string", "pattern": f"^{FORMAT}$"}}
_HEX_CODE = "0*[1-9A-Fa-f][0-9A-Fa-f]?"
_CODE = f"^([1-9][0-9]?|1[0-9]{{2}}|2[0-4][0-9]|25[0-5]|0[xX]{_HEX_CODE}|{_HEX_CODE}[hH])$"
_PAIR = {"minItems": 2, "maxItems": 2, **ASCENDING}
_STRINGS = {"items": {"type": "string"}}

FAMILY_KEYS = {
    "title": Key(str, 'title = "Eastron SDM630"', needed=True),
    "manual": Key(str, 'manual = "SDM630 Modbus protocol, version 2"', needed=True),
    "counts_from": Key(
        int,
        "counts_from = 0, or 1 where the manual's register 1 is sent as 0",
        keywords={"enum": [0, 1]},
    ),
    "addresses": Key(
        list,
        "addresses = [1, 247]",
        keywords={
            "items": {"type": "integer", "minimum": UNIT_IDS[0], "maximum": UNIT_IDS[-1]},
            **_PAIR,
        },
    ),
    "baudrates": Key(
        list,
        "baudrates = [9600, 19200]",
        keywords={"items": {"type": "integer", "minimum": BAUDRATES[0], "maximum": BAUDRATES[1]}},
    ),
    "formats": Key(
        (list, dict),
        'formats = ["8N1", "8E1"], or { rtu = ["8N1"], ascii = ["7E1"] }',
        keywords={
            "anyOf": [
                _FORMATS,
                {
                    "type": "object",
                    "properties": {"rtu": _FORMATS, "ascii": _FORMATS},
                    "additionalProperties": False,
                },
            ]
        },
    ),
    "framings": Key(
        list, 'framings = ["rtu"]', keywords={"items": {"enum": ["rtu", "ascii", "RTU", "ASCII"]}}
    ),
    "together": Key(
        dict,
        "together = { holding = 80, input = 80 }",
        keywords={
            "properties": {
                name: {"type": "integer", "minimum": 1, "maximum": most}
                for name, most in MOST_TOGETHER.items()
            },
            "additionalProperties": False,
        },
    ),
    "gaps": Key(
        dict,
        "gaps = { input = [0x0000, 0x017F] }",
        keywords={
            "properties": {name: {"type": "array", "items": ADDRESS, **_PAIR} for name in TABLES},
            "additionalProperties": False,
        },
    ),
    "read_together": Key(
        list,
        'read_together = [["energy_high", "energy_low"]]',
        keywords={"items": {"type": "array", "minItems": 1, **_STRINGS}},
    ),
    "silence": Key(str, 'silence = "5 ms"', keywords=duration_up_to(0)),
    "least_interval": Key(str, 'least_interval = "100 ms"', keywords=duration_up_to(1)),
    "response_delay": Key(str, 'response_delay = "10 ms"', keywords=duration_up_to(1)),
    "response_timeout": Key(str, 'response_timeout = "500 ms"', keywords=duration_up_to(1)),
    "turnaround_delay": Key(str, 'turnaround_delay = "100 ms"', keywords=duration_up_to(1)),
    "motor": Key(bool, "motor = false, if the device has no motor"),
    "remote": Key(str, 'remote = "F0-02 must be 2"'),
    "line_parameters": Key(str, 'line_parameters = "F8-00 baud rate, F8-02 address"'),
    "watchdog": Key(str, 'watchdog = "F8-04: stops after 5 s without a request; off from the factory"'),
    "exceptions": Key(
        dict,
        'exceptions = { 1 = "illegal function", 0x80 = "locked" }',
        keywords={"propertyNames": {"pattern": _CODE}, "additionalProperties": {"type": "string"}},
    ),
    "write": Key(str, 'write = "single" (function 06H) or "multiple" (10H)', keywords={"enum": [*WRITES]}),
    "registers": Key(list, 'registers = ["meter.csv"]', keywords={"items": BESIDE}),
    "profile": Key(str, 'profile = "profidrive"'),
    "extends": Key(str, 'extends = "innovert-ibd", a built-in family whose registers and verbs it has too'),
    "note": Key(str, 'note = "Further facts."'),
}
_TEXTS = {"title": "title", "manual": "manual", "remote": "remote", "watchdog": "watchdog"}
_TEXTS |= {"motor": "has_motor", "line_parameters": "line_parameters", "note": "__doc__"}
_DURATIONS = ("silence", "least_interval", "response_delay", "response_timeout", "turnaround_delay")
# limits in s of the drive's pauses, because a stop of another drive may have to wait as long
LONGEST_WAIT = 10.0
_LONGEST = {"silence": LONGEST_SILENCE, "least_interval": LONGEST_INTERVAL}


def facts_of(given: Mapping[str, Any], counting: Counting, place: TomlPlace) -> dict[str, Any]:
    """Return class attributes from the section [family]. Wrong values are reported at `place`."""
    facts: dict[str, Any] = {_TEXTS[key]: given[key] for key in _TEXTS if key in given}
    for key in _DURATIONS:
        seconds = duration_of(given, key, place)
        most = _LONGEST.get(key, LONGEST_WAIT)
        if seconds is not None and seconds > most:
            place.wrong(f"{key} = {given[key]!r} is more than {most:g} s; write {FAMILY_KEYS[key].example}")
        elif seconds is not None:
            facts[key] = seconds
    for key, make in _MAKERS.items():
        if key in given and (made := place.attempt(_made, make, key, given[key])) is not None:
            facts[key] = made
    facts |= _by_table(given, counting, place)
    if "formats" in facts:
        facts["formats"] = _by_framing(facts["formats"], facts.get("framings", (Framing.RTU,)), place)
    if given.get("write", WRITES[0]) not in WRITES:
        place.wrong(f"write = {given['write']!r} is not right; write {FAMILY_KEYS['write'].example}")
    return facts


def _made(make: Callable[[Any], Any], key: str, value: Any) -> Any:
    try:
        return make(value)
    except ValueError as mistake:
        raise ValueError(f"{key} = {shown(value)}: {mistake}; write {FAMILY_KEYS[key].example}") from None


def _unit_addresses(value: list[Any]) -> range:
    least, most = UNIT_IDS[0], UNIT_IDS[-1]
    if len(value) != 2 or not all(map(is_whole, value)) or not least <= value[0] <= value[1] <= most:
        raise ValueError(
            f"a range has a first and a last address from 1 to 247 ({least} to {most} on Modbus TCP)"
        )
    return range(value[0], value[1] + 1)


def _baudrates(value: list[Any]) -> tuple[int, ...]:
    for each in value:
        if not is_whole(each):
            raise ValueError(f"{shown(each)} is not a baud rate")
        Settings(each, "8N1")
    return tuple(dict.fromkeys(value))


def _formats(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _formats(formats) for name, formats in value.items()}
    if not isinstance(value, list) or not value:
        raise ValueError(f"{shown(value)} is not a list of formats")
    for each in value:
        if not isinstance(each, str):
            raise ValueError(f"{shown(each)} is not a format")
        Settings(9600, each)
    return tuple(dict.fromkeys(value))


def _by_framing(formats: Any, framings: tuple[Framing, ...], place: TomlPlace) -> dict[Framing, Any]:
    """Return the character formats of each framing; RTU needs 8 data bits."""
    found = dict.fromkeys(framings, formats)
    if isinstance(formats, dict):
        named = {str(framing): framing for framing in framings}
        for name in [name for name in formats if name not in named]:
            place.wrong(f"formats has {name!r}, which is not one of the framings {', '.join(named)}")
        for name in [name for name in named if name not in formats]:
            place.wrong(f'formats has no list for {name}; add {name} = ["8N1"]')
        found = {framing: formats.get(name, ("8N1",)) for name, framing in named.items()}
    for format in found.get(Framing.RTU, ()):
        if format[0] != "8":
            place.wrong(f'formats has "{format}", but an RTU frame needs 8 data bits; write "8{format[1:]}"')
    return found


def _framings(value: list[Any]) -> tuple[Framing, ...]:
    known = {str(framing): framing for framing in (Framing.RTU, Framing.ASCII)}
    wrong = [each for each in value if not isinstance(each, str) or each.lower() not in known]
    if wrong:
        raise ValueError(f"{shown(wrong[0])} is not one of {', '.join(known)}")
    return tuple(dict.fromkeys(known[each.lower()] for each in value))


def _exceptions(value: dict[str, Any]) -> dict[int, str]:
    found = {}
    for code, meaning in value.items():
        digits = code[:-1] if code[-1:] in ("h", "H") else code
        try:
            number = int(digits, 16 if digits != code else 0) if code.isalnum() and code.isascii() else 0
        except ValueError:
            raise ValueError(f"{code!r} is not an exception code") from None
        if not 1 <= number <= 255 or not isinstance(meaning, str) or not meaning.isprintable():
            raise ValueError(f"{code} = {shown(meaning)} is not an exception code from 1 to 255 with a text")
        found[number] = meaning
    return found


def _read_together(value: list[Any]) -> tuple[tuple[str, ...], ...]:
    for group in value:
        if not isinstance(group, list) or not group or not all(isinstance(name, str) for name in group):
            raise ValueError(f"{shown(group)} is not a list of registers' names")
    return tuple(map(tuple, value))


_MAKERS: Mapping[str, Callable[[Any], Any]] = {
    "addresses": _unit_addresses,
    "baudrates": _baudrates,
    "formats": _formats,
    "framings": _framings,
    "exceptions": _exceptions,
    "read_together": _read_together,
}


def _by_table(given: Mapping[str, Any], counting: Counting, place: TomlPlace) -> dict[str, Any]:
    """Return, by table, the limit of registers in one read and the reserved addresses that it may include."""
    most: dict[Table, int] = {}
    gaps: dict[Table, range] = {}
    for key in ("together", "gaps"):
        for table, value in given.get(key, {}).items():
            if table not in TABLES:
                place.wrong(f"{key} has {table!r}, which is not a register table; write {', '.join(TABLES)}")
            elif key == "together":
                if is_whole(value) and 1 <= value <= MOST_TOGETHER[table]:
                    most[TABLES[table]] = value
                else:
                    most_of = f"1 to {MOST_TOGETHER[table]}"
                    place.wrong(
                        f"together: {table} = {shown(value)} is not a number of registers from {most_of}"
                    )
            elif (span := place.attempt(_gap, table, value, counting)) is not None:
                gaps[TABLES[table]] = span
    named: dict[str, Any] = {"most_registers": most, "readable_gaps": gaps}
    return {key: value for key, value in named.items() if value}


def _gap(table: str, value: Any, counting: Counting) -> range | None:
    if not isinstance(value, list) or len(value) != 2:
        raise ValueError(f"gaps: {table} = {shown(value)} is not a list of a first and a last address")
    try:
        first, last = (counting.address(end, table, table)[0] for end in value)
    except ValueError as mistake:
        raise ValueError(f"gaps: {table}: {mistake}") from None
    if first > last:
        raise ValueError(f"gaps: {table} = {shown(value)} is in the wrong order: give the lowest first")
    return range(first, last + 1)


OPTION_KEYS = {
    "unit": Key(str, 'unit = "Hz"'),
    "span": Key(list, "span = [1, 600]", needed=True, keywords={"items": {"type": "number"}, **_PAIR}),
    "meaning": Key(str, 'meaning = "parameter 1105, of which 20000 is 100 %"', needed=True),
}
# Names that an option must not have, because they are keys of a drive in a plant file.
NOT_OPTIONS = frozenset(
    {"name", "model", "address", "framing", "baudrate", "format", "silence", "ram", "every", "poll"}
    | {"channel", "confirmed"}
)


def options_of(table: Any, registers: Collection[str], place: TomlPlace) -> dict[str, Option]:
    """Return the options that the section [option] declares. Mistakes are reported at `place`."""
    if not isinstance(table, dict):
        place.wrong("[option] is not a table; write [option] and NAME = { unit, span, meaning }", "option")
        return {}
    options = {}
    for name, given in table.items():
        at = place.within(f"[option] {name[:60]}", "option", name)
        why = unusable(name)
        if why or name in NOT_OPTIONS:
            reason = why or "reserved name: every drive has an attribute with this name"
            at.wrong(f"{shown(name)} cannot be an option's name: {reason}")
        if name in registers:
            at.wrong("a register has the same name; rename one of the two")
        good = at.check(given, OPTION_KEYS)
        span = good.get("span", [])
        if span and (
            len(span) != 2 or not all(is_number(end) and abs(end) < inf for end in span) or span[0] > span[1]
        ):
            at.wrong(
                f"span = {shown(span)} is not right; write the smallest and largest value: span = [1, 600]"
            )
        elif span and "meaning" in good:
            options[name] = Option(good.get("unit", ""), (span[0], span[1]), good["meaning"])
    return options


MOST_TEXTS = 100
TEXT_KEYS = {
    "at": Key((int, str), 'at = 0xFC00, 8192, "2000H" or "40001"', needed=True, keywords=ADDRESS),
    "length": Key(
        int,
        "length = 8, registers of two characters",
        needed=True,
        keywords={"minimum": 1, "maximum": MOST_TOGETHER["holding"]},
    ),
    "table": Key(str, 'table = "input"', keywords={"enum": ["holding", "input"]}),
    "order": Key(
        str, 'order = "BA", where the second character comes first', keywords={"enum": ["AB", "BA", "B"]}
    ),
    "place": Key(str, 'place = "table 9"'),
}


def texts_of(
    section: Any, counting: Counting, registers: Mapping[str, TomlPlace], place: TomlPlace
) -> dict[str, Text]:
    """Return the text registers that the section [text] declares, by name.

    Mistakes are reported at `place`.
    """
    if not isinstance(section, dict):
        place.wrong("[text] is not a table; write [text] and NAME = { at = 0xFC00, length = 8 }", "text")
        return {}
    if len(section) > MOST_TEXTS:
        place.wrong(f"[text] has {len(section)} texts, more than the allowed {MOST_TEXTS}")
        return {}
    found: dict[str, Text] = {}
    for name, given in section.items():
        at = place.within(f"[text] {name[:60]}", "text", name)
        why = unusable(name)
        if why:
            at.wrong(f"{shown(name)} cannot be a text's name: {why}")
        elif name in TAKEN_NAMES:
            at.wrong("reserved name: every drive has an attribute with this name; rename the text")
        elif name in registers:
            at.wrong("a register has the same name; rename one of the two")
        declared = _text(at.check(given, TEXT_KEYS), counting, at)
        if declared is not None and not why and name not in TAKEN_NAMES:
            found[name] = declared
    return found


def _text(good: dict[str, Any], counting: Counting, place: TomlPlace) -> Text | None:
    if not {"at", "length"} <= good.keys():
        return None
    given = place.attempt(converted, "table", good["table"]) if "table" in good else None
    address = place.attempt(counting.address, good["at"], given, "holding")
    if address is None:
        return None
    details = {key: good[key] for key in ("order", "place") if key in good}

    def make() -> Text:
        return text(address[0], good["length"], table=TABLES[address[1]], **details)

    return place.attempt(make)


MOST_PARAMETERS = 10_000
_ADDRESSES = 0x10000
GROUP_KEYS = {
    "code": Key(str, 'code = "P00.", the part of a code before its last digits', needed=True),
    "at": Key((int, str), 'at = "0000H", the address of the index 0', needed=True, keywords=ADDRESS),
    "count": Key(
        int,
        "count = 30, the last index plus 1",
        needed=True,
        keywords={"minimum": 1, "maximum": MOST_PARAMETERS},
    ),
    "digits": Key(int, "digits = 2, of the index"),
}
PARAMETER_KEYS = {
    "groups": Key(
        list,
        'groups = [{ code = "P00.", at = "0000H", count = 30 }]',
        needed=True,
        keywords={"items": json_schema(GROUP_KEYS)},
    ),
    "monitors": Key(
        list, 'monitors = ["P17.*"], codes of values that the drive changes itself', keywords=_STRINGS
    ),
    "line": Key(list, 'line = ["P14.02", "P14.01", "P14.00"], in the order of writing', keywords=_STRINGS),
    "passwords": Key(list, 'passwords = ["P07.00"]', keywords=_STRINGS),
    "never": Key(
        dict,
        'never = { "P00.18" = "it restores the factory values" }',
        keywords={"additionalProperties": {"type": "string"}},
    ),
    "firmware": Key(str, 'firmware = "software_version", a register'),
}


def parameter_space_of(
    section: Any, counting: Counting, registers: Collection[str], place: TomlPlace
) -> ParameterSpace | None:
    """Return the address rule that the section [parameters] declares; None if it has a mistake."""
    at = place.within("[parameters]", "parameters")
    good = at.check(section, PARAMETER_KEYS)
    groups = [
        _group(table, counting, within)
        for table, within in at.inside("group", good.get("groups", []), "groups")
    ]
    kept = [group for group in groups if group is not None]
    if sum(len(group.indices) for group in kept) > MOST_PARAMETERS:
        at.wrong(f"groups have more than {MOST_PARAMETERS} parameter codes in all")
        return None
    lists = {name: tuple(good.get(name, ())) for name in ("monitors", "line", "passwords")}
    never = good.get("never", {})
    for name, values in {**lists, "never": (*never, *never.values())}.items():
        if not all(isinstance(value, str) for value in values):
            at.wrong(f"{name} = {shown([*values])} is not right; write {PARAMETER_KEYS[name].example}")
            return None
    firmware = good.get("firmware", "")
    if firmware and firmware not in registers:
        at.wrong(f"firmware = {firmware!r} is not the name of a register in this file")
    return ParameterSpace(
        tuple(kept),
        monitors=lists["monitors"],
        line=lists["line"],
        passwords=lists["passwords"],
        never=never,
        firmware=firmware,
    )


def _group(table: Any, counting: Counting, place: TomlPlace) -> ParameterGroup | None:
    good = place.check(table, GROUP_KEYS)
    address = place.attempt(counting.address, good["at"], None, "holding") if "at" in good else None
    if address is None or not {"code", "count"} <= good.keys():
        return None
    if not 1 <= good["count"] <= _ADDRESSES - address[0]:
        place.wrong(f"count = {good['count']} is not right; write {GROUP_KEYS['count'].example}")
        return None
    return ParameterGroup(good["code"], address[0], range(good["count"]), good.get("digits", 2))


MOST_PROOFS = 20
PROOF_KEYS = {
    "register": Key(str, 'register = "device"', needed=True),
    "is": Key(list, "is = [0x010A]", keywords={"items": {"type": "number"}}),
    "above": Key((int, float), "above = 71.5", keywords=FINITE),
    "below": Key((int, float), "below = 76.5", keywords=FINITE),
}


@dataclass(frozen=True)
class Proof:
    """A register that identifies the family by a value between `above` and `below`, in `values` if any."""

    register: str
    values: tuple[float, ...]  # accepted values; empty: every value in the range is accepted
    above: float
    below: float

    @property
    def example(self) -> float:
        """One of the accepted values, used by simulated drives."""
        if self.values:
            return self.values[0]
        ends = [end for end in (self.above, self.below) if abs(end) < inf]
        return sum(ends) / 2 if len(ends) == 2 else ends[0] + (1 if self.below == inf else -1)

    def holds(self, value: float) -> bool:
        return self.above < value < self.below and (not self.values or value in self.values)


def proofs_of(section: Any, registers: Mapping[str, Register[Any]], place: TomlPlace) -> tuple[Proof, ...]:
    """Return the registers that identify the family, from the valid [[identify]] tables."""
    tables = section if isinstance(section, list) else [section]
    if len(tables) > MOST_PROOFS:
        place.wrong(f"[[identify]] has {len(tables)} tables, more than the allowed {MOST_PROOFS}")
        return ()
    found = (_proof(table, registers, at) for table, at in place.inside("identify", tables))
    return tuple(proof for proof in found if proof is not None)


def _proof(table: Any, registers: Mapping[str, Register[Any]], place: TomlPlace) -> Proof | None:
    before = len(place.config_errors)
    good = place.check(table, PROOF_KEYS)
    name, values = good.get("register"), good.get("is", [])
    if name is None:
        return None
    if name not in registers or not registers[name].readable:
        place.wrong(f"register = {name!r} is not the name of a readable register in this file")
        return None
    if not all(map(is_number, values)):
        place.wrong(f"is = {values!r} is not right; write {PROOF_KEYS['is'].example}")
        return None
    if not good.keys() & {"is", "above", "below"}:
        # a key that is misspelt or has a wrong value was reported above
        if len(place.config_errors) == before:
            place.wrong("has no expected value; add is = [0x010A], or the keys above and below")
        return None
    proof = Proof(name, tuple(values), good.get("above", -inf), good.get("below", inf))
    if why := _proves_nothing(proof, registers[name]):
        place.wrong(f"{why}; give values of {name} that other drives do not have")
        return None
    return proof


def _proves_nothing(proof: Proof, register: Register[Any]) -> str:
    """Return why this proof accepts every device, or none; "" if it accepts only some."""
    if register.scale_register:  # its values depend on another register
        return ""
    coding = register.coding
    least, most = sorted(float(end * register.scale + coding.offset) for end in coding.raw_span)
    values = [value for value in proof.values if least <= value <= most and proof.holds(value)]
    if not (proof.above < proof.below and proof.above < most and proof.below > least):
        return "no value of the register is within these limits"
    if proof.values and not values:
        return f"is = {shown([*proof.values])} has no value that the register can hold within the limits"
    return "" if proof.values or proof.above >= least or proof.below <= most else "every value is accepted"


@verb
def identify(self: Drive) -> Script[None]:
    """Read the registers in [[identify]]. Raises WriteForbidden if one has another value."""
    for proof in self.identity_proofs:
        register = self.register(proof.register)
        value = yield from read(register)
        if not proof.holds(value):
            shown = f"{register.name} = {register.format(value)}"
            raise WriteForbidden(
                f"{self.name} shows {shown}, so it is not a {self.title or type(self).__name__}"
            )
