"""The JSON Schema of a family file, generated from the keys that the loader checks."""

from __future__ import annotations

import keyword
import re
from collections.abc import Iterable, Mapping, Sequence
from string import ascii_lowercase, digits
from typing import Any

from multidrop.core import NumberFormat
from multidrop.drive.declaration_check import written_places
from multidrop.drive.family import TAKEN_NAMES, Drive
from multidrop.drive.number_format import FLOATS, WORDS, raw_span, width
from multidrop.drive.register import Access, setting
from multidrop.families.files.loader import MOST_CSV_FILES, SECTIONS, bases
from multidrop.families.files.notation import DIGIT_OF_TABLE, LAST_ADDRESS
from multidrop.families.files.registers import (
    ACCESSES,
    DEFAULT_KEYS,
    LONGEST_NAME,
    MOST_BITS,
    MOST_REGISTERS,
    NAME,
    REGISTER_KEYS,
)
from multidrop.families.files.sections import (
    FAMILY_KEYS,
    MOST_PROOFS,
    MOST_TEXTS,
    NOT_OPTIONS,
    OPTION_KEYS,
    PARAMETER_KEYS,
    PROOF_KEYS,
    TEXT_KEYS,
)
from multidrop.families.profiles import PROFILES, Profile, Role
from multidrop.toml_check import DRAFT, ascending, distinct, json_schema

_NEVER_WRITTEN = ("harmless", "broadcast")  # keys that a register in the section [reading] cannot have
_WRITTEN = [access.value for access in Access if access is not Access.READING]  # sections
_FORBIDDEN: dict[str, Any] = {"not": {}}


def family_schema(tables: Sequence[str] = ()) -> dict[str, Any]:
    """Return the JSON Schema of a family file.

    `tables` are the names of CSV files that the key `registers` may have; empty: any name.
    """
    proof = json_schema(PROOF_KEYS, anyOf=[{"required": [key]} for key in ("is", "above", "below")])
    proofs = {"type": "array", "minItems": 1, "maxItems": MOST_PROOFS, "items": proof}
    of_words = [_without_addresses(_numbered("01"))]
    sections = {
        "family": _facts(tables),
        "default": _table({key: REGISTER_KEYS[key].schema for key in DEFAULT_KEYS}),
        **{
            name: _named(_of_access(access), TAKEN_NAMES, MOST_REGISTERS) for name, access in ACCESSES.items()
        },
        "text": _named(json_schema(TEXT_KEYS, allOf=of_words), TAKEN_NAMES, MOST_TEXTS),
        "option": _named(json_schema(OPTION_KEYS), NOT_OPTIONS),
        "parameters": json_schema(PARAMETER_KEYS),
        "identify": {"anyOf": [proof, proofs]},
    }
    declaring = [{"required": [name]} for name in (*ACCESSES, "text")]
    return {
        "$schema": DRAFT,
        "title": "multidrop family file",
        "definitions": {
            "ascending": ascending(),
            **distinct(),
            **_references(),
            "register": _register(),
            **{one.name: _of_format(one) for one in WORDS},
            **{f"roles-{name}": _of_roles(profile.roles) for name, profile in PROFILES.items()},
        },
        **_table({name: sections[name] for name in SECTIONS}),
        "required": ["family"],
        "anyOf": [*declaring, _says("registers")],
        "allOf": [
            *_by_default(),
            *_counting(),
            {
                "if": {"not": {"anyOf": [*map(_says, _MORE_NAMES)]}},
                "then": {"$ref": "#/definitions/references"},
            },
            *(_extending(name, base) for name, base in bases("extends").items()),
            *(_with_profile(name, profile.roles) for name, profile in PROFILES.items()),
        ],
    }


def _says(key: str, *values: object) -> dict[str, Any]:
    """Return a schema for files whose section [family] has this key, with one of `values` if given."""
    value = {"properties": {key: {"enum": [*values]}}} if values else {}
    return {"properties": {"family": {"type": "object", "required": [key], **value}}, "required": ["family"]}


