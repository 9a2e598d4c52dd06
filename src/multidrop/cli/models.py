"""`multidrop models`: lists the families, or everything that one family declares."""

from __future__ import annotations

import argparse
import inspect
import json
import math
from typing import Any

from multidrop.cli.support.arguments import add_json_argument
from multidrop.cli.support.family_sheet import gain_of, needed_silence, range_text, sheet, verbs_of
from multidrop.cli.support.output import print_text
from multidrop.cli.support.values import aligned, wrapped
from multidrop.drive.family import Drive
from multidrop.drive.read_limits import read_limit
from multidrop.drive.register import Register
from multidrop.families import MODELS
from multidrop.families.registry import SHIPPED, find_model, shipped_family
from multidrop.plant.loader import load_plant


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "model", metavar="MODEL", nargs="?", help="one family; or path/to/file.toml, or path/to/file.py:Class"
    )
    parser.add_argument(
        "drive", metavar="DRIVE", nargs="?", help="of which drive, where MODEL is a plant file"
    )
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    if arguments.model is None:
        families = [*MODELS.values(), *map(shipped_family, SHIPPED)]
        summaries = [_summary(family) for family in families]
        print_text(json.dumps(summaries, indent=2) if arguments.json else _list(families))
    else:
        family = _family(arguments.model, arguments.drive)
        print_text(json.dumps(facts(family), indent=2) if arguments.json else sheet(family))
    return 0


def _family(model: str, drive: str | None) -> type[Drive]:
    return find_model(model) if drive is None else type(load_plant(model).find_drive(drive)[1])


def _list(families: list[type[Drive]]) -> str:
    rows = [("MODEL", "FRAMINGS", "ADDRESSES")]
    rows += [
        (family.model, " ".join(map(str, family.framings)), range_text(family.addresses))
        for family in families
    ]
    titles = ["FAMILY", *(family.title for family in families)]
    columns = [f"{row}  " for row in aligned(rows, "<<>")]
    lines = [
        line
        for row, title in zip(columns, titles, strict=True)
        for line in wrapped(title, row, " " * len(row), breaks_words=False)
    ]
    return "\n".join([*lines, "", "`multidrop models MODEL` says all of one family."])


# ---- as JSON ----


def _summary(family: type[Drive]) -> dict[str, Any]:
    return {
        "model": family.model,
        "title": family.title,
        "declared_in": family.declared_in or None,
        "framings": [str(framing) for framing in family.framings],
        "addresses": [family.addresses[0], family.addresses[-1]],
        "register_count": len(family.registers),
    }


def facts(family: type[Drive]) -> dict[str, Any]:
    return _summary(family) | {
        "manual": family.manual,
        "baudrates": family.baudrates,
        "formats": {str(framing): formats for framing, formats in family.formats.items()},
        "silence_s": family.silence,
        "silence_characters": family.silence_characters,
        "needed_silence_s": {str(framing): needed_silence(family, framing) for framing in family.framings},
        "response_delay_s": family(family.addresses[0]).response_delay,
        "response_delay_characters": family.response_delay_characters,
        "answering_time_s": family.answering_time or None,
        "response_timeout_s": family.response_timeout,
        "turnaround_delay_s": family.turnaround_delay,
        "broadcasts": family.broadcasts,
        "no_broadcasts": None if family.broadcasts else family.no_broadcasts,
        "most_registers": {table.name: most for table, most in family.most_registers.items()},
        "read_limits": {
            table.name: read_limit(family, table)
            for table in dict.fromkeys(register.table for register in family.registers.values())
            if table.read is not None
        },
        "read_together": family.read_together,
        "least_interval_s": family.least_interval,
        "reading_gain": str(gain) if (gain := gain_of(family)) else None,
        "exceptions": family.exceptions,
        "options": {
            name: {"unit": option.unit, "span": option.span, "meaning": option.meaning}
            for name, option in family.options.items()
        },
        "verbs": verbs_of(family),
        "line_terminals": family.line_terminals,
        "most_devices": family.most_devices or None,
        "line_parameters": family.line_parameters,
        "remote": family.remote,
        "watchdog": family.watchdog,
        "registers": [_register(register) for register in family.registers.values()],
        "texts": [
            {"name": text.name, "table": text.table.name, "address": text.address, "length": text.length}
            for text in family.texts.values()
        ],
        "notes": inspect.cleandoc(family.__doc__ or ""),
    }


def _register(register: Register[Any]) -> dict[str, Any]:
    names = register.values
    facts = {name: getattr(register, name, None) for name in _REGISTER_KEYS}
    return facts | {
        "table": register.table.name,
        "access": register.access.value,
        "at_least": register.at_least or None,
        "at_most": register.at_most or None,
        "part": register.part,
        "invalid": [count if math.isfinite(count) else str(count) for count in register.invalid],
        "offset": register.offset,
        "order": register.order,
        "scale_register": register.scale_register or None,
        "values": None if names is None else {member.name: member.value for member in names},
        "wire": register.number_format.name,
        "kept": register.kept.value,
    }


_REGISTER_KEYS = (  # in this order
    *("name", "table", "address", "access", "unit", "step", "offset", "span", "at_least", "at_most"),
    *("values", "wire", "order", "part", "invalid", "scale_register"),
    *("kept", "ram_address", "default", "while_running", "broadcast", "moves", "harmless", "never_together"),
    *("never", "place", "outside", "note"),
)
