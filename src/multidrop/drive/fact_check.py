"""Check what a drive's class says of its line and its manual, before any of it is used."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from typing import Any

from multidrop.core import Framing
from multidrop.drive.line_facts import LONGEST_SILENCE
from multidrop.drive.options import Option
from multidrop.drive.table import Table
from multidrop.drive.timing import Settings

LONGEST_TIME = 60.0  # s; what is more was meant in ms
MOST_CHARACTERS = 1000
UNIT_IDS = range(256)  # of Modbus TCP; a serial line has fewer
CODES = range(1, 256)  # of exceptions

_SPANS = {
    "silence": (LONGEST_SILENCE, "s"),
    "silence_characters": (MOST_CHARACTERS, "characters"),
    "response_delay": (LONGEST_TIME, "s"),
    "response_delay_characters": (MOST_CHARACTERS, "characters"),
    "answering_time": (LONGEST_TIME, "s"),
    "turnaround_delay": (LONGEST_TIME, "s"),
}
_TRUTHS = ("answers_every_read", "broadcasts", "identify_recognises")
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

Error = tuple[str, str]  # the name of the fact, and the rest of the sentence


def fact_errors(family: Any) -> list[str]:
    """Return a sentence for each error in what a class says besides its registers."""
    checks = (_times, _choices, _formats, _codes, _by_table, _words, _options)
    found = (error for check in checks for error in check(family))
    registers = {*family.registers, *family.texts}  # one that has a fact's name is told as a register
    return [f"{fact}{wrong}" for fact, wrong in found if fact not in registers]


def _times(family: Any) -> Iterator[Error]:
    for name, (most, unit) in _SPANS.items():
        value = getattr(family, name)
        if not _is_number(value) or not 0 <= value <= most:
            yield name, f" = {value!r} is no number of {unit} from 0 to {most:g}"
    timeout = family.response_timeout
    if not _is_number(timeout) or not 0 < timeout <= LONGEST_TIME:
        yield "response_timeout", f" = {timeout!r} is no number of s above 0, up to {LONGEST_TIME:g}"


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _is_whole(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _are(values: object, right: Any) -> bool:
    """Return True for some values, in their order, which are all right."""
    return isinstance(values, (tuple, list, range)) and bool(values) and all(map(right, values))


def _choices(family: Any) -> Iterator[Error]:
    if not _are(family.addresses, lambda each: _is_whole(each) and each in UNIT_IDS):
        yield "addresses", f" = {family.addresses!r} is no range of addresses, such as range(1, 248)"
    if not _are(family.baudrates, lambda each: _is_whole(each) and _is_settings(each, "8N1")):
        yield "baudrates", f" = {family.baudrates!r} is no tuple of baud rates, such as (9600, 19200)"
    if not _are(family.framings, lambda each: isinstance(each, Framing)):
        yield "framings", f" = {family.framings!r} is no tuple of framings, such as (Framing.RTU,)"


def _is_settings(baudrate: int, format: str) -> bool:
    try:
        Settings(baudrate, format)
    except ValueError:
        return False
    return True


def _formats(family: Any) -> Iterator[Error]:
    formats = family.formats

    def is_format(each: object) -> bool:
        return isinstance(each, str) and _is_settings(9600, each)

    if not isinstance(formats, Mapping) or not all(
        isinstance(framing, Framing) and _are(each, is_format) for framing, each in formats.items()
    ):
        yield "formats", f' = {formats!r} is no mapping, such as {{Framing.RTU: ("8N1", "8E1")}}'
    elif formats and _are(family.framings, lambda _: True) and family.framings[0] not in formats:
        yield "formats", f" has none for {family.framings[0]}, its first framing"


def _codes(family: Any) -> Iterator[Error]:
    exceptions = family.exceptions
    if not isinstance(exceptions, Mapping) or not all(
        _is_whole(code) and code in CODES and isinstance(meaning, str) for code, meaning in exceptions.items()
    ):
        yield "exceptions", f' = {exceptions!r} is no mapping of codes, such as {{1: "illegal function"}}'
    for name in ("damaged", "later"):
        codes = getattr(family, name)
        if (
            isinstance(codes, (str, bytes))
            or not isinstance(codes, Collection)
            or not all(_is_whole(code) for code in codes)
        ):
            yield name, f" = {codes!r} is no set of codes, such as frozenset({{6}})"


def _by_table(family: Any) -> Iterator[Error]:
    for name, kind, example in (("most_registers", object, "16"), ("readable_gaps", range, "range(0, 16)")):
        stated = getattr(family, name)
        if not isinstance(stated, Mapping) or not all(
            isinstance(table, Table) and isinstance(each, kind) for table, each in stated.items()
        ):
            yield name, f" = {stated!r} is no mapping, such as {{HOLDING: {example}}}"


def _words(family: Any) -> Iterator[Error]:
    for name in _TRUTHS:
        if not isinstance(getattr(family, name), bool):
            yield name, f" = {getattr(family, name)!r} is neither True nor False"
    for name in _TEXTS:
        if not isinstance(getattr(family, name), str):
            yield name, f" = {getattr(family, name)!r} is no text"
    if not isinstance(family.setpoint_name, str):
        yield "setpoint_name", f" = {family.setpoint_name!r} is no name of a register"


def _options(family: Any) -> Iterator[Error]:
    options = family.options
    if not isinstance(options, Mapping):
        yield "options", f' = {options!r} is no mapping, such as {{"stop_time": Option("s", (1, 60), "…")}}'
        return
    for name, option in options.items():
        if not isinstance(name, str) or not isinstance(option, Option):
            yield "options", f'[{name!r}] = {option!r} is no option, such as Option("s", (1, 60), "…")'
        elif not _are(option.span, _is_number) or len(option.span) != 2 or option.span[0] > option.span[1]:
            yield "options", f"[{name!r}]: span = {option.span!r} is not the smallest and the largest value"