def _each(entry: dict[str, Any], sections: Iterable[str] = ACCESSES) -> dict[str, Any]:
    """Return a schema that applies the schema `entry` to each register or text in these sections."""
    return {"properties": {name: {"additionalProperties": entry} for name in sections}}


# ---- names of registers ----


# keys of the section [family] that add registers or options
_MORE_NAMES = ("registers", "extends", "profile")
# keys whose value is the name of a register, or of an option
_REFERENCES = "^(register|firmware|scale_register|at_least|at_most)$"


def _references() -> dict[str, Any]:
    """Return the schema of keys such as `at_most`, whose value is the name of a register or an option.

    A JSON Schema cannot look up a name, but it can match names against patterns. Each pattern matches the
    names of one length, or the names with one character at the start, second, last but one or at the end. A
    value is refused if it matches a pattern that no register or option of the file matches. So every existing
    name is accepted, and many misspelt names are refused.
    """
    letters = [f"[{small}{small.upper()}]" for small in ascii_lowercase]
    characters = [*letters, "_", *digits]
    patterns = [form.format(one) for form in ("^{}", "^.{}", "{}$", "{}.$") for one in characters]
    patterns += [f"^.{{{length}}}$" for length in range(1, LONGEST_NAME + 1)]
    parts: dict[str, Any] = {}
    for number, pattern in enumerate(patterns):
        other = {"$ref": f"#/definitions/other-{number}"}
        referring: dict[str, Any] = {"patternProperties": {_REFERENCES: other}}
        # the registers of a section such as [reading], and the entries of a list such as [[identify]]
        entries = {"additionalProperties": referring, "items": referring}
        parts[f"other-{number}"] = {"not": {"type": "string", "pattern": pattern}}
        parts[f"reference-{number}"] = {
            "if": {"patternProperties": {f"^({'|'.join([*ACCESSES, 'option'])})$": {"propertyNames": other}}},
            "then": {"additionalProperties": {**referring, **entries}},
        }
    rules = [{"$ref": f"#/definitions/{name}"} for name in parts if name.startswith("reference")]
    return {"references": {"allOf": rules}, **parts}


# ---- addresses ----


def _counting() -> list[dict[str, Any]]:
    """Return the parts of the schema for the addresses of a file; they depend on the key `counts_from`."""

    def addresses(right: dict[str, Any]) -> dict[str, Any]:
        gaps = {"properties": {"gaps": {"additionalProperties": {"items": right}}}}
        groups = {"properties": {"groups": {"items": {"properties": {"at": right}}}}}
        registers = _each({"properties": {"at": right, "ram_address": right}}, (*ACCESSES, "text"))
        return {"allOf": [registers, {"properties": {"family": gaps, "parameters": groups}}]}

    return [
        {"if": {"not": _says("counts_from")}, "then": addresses(_numbered("0134"))},
        {"if": _says("counts_from", 0), "then": addresses({"not": _addresses([LAST_ADDRESS + 1])})},
        {"if": _says("counts_from", 1), "then": addresses({"not": _addresses([0])})},
    ]


def _addresses(numbers: Iterable[int]) -> dict[str, Any]:
    """Return a schema that allows these addresses, as numbers or as hex text."""
    numbers = [*numbers]
    digits = "|".join(re.sub("[A-F]", lambda one: f"[{one[0]}{one[0].lower()}]", f"{n:X}") for n in numbers)
    pattern = rf"^\s*(0[xX]0*({digits})|0*({digits})[hH])\s*$"
    return {"anyOf": [{"enum": numbers}, {"type": "string", "pattern": pattern}]}


def _without_addresses(*invalid: dict[str, Any]) -> dict[str, Any]:
    right = {"not": {"anyOf": [*invalid]}}
    return {"properties": {"at": right, "ram_address": right}}


def _ambiguous(table: str) -> dict[str, Any]:
    """Return the schema of addresses such as 40002, which may also mean the second register of a table."""
    first = int(DIGIT_OF_TABLE[table]) * 10_000
    return {"type": "integer", "minimum": first, "maximum": first + 9_999} if first else {"not": {}}


