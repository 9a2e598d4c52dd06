"""`multidrop models`: lists the families, or prints everything that one family declares."""

from __future__ import annotations

import argparse
import inspect
import json
import math
import re
from collections.abc import Iterator
from enum import Flag
from typing import Any

from multidrop.cli.support.arguments import add_json_argument
from multidrop.cli.support.output import print_text, warn
from multidrop.cli.support.values import LONGEST_NAME, aligned, user_title, wrapped
from multidrop.core import Framing, NumberFormat
from multidrop.drive.family import Drive
from multidrop.drive.register import Access, Carrier, Kept, Option, Register, Table
from multidrop.drive.request import read_limit, stated_limit
from multidrop.drive.text import Text
from multidrop.drive.verbs import VERBS
from multidrop.families import MODELS
from multidrop.families.registry import SHIPPED, find_model, installed_models, is_users_own, shipped_family
from multidrop.planning.prediction import ReadingGain, reading_gain
from multidrop.plant.loader import load_plant


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "model", metavar="MODEL", nargs="?", help="one family; or path/to/file.toml, or path/to/file.py:Class"
    )
    parser.add_argument("drive", metavar="DRIVE", nargs="?", help="a drive's name, if MODEL is a plant file")
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    if arguments.model is None:
        families = [*MODELS.values(), *map(shipped_family, SHIPPED), *_installed()]
        summaries = [_summary(family) for family in families]
        print_text(json.dumps(summaries, indent=2) if arguments.json else _list(families))
        return 0
    if arguments.drive is None:
        family = find_model(arguments.model)
    else:
        family = type(load_plant(arguments.model).find_drive(arguments.drive)[1])
    print_text(json.dumps(facts(family), indent=2) if arguments.json else sheet(family))
    return 0


def _installed() -> Iterator[type[Drive]]:
    for name in installed_models():
        try:
            yield find_model(name)
        except ValueError as failure:
            warn(str(failure))


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
    return "\n".join([*lines, "", "`multidrop models MODEL` shows one family in full."])


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


_REGISTER_KEYS = (  # keys of a register in JSON, in the order of output
    *("name", "table", "address", "access", "unit", "step", "offset", "span", "at_least", "at_most"),
    *("values", "wire", "order", "part", "invalid", "scale_register"),
    *("kept", "ram_address", "default", "while_running", "broadcast", "moves", "harmless", "never_together"),
    *("never", "place", "outside", "note"),
)


INDENT = 16  # column at which the facts about a family start


def sheet(family: type[Drive]) -> str:
    lines = [family.title or family.__name__, *wrapped(family.manual), ""]
    for name, text in _lines_of(family):
        lines += wrapped(text, f"{name:<{INDENT}}", " " * INDENT)
    exceptions = {f"{code:02X}H": meaning for code, meaning in family.exceptions.items()}
    options = {name: _option(option) for name, option in family.options.items()}
    for heading, entries in (("exceptions", exceptions), ("options", options)):
        if entries:
            lines += ["", heading]
            width = max(map(len, entries))
            for name, meaning in entries.items():
                lines += wrapped(meaning, f"  {name:<{width}}  ", " " * 8)
    for table in dict.fromkeys(register.table for register in family.registers.values()):
        lines += ["", *wrapped(_table_heading(table, family), "", "  "), *_registers(family, table)]
    if family.texts:
        lines += ["", "texts (read on demand)", *aligned(map(_text_row, family.texts.values()), "<<<<<")]
    notes = inspect.cleandoc(family.__doc__ or "")
    for block in notes.split("\n\n") if notes else ():
        lines.append("")
        # list items and indented lines start a paragraph of their own
        for paragraph in re.split(r"\n(?=[-*] |    )", block):
            item = "  " if paragraph[:2] in ("- ", "* ") else ""
            first = " " * (len(paragraph) - len(paragraph.lstrip()))
            lines += wrapped(" ".join(paragraph.split()), first, first + item)
    return "\n".join(lines)


