"""The JSON Schema of a plant file, generated from the keys that the loader checks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from multidrop.channels.units import KNOWN_UNITS, SECOND, unit_of
from multidrop.core import Framing
from multidrop.drive import Kept
from multidrop.drive.family import Drive
from multidrop.drive.line_settings import SERIAL_ADDRESSES
from multidrop.drive.register import Option
from multidrop.drive.verbs import LISTED_VERBS
from multidrop.families import MODELS
from multidrop.families.registry import SHIPPED, installed_models, shipped_family
from multidrop.plant.loader import CHANNEL_KEYS, DRIVE_KEYS, LINE_KEYS, PLANT_KEYS, POLL_KEYS
from multidrop.toml_check import DRAFT, json_schema

_NAME = {"type": "string", "minLength": 1}
_Families = Mapping[str, type[Drive]]


def plant_schema(serve: Mapping[str, Any], own: _Families) -> dict[str, Any]:
    """Return the JSON Schema of a plant file; `serve` is the schema of its table [serve].

    The schema also has the registers, addresses and options of all families: the built-in families, the
    family files of this package, and `own`, which are further families by model name.
    """
    families = {**MODELS, **{name: shipped_family(name) for name in SHIPPED}, **own}
    follows = {"required": ["serve"], "properties": {"serve": {"required": ["fleet"]}}}
    models = [*dict.fromkeys(family.model for family in families.values())]
    plant = json_schema(
        PLANT_KEYS,
        required=[],
        anyOf=[{"required": ["line"]}, follows],
        allOf=[
            _allowed(model, table, number)
            for number, model in enumerate(models)
            for table in ("serve", "fleet")
        ],
        definitions={  # keys are numbers, because a model's name or a unit may have any characters
            **{f"lists-{number}": _lists_of(model, families) for number, model in enumerate(models)},
            **_units_of_integrals(families),
        },
    )
    plant["properties"]["line"]["items"] = _line_schema(families)
    plant["properties"]["serve"] |= serve
    return {"$schema": DRAFT, "title": "multidrop plant file", **plant}


def _allowed(model: str, table: str, number: int) -> dict[str, Any]:
    """Return the part of the schema for this model in the table `may.family` of [serve] or [fleet]."""
    of_model = [table, "may", "family", model]
    return {"if": _inside(of_model, {}), "then": {"$ref": f"#/definitions/lists-{number}"}}


def _lists_of(model: str, families: _Families) -> dict[str, Any]:
    """Return the schema for plant files that allow registers or verbs of all drives of this model."""
    names = [name for name, family in families.items() if family.model == model]
    family = families[names[0]]
    writable = [register.name for register in family.registers.values() if register.writable]
    verbs = [verb for verb in LISTED_VERBS if getattr(family, verb) is not getattr(Drive, verb)]
    may: dict[str, Any] = {
        "properties": {"write": {"items": {"enum": writable}}, "verbs": {"items": {"enum": verbs}}}
    }
    for key in (model, "family", "may"):
        may = {"properties": {key: may}}
    lines = {"contains": _inside(["drive"], {"contains": _facts(model=names)})}
    return {"properties": {"serve": may, "fleet": may, "line": lines}, "required": ["line"]}


def _inside(keys: Sequence[str], condition: dict[str, Any]) -> dict[str, Any]:
    """Return a schema that applies a condition to the table at this path of keys."""
    for key in reversed(keys):
        condition = {"properties": {key: condition}, "required": [key]}
    return condition


def _line_schema(families: _Families) -> dict[str, Any]:
    is_url = {"properties": {"port": {"pattern": "://"}}}
    is_tcp = {"properties": {"port": {"pattern": "^[Tt][Cc][Pp]://"}}}
    no_modbus = [name for name, family in families.items() if not family.speaks(Framing.TCP)]
    on_tcp = {"framing": {"enum": _spellings(Framing.TCP)}, "model": {"not": {"enum": no_modbus}}}
    serial = {
        "framing": {"not": {"enum": _spellings(Framing.TCP)}},
        "address": {"minimum": SERIAL_ADDRESSES[0], "maximum": SERIAL_ADDRESSES[-1]},
    }
    is_off = {"properties": {"rs485": {"enum": ["off"]}}}
    line = json_schema(
        LINE_KEYS,
        allOf=[
            {
                "if": is_tcp,
                "then": _drives({"properties": on_tcp}),
                "else": _drives({"properties": serial}) | _without("transaction"),
            },
            {"if": is_url, "then": is_off},
            *_inherited(families),
            *_short_silences(families),
        ],
    )
    line["properties"]["drive"]["items"] = _drive_schema(families)
    return line


def _drives(schema: Mapping[str, Any]) -> dict[str, Any]:
    return {"properties": {"drive": {"items": schema}}}


def _inherited(families: _Families) -> Iterator[dict[str, Any]]:
    """Yield the parts of the schema for drives that do not support their line's baud rate or format.

    Such a drive needs a baud rate or a format of its own.
    """
    drives: dict[tuple[str, tuple[Any, ...]], list[dict[str, Any]]] = {}
    for name, family in families.items():
        drives.setdefault(("baudrate", tuple(family.baudrates)), []).append(_facts(model=[name]))
        for framing in family.framings:
            formats = tuple(family.formats_in(framing))
            drives.setdefault(("format", formats), []).extend(_using(name, family, framing))
    for (key, supported), conditions in drives.items():
        other = {"properties": {key: {"not": {"enum": [*supported]}}}, "required": [key]}
        yield {"if": other, "then": _drives({"if": {"anyOf": conditions}, "then": {"required": [key]}})}


def _facts(**values: list[str]) -> dict[str, Any]:
    """Return a JSON Schema that is met if each key has one of its given values."""
    return {"properties": {key: {"enum": each} for key, each in values.items()}, "required": [*values]}


def _using(name: str, family: type[Drive], framing: Framing) -> list[dict[str, Any]]:
    """Return the schemas that match the table of a drive of this family with this framing."""
    stated = _facts(model=[name], framing=_spellings(framing))
    by_default = _facts(model=[name]) | _without("framing")
    return [stated, by_default] if framing is family.framings[0] else [stated]


_SHORT = r"^\s*(0*\d{1,3}(\.\d+)?\s*us|0+(\.\d+)?\s*ms|0+(\.000\d*)?\s*s)\s*$"  # a silence of less than 1 ms
_SLOW = 15_000  # bit/s; up to this baud rate, 1.5 characters take 1 ms or more


def _short_silences(families: _Families) -> list[dict[str, Any]]:
    """Return the parts of the schema that refuse a silence below 1 ms for slow RTU drives.

    Their silence must last at least 1.5 characters.
    """
    is_short = {"properties": {"silence": {"pattern": _SHORT}}, "required": ["silence"]}
    is_slow = {"properties": {"baudrate": {"maximum": _SLOW}}, "required": ["baudrate"]}
    needs_baudrate = {"required": ["baudrate"]}
    drives, slow_drives = [], []
    for name, family in families.items():
        has_own_silence = family.silence >= 1e-3 or family.silence_characters >= 1.5
        conditions = _using(name, family, Framing.RTU) if Framing.RTU in family.framings else []
        drives += [] if has_own_silence else conditions
        slow_drives += [] if has_own_silence or family.baudrates[0] > _SLOW else conditions
    return [
        {"if": condition, "then": _drives({"if": {"anyOf": which}, "then": right})}
        for condition, which, right in (
            (is_short, drives, {"not": is_slow}),
            ({"allOf": [is_short, is_slow]}, drives, needs_baudrate),
            ({"allOf": [is_short, _without("baudrate")]}, slow_drives, needs_baudrate),
        )
    ]


def _without(key: str) -> dict[str, Any]:
    return {"not": {"required": [key]}}


def _spellings(framing: Framing) -> list[str]:
    return [str(framing), str(framing).upper()]


def _drive_schema(families: _Families) -> dict[str, Any]:
    readable = {register.name for family in families.values() for register in family.readings()}
    drive = json_schema(
        DRIVE_KEYS,
        additionalProperties={"type": "number"},  # options of families from files, which are not known here
        allOf=[
            *(_of_family(name, family) for name, family in families.items()),
            *(_used(name) for name in sorted(readable)),
            *_integrals(families),
        ],
    )
    drive["properties"]["model"] |= {
        "anyOf": [
            {"enum": [*families, *installed_models()]},
            {"pattern": r"\.toml$"},
            {"pattern": r"\.py:\w+$"},
        ]
    }
    drive["properties"]["framing"]["enum"] = [each for framing in Framing for each in _spellings(framing)]
    drive["properties"]["poll"] |= {
        "items": _polls_of(_NAME),
        "uniqueItems": True,
        "not": {"anyOf": [_twice(name) for name in ["*", *sorted(readable)]]},
    }
    drive["properties"]["channel"]["items"] = json_schema(CHANNEL_KEYS)
    return drive


def _polls_of(register: Mapping[str, Any]) -> dict[str, Any]:
    table = json_schema(POLL_KEYS)
    table["properties"]["register"] = register
    return {"anyOf": [register, table]}


def _twice(name: str) -> dict[str, Any]:
    """Return the schema of a list `poll` with the same register twice: as a name, and in a table."""
    in_table = {"type": "object", "properties": {"register": {"const": name}}, "required": ["register"]}
    return {"allOf": [{"contains": {"const": name}}, {"contains": in_table}]}


# ---- computed channels ----


def _used(name: str) -> dict[str, Any]:
    """Return the part of the schema that requires a register in `poll` if a channel of the drive uses it."""
    word = rf"^[^\"']*(?<![\w.-]){name}(?![\w.-]|\s*\()"
    uses = {"description": f"{name} is not in poll", "pattern": word}
    names = {"enum": ["*", name]}
    in_table = {"type": "object", "properties": {"register": names}, "required": ["register"]}
    return {
        "if": {
            "properties": {
                "poll": {"not": {"contains": {"anyOf": [names, in_table]}}},
                "channel": {"not": {"contains": {"properties": {"name": {"const": name}}}}},
            },
            "required": ["poll"],
        },
        "then": {"properties": {"channel": {"items": {"properties": {"value": {"not": uses}}}}}},
    }


def _integrals(families: _Families) -> Iterator[dict[str, Any]]:
    """Yield the parts of the schema that check the units of channels such as `integral(power)`."""
    models: dict[tuple[str, str], list[str]] = {}
    for model, family in families.items():
        for register in family.readings():
            if not register.values:
                models.setdefault((register.name, register.value_unit), []).append(model)
    names: dict[tuple[str, tuple[str, ...]], list[str]] = {}
    for (name, unit), using in models.items():
        names.setdefault((unit, tuple(using)), []).append(name)
    units = _units(families)
    for (unit, users), registers in names.items():
        value = {"pattern": rf"^\s*integral\(\s*({'|'.join(registers)})\s*\)\s*$"}
        integral = {"unit": {"$ref": f"#/definitions/integral-{units.index(unit)}"}}
        channel = {"if": {"properties": {"value": value}}, "then": {"properties": integral}}
        yield {"if": _facts(model=[*users]), "then": {"properties": {"channel": {"items": channel}}}}


def _units_of_integrals(families: _Families) -> dict[str, Any]:
    """Return, for each unit of a register, the schema of the units that its integral may have."""
    found = {}
    for number, unit in enumerate(_units(families)):
        integral = unit_of(unit).times(SECOND)
        wrong = [one for one in KNOWN_UNITS if one and not unit_of(one).is_like(integral)]
        right = f"an integral of {unit} has a unit such as {integral}"
        found[f"integral-{number}"] = {"not": {"description": right, "enum": wrong}}
    return found


def _units(families: _Families) -> list[str]:
    return sorted({one.value_unit for family in families.values() for one in family.readings()})


def _of_family(name: str, family: type[Drive]) -> dict[str, Any]:
    """Return the part of the schema for drives with this model."""
    registers = family.registers.values()
    readable = [register.name for register in registers if register.readable]
    not_in_eeprom = [register.name for register in registers if register.kept is not Kept.EEPROM]
    return {
        "if": {"properties": {"model": {"const": name}}, "required": ["model"]},
        "then": {
            "propertyNames": {"enum": [*DRIVE_KEYS, *family.options]},
            "properties": {
                "address": {"minimum": family.addresses[0], "maximum": family.addresses[-1]},
                "baudrate": {"enum": [*family.baudrates]},
                "ram": {"items": {"enum": not_in_eeprom}},
                "poll": {"items": _polls_of({"enum": ["*", *readable]})},
                "channel": {"items": {"properties": {"name": {"not": {"enum": [*family.registers]}}}}},
                **{key: _option(option) for key, option in family.options.items()},
            },
            "required": [] if family.readings() else ["poll"],
            "anyOf": [
                {
                    "properties": {
                        "framing": {"enum": _spellings(framing)},
                        "format": {"enum": [*family.formats_in(framing)]},
                    },
                    "required": [] if framing is family.framings[0] else ["framing"],
                }
                for framing in Framing
                if family.speaks(framing)
            ],
        },
    }


def _option(option: Option) -> dict[str, Any]:
    low, high = option.span
    return {"type": "number" if option.unit else "integer", "minimum": low, "maximum": high}