def _numbered(digits: str) -> dict[str, Any]:
    """Return the schema of addresses such as "40001" whose first digit, one of `digits`, names a table."""
    return {"type": "string", "pattern": rf"^\s*[{digits}]([0-9]{{4}}|[0-9]{{5}})\s*$"}


def _addresses_of(table: str) -> dict[str, Any]:
    """Return a schema that checks the addresses of registers whose key `table` is this table."""
    others = "".join(digit for name, digit in DIGIT_OF_TABLE.items() if name != table)
    return {
        "if": {"properties": {"table": {"enum": [table, table.upper()]}}, "required": ["table"]},
        "then": _without_addresses(_ambiguous(table), _numbered(others)),
    }


# ---- the base class ----


def _extending(name: str, base: type[Drive]) -> dict[str, Any]:
    """Return the schema of files that extend this family: they must not replace parts of the family."""
    taken = sorted({one for one in dir(base) if not one.startswith("_")} - {*TAKEN_NAMES})
    has_rule = {
        "parameters": base.parameter_space is not None,
        "identify": base.identify is not Drive.identify,
    }
    parts: dict[str, Any] = {key: _FORBIDDEN for key, is_own in has_rule.items() if is_own}
    names = {section: {"propertyNames": {"not": {"enum": taken}}} for section in (*ACCESSES, "text")}
    written = {place for one in base.registers.values() for place in written_places(one)}
    ((holding, _),) = written_places(setting(0, ""))
    found = sorted(at for table, at in written if table == holding)
    return {
        "if": _says("extends", name),
        "then": {
            "properties": {**parts, **names},
            "allOf": [_without_written(first, found) for first in (0, 1)] if found else [{}],
        },
    }


def _without_written(first: int, found: list[int]) -> dict[str, Any]:
    """Return the schema that forbids registers at the addresses `found` if `counts_from` is `first`.

    `found` are the addresses of the writable registers in the built-in family that the file extends.
    """
    numbered = "|".join(f"{at + 1:04}" if at < 9_999 else f"{at + 1}" for at in found)
    in_table = {"type": "string", "pattern": rf"^\s*40?({numbered})\s*$"}
    without = _without_addresses(_addresses(at + first for at in found), in_table)
    return {
        "if": {"allOf": [_says("counts_from", first), _HOLDING_BY_DEFAULT]},
        "then": _each({"if": _HOLDING, "then": without}, _WRITTEN),
    }


def _with_profile(name: str, roles: Mapping[str, Role]) -> dict[str, Any]:
    """Return a schema for files with the key `profile = name`. The profile uses the registers `roles`."""
    reserved = {*dir(Profile), *Profile.__annotations__} - {*dir(Drive)}
    return {
        "if": _says("profile", name),
        "then": {
            "properties": {
                section: {
                    "propertyNames": {"not": {"enum": sorted(reserved - roles.keys() | others)}},
                    "allOf": [{"$ref": f"#/definitions/roles-{name}"}],
                }
                for section, access in ACCESSES.items()
                for others in [{role for role in roles if access not in roles[role].access}]
            },
            "allOf": [
                {"anyOf": [*(_has(access.value, role) for access in roles[role].access), _says("registers")]}
                for role in roles
                if roles[role].needed
            ],
        },
    }


def _of_roles(roles: Mapping[str, Role]) -> dict[str, Any]:
    """Return the schema of one section, such as [reading], in a family file with the key `profile`.

    `roles` are the names of the registers that the profile uses.
    """
    return {
        "properties": {role: _of_role(role, roles[role]) for role in roles},
        "additionalProperties": {"properties": {"harmless": {"maxItems": 0}}},
    }


def _has(section: str, name: str) -> dict[str, Any]:
    return {"properties": {section: {"required": [name]}}, "required": [section]}