def _lines_of(family: type[Drive]) -> Iterator[tuple[str, str]]:
    yield "model", family.model or "(a file of your own)"
    if family.declared_in:
        yield "origin", f"declared by its file, untested; see `multidrop check {family.declared_in}`"
    yield "addresses", range_text(family.addresses)
    default = " (the first is the default)" if len(family.baudrates) > 1 else ""
    yield "baud rates", ", ".join(map(str, family.baudrates)) + default
    for framing, formats in family.formats.items():
        yield f"{framing} formats", ", ".join(formats)
    for framing in family.framings:
        yield f"{framing} silence", _silence(family, framing)
    yield "response", _response(family)
    pause = f"yes, followed by a pause of {_ms(family.turnaround_delay)}"
    yield "broadcast", pause if family.broadcasts else family.no_broadcasts
    if family.least_interval:
        yield "interval", f"{_ms(family.least_interval)} from the end of an exchange to the next request"
    for group in family.read_together:
        yield "read together", ", ".join(group)
    if gain := gain_of(family):
        yield "reading", f"all readings in {gain} (at {gain.drive.settings})"
    yield "verbs", ", ".join(verbs_of(family)) or "none"
    if family.line_terminals:
        yield "terminals", family.line_terminals
    if family.most_devices:
        yield "devices", f"at most {family.most_devices} on a line"
    if family.line_parameters:
        yield "line", family.line_parameters
    if family.remote != Drive.remote:
        yield "remote", family.remote
    if verbs_of(family) or "confirmed" in family.options or family.watchdog != Drive.watchdog:
        yield "watchdog", family.watchdog


def gain_of(family: type[Drive]) -> ReadingGain | None:
    """Return the bus time that `readable_gaps` would save for a user's class at default settings.

    Return None if it would save little, and for a built-in family.
    """
    drive = family(family.addresses[0])
    if not is_users_own(family):
        return None
    return reading_gain(drive, [(register, None) for register in drive.readings()])


def _ms(seconds: float) -> str:
    return f"{seconds * 1e3:g} ms"


def _silence(family: type[Drive], framing: Framing) -> str:
    if not needed_silence(family, framing):
        return "none"
    own = []
    if family.silence:
        own.append(_ms(family.silence))
    if family.silence_characters:
        own.append(f"{family.silence_characters:g} characters")
    standard = "3.5 characters, above 19200 bit/s 1.75 ms,"
    return f"{' and '.join(own) or standard} before and after a frame"


def needed_silence(family: type[Drive], framing: Framing) -> float:
    """Return the silence between frames at the family's default baud rate, in s."""
    return family(family.addresses[0], framing=framing).needed_silence()


def _response(family: type[Drive]) -> str:
    delay = _ms(family.response_delay)
    if family.response_delay_characters:
        drive = family(family.addresses[0])
        at = f"{_ms(drive.response_delay)} at {drive.settings.baudrate} bit/s"
        delay = f"{family.response_delay_characters:g} characters ({at})"
    stated = f", less than {_ms(family.answering_time)} by its manual" if family.answering_time else ""
    return f"{delay} until measured{stated}; timeout {_ms(family.response_timeout)}"


def verbs_of(family: type[Drive]) -> list[str]:
    return [name.replace("_", "-") for name in VERBS if getattr(family, name) is not getattr(Drive, name)]


def _option(option: Option) -> str:
    low, high = (f"{end:d}" if isinstance(end, int) else f"{end:g}" for end in option.span)
    return f"{option.meaning} ({low} to {high} {option.unit}".rstrip() + ")"


def _table_heading(table: Table, family: type[Drive]) -> str:
    codes = []
    if table.read is not None:
        is_stated = stated_limit(family, table) or table.carrier not in (Carrier.BIT, Carrier.WORD)
        stated = "" if is_stated else ", the standard's limit: the family states none"
        codes.append(f"read {table.read:02X}H, at most {read_limit(family, table)}{stated}")
    if table.write is not None:
        codes.append(f"write {table.write:02X}H")
    return f"{table.name}s ({'; '.join(codes)})"