def _of_role(name: str, role: Role) -> dict[str, Any]:
    """Return the schema of a register that the profile uses. It forbids the keys that the profile sets."""
    facts: dict[str, Any] = {
        "harmless": {"maxItems": 0},
        "never_together": {"maxItems": 0},
        "moves": _FORBIDDEN,
        "never": {"maxLength": 0},
    }
    if role.is_word:
        facts |= {"unit": {"maxLength": 0}, "step": {"const": 1}, "offset": {"const": 0}, "part": _FORBIDDEN}
        facts |= {"invalid": _FORBIDDEN, "scale_register": {"maxLength": 0}}
        facts["number_format"] = {"enum": _spelled(NumberFormat.U16)}
        if not (role.extra or role.renumbered):
            facts |= {"values": _FORBIDDEN, "bits": _FORBIDDEN}
    if role.units:
        facts |= {"unit": {"enum": [*role.units]}, "step": {"type": "number"}}
    if name == "reference":
        facts |= {"step": {"type": "number", "exclusiveMinimum": 0}, "offset": {"const": 0}}
        facts["span"] = {"items": [{"minimum": 0}]}
    if name == "output_frequency":
        facts |= {"part": _FORBIDDEN, "offset": {"const": 0}, "scale_register": {"maxLength": 0}}
    is_named = {"anyOf": [{"required": [key]} for key in ("values", "bits")]} if name == "signature" else {}
    return {"properties": facts, **is_named}


# ---- numbers ----


def _spelled(number_format: NumberFormat) -> list[str]:
    return [number_format.name, number_format.name.lower()]


def _of_format(number_format: NumberFormat) -> dict[str, Any]:
    """Return the schema of a register whose number has this format."""
    low, high = raw_span(number_format)
    bits = width(number_format)
    keys: dict[str, Any] = {}
    if number_format in FLOATS:
        keys |= {"values": _FORBIDDEN, "bits": _FORBIDDEN, "part": _FORBIDDEN}
    else:
        count = {"type": "integer", "minimum": int(low), "maximum": (1 << bits) - 1}
        keys["values"] = {"additionalProperties": {"minimum": int(low), "maximum": int(high)}}
        keys["bits"] = {"additionalProperties": {"maximum": bits - 1}}
        keys |= {key: {"items": count} for key in ("harmless", "broadcast")}
        raw = {"type": "integer", "minimum": -(1 << bits - 1), "maximum": (1 << bits) - 1}
        keys["invalid"] = {"anyOf": [raw, {"type": "array", "items": raw}]}
        keys["part"] = {"anyOf": [{"type": "string"}, {"maximum": bits - 1}]}
    if WORDS[number_format] > 1:
        keys["order"] = {"not": {"enum": ["BA", "ba"]}}
    if number_format is NumberFormat.U32_EITHER:
        keys |= {"invalid": _FORBIDDEN, "part": _FORBIDDEN, "order": {"enum": ["ABCD", "abcd"]}}
    return {"properties": keys}


def _by_format() -> list[dict[str, Any]]:
    """Return the parts of the schema for registers that state their number format."""
    return [
        {
            "if": {"properties": {"number_format": {"enum": _spelled(one)}}, "required": ["number_format"]},
            "then": {"$ref": f"#/definitions/{one.name}"},
        }
        for one in WORDS
    ]


_IS_WRITTEN = {"not": {"required": ["never"]}}
# accepts the table of holding registers, and a register without the key `table`
_HOLDING = {"properties": {"table": {"enum": ["holding", "HOLDING"]}}}
_HOLDING_BY_DEFAULT = {"properties": {"default": _HOLDING}}


def _by_default() -> list[dict[str, Any]]:
    """Return the parts of the schema for registers that state no table or no number format."""
    of_holding = {"if": {"not": {"required": ["table"]}}, "then": _without_addresses(_ambiguous("holding"))}
    unstated = {"not": {"required": ["number_format"]}}
    of_words = {"if": unstated, "then": {"$ref": f"#/definitions/{NumberFormat.U16.name}"}}
    read_only = {"properties": {"table": {"not": {"enum": ["holding", "HOLDING", "coil", "COIL"]}}}}
    states_table = {"anyOf": [{"required": ["table"]}, {"properties": {"at": _numbered("04")}}]}
    return [
        {"if": _HOLDING_BY_DEFAULT, "then": _each(of_holding)},
        {"if": {"properties": {"default": unstated}}, "then": _each(of_words)},
        {
            "if": {"properties": {"default": {**read_only, "required": ["table"]}}, "required": ["default"]},
            "then": _each({"if": _IS_WRITTEN, "then": states_table}, _WRITTEN),
        },
    ]


# ---- tables ----


def _table(properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "object", "properties": properties, "additionalProperties": False}


def _named(entry: dict[str, Any], reserved: Iterable[str], most: int = 1000) -> dict[str, Any]:
    """Return the schema of a section whose keys are names and whose values fit the schema `entry`."""
    names = {**NAME, "not": {"enum": sorted({*reserved, *keyword.kwlist})}}
    return {"type": "object", "propertyNames": names, "additionalProperties": entry, "maxProperties": most}


def _facts(tables: Sequence[str]) -> dict[str, Any]:
    """Return the schema of the section [family]."""
    eight_bits = {"type": "array", "items": {"type": "string", "pattern": "^8"}}
    speaks_ascii = {
        "required": ["framings"],
        "properties": {"framings": {"contains": {"enum": ["ascii", "ASCII"]}}},
    }
    # without the key, the framing is RTU
    speaks_rtu = {"properties": {"framings": {"contains": {"enum": ["rtu", "RTU"]}}}}
    rtu_only = {"formats": {"anyOf": [eight_bits, _table({"rtu": eight_bits})]}}
    both = {"formats": {"properties": {"rtu": eight_bits}, "required": ["ascii"]}}
    facts = json_schema(
        FAMILY_KEYS,
        allOf=[
            {"not": {"required": ["profile", "extends"]}},
            {"if": speaks_ascii, "then": {"properties": both}, "else": {"properties": rtu_only}},
            {"if": speaks_rtu, "then": {"properties": {"formats": {"required": ["rtu"]}}}},
        ],
    )
    facts["properties"]["registers"] |= {"maxItems": MOST_CSV_FILES}
    if tables:
        facts["properties"]["registers"] |= {"items": {"enum": [*tables]}}
    for key in ("profile", "extends"):
        facts["properties"][key]["enum"] = [*bases(key)]
    return facts


def _register() -> dict[str, Any]:
    """Return the schema of a register in any section."""
    keys = {key: one.schema for key, one in REGISTER_KEYS.items()}
    keys["bits"]["additionalProperties"] = {"type": "integer", "minimum": 0, "maximum": MOST_BITS - 1}
    has_unit = {"required": ["unit"], "properties": {"unit": {"minLength": 1}}}
    meanings = [{"required": ["values"]}, {"required": ["bits"]}, has_unit]
    pairs = [{"allOf": [one, other]} for at, one in enumerate(meanings) for other in meanings[:at]]
    parts = [*(_addresses_of(table) for table in DIGIT_OF_TABLE), *_by_format()]
    return {**_table(keys), "required": ["at"], "not": {"anyOf": pairs}, "allOf": parts}


def _of_access(access: Access) -> dict[str, Any]:
    """Return the schema of a register in one section; `access` names it, as READING for [reading]."""
    if access is Access.READING:
        never_written = {key: {"maxItems": 0} for key in _NEVER_WRITTEN}
        only: dict[str, Any] = {"properties": {**never_written, "moves": {"const": False}}}
    else:
        of_written = _without_addresses(_numbered("13"))
        of_written["properties"]["table"] = {"enum": ["holding", "HOLDING", "coil", "COIL"]}
        only = {
            "properties": {"part": _FORBIDDEN, "number_format": {"not": {"enum": ["I8", "i8"]}}},
            "if": _IS_WRITTEN,
            "then": of_written,
        }
    return {"allOf": [{"$ref": "#/definitions/register"}, only]}