def _registers(family: type[Drive], table: Table) -> Iterator[str]:
    registers = [register for register in family.registers.values() if register.table is table]
    rows = aligned([_row(register) for register in registers], "<<<<<")
    for register, row in zip(registers, rows, strict=True):
        yield f"  {row}"
        yield from wrapped("; ".join(_remarks(register)), " " * 8, " " * 8)


def _row(register: Register[Any]) -> tuple[str, ...]:
    if register.values is not None:
        what = "names"
    elif register.is_bit:
        what = "0 or 1"
    elif register.step is None:
        what = f"{register.unit} scale not stated"
    else:
        what = f"{register.step:g} {register.unit}"
    span = f"{register.span[0]:g} to {register.span[1]:g}" if register.span else ""
    return f"{register.address:04X}H", register.name, register.access.value, what.strip(), span


def _text_row(text: Text) -> tuple[str, ...]:
    length = text.length * (1 if text.order == "B" else 2)
    return f"  {text.address:04X}H", text.name, text.table.name, f"{length} characters", text.place


def _remarks(register: Register[Any]) -> Iterator[str]:
    if title := user_title(register):
        yield title
    if register.access is Access.SETTING or register.kept is not Kept.UNKNOWN:
        yield f"kept: {register.kept.value}"
    if register.ram_address is not None:
        yield f"written at {register.ram_address:04X}H, in RAM"
    yield from _number(register)
    if register.at_least:
        yield f"at least {register.at_least}"
    if register.at_most:
        yield f"at most {register.at_most}"
    if register.default is not None:
        yield f"factory setting {register.default:g}"
    if register.while_running is not None:
        yield "may change while running" if register.while_running else "only while stopped"
    if register.broadcast:
        yield "may be broadcast: " + ", ".join(f"{raw:04X}H" for raw in register.broadcast)
    if register.moves is not None:
        yield "a write may move the motor" if register.moves else "a write never starts, stops or resets"
    if register.harmless is not None:
        harmless = ", ".join(_word(register, raw) for raw in register.harmless)
        yield f"only verbs write it, except {harmless}" if harmless else "only verbs write it"
    if register.never_together:
        yield "never together: " + ", ".join(_bits(register, mask) for mask in register.never_together)
    if register.never:
        yield f"never written: {register.never}"
    if register.values is not None:
        yield ", ".join(_member(member) for member in register.values)
    yield from (text.rstrip(".") for text in (register.note, register.outside, register.place) if text)


def _word(register: Register[Any], raw: int) -> str:
    """Return the name of a raw count, or the number itself if the names of its bits are too long."""
    name = register.format(register.decode(raw))
    return name if len(name) <= 2 * LONGEST_NAME else f"{raw:04X}H"


def _member(member: Any) -> str:
    if isinstance(member, Flag) and member.value.bit_count() == 1:
        return f"bit {member.value.bit_length() - 1} {member.name}"
    return f"{member.value} {member.name}"


def _number(register: Register[Any]) -> Iterator[str]:
    if register.words > 1:
        order = "" if register.order in ("AB", "ABCD") else f" in the order {register.order}"
        yield f"{register.words} words, {register.number_format.name}{order}"
    elif register.number_format in (NumberFormat.I8, NumberFormat.BCD16):
        yield register.number_format.name
    if register.part:
        low, high = register.part
        yield f"bit {low} of its word" if low == high else f"bits {low} to {high} of its word"
    if register.offset:
        yield f"{register.offset:+g} {register.unit}".rstrip()
    if register.scale_register:
        yield f"times ten to the power of {register.scale_register}"
    if register.invalid:
        yield "no value: " + ", ".join(_count(register, count) for count in register.invalid)


def _count(register: Register[Any], count: float) -> str:
    return f"{count:g}" if register.is_float or count < 0 else f"{int(count):04X}H"


def _bits(register: Register[Any], mask: int) -> str:
    return register.format(register.decode(mask)).replace("|", " and ")


def range_text(numbers: range) -> str:
    return f"{numbers[0]}-{numbers[-1]}"
