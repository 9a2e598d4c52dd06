"""Verbs as data: the sections of a file that command a motor, checked, become methods of its class."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from multidrop.drive.register import Register
from multidrop.family_file.declared import DeclaredVerbs
from multidrop.family_file.hazards import NAMES, check_verbs
from multidrop.family_file.look_hazards import check_looks
from multidrop.family_file.looks import Look, parse_looks
from multidrop.family_file.scripts import verbs_of
from multidrop.family_file.sections import (
    option_units,
    parse_identity,
    parse_setpoint,
    parse_shows,
    parse_states,
)
from multidrop.family_file.steps import StepParser, VerbStep
from multidrop.family_file.word_hazards import check_words
from multidrop.toml_check import TomlPlace

SECTIONS = ("look", "state", "set_frequency", "identify", "verb", "shows")
_TAKEN = ("declared_verbs", "is_jogged")  # names that the class has besides those of every drive


def add_verbs(
    namespace: dict[str, Any],
    document: Mapping[str, Any],
    registers: Mapping[str, Register[Any]],
    place: TomlPlace,
) -> None:
    """Put the verbs that the file declares into the class's namespace, and tell all that is wrong with them.

    Where anything is wrong nothing is put in: such a file makes no class.
    """
    before = len(place.config_errors)
    declared = _declared(namespace, document, registers, place)
    for name in _TAKEN:
        if name in registers:
            place.wrong(
                f"{name} is a name that every drive of a file has for something else; call it otherwise"
            )
    if len(place.config_errors) == before:  # otherwise the checks would tell what follows from a mistake
        check_looks(declared, registers, place)
        check_verbs(declared, registers, place)
        check_words(declared, registers, place)
    if len(place.config_errors) > before:
        return
    namespace.update(verbs_of(declared))
    namespace["declared_verbs"] = declared
    if declared.setpoint is not None:
        namespace["setpoint_name"] = declared.setpoint.register


def _declared(
    namespace: Mapping[str, Any],
    document: Mapping[str, Any],
    registers: Mapping[str, Register[Any]],
    place: TomlPlace,
) -> DeclaredVerbs:
    looks = parse_looks(document, registers, place)
    return DeclaredVerbs(
        looks,
        parse_states(document, looks, place),
        parse_identity(document, registers, place),
        parse_setpoint(document, registers, option_units(namespace, document), place),
        _steps(document, looks, registers, place),
        parse_shows(document, registers, place),
    )


def _steps(
    document: Mapping[str, Any],
    looks: Mapping[str, Look],
    registers: Mapping[str, Register[Any]],
    place: TomlPlace,
) -> dict[str, tuple[VerbStep, ...]]:
    tables = document.get("verb", {})
    if not isinstance(tables, Mapping):
        place.wrong(f"verb = {tables!r} is not right; write [verb.stop], and under it steps = [ … ]")
        return {}
    parser, found = StepParser(registers, looks), {}
    for name, table in tables.items():
        at = place.within(f"[verb.{name}]")
        if name not in NAMES:
            at.wrong(f"{name} is no verb that a file declares; there are {', '.join(NAMES)}")
        elif not isinstance(table, Mapping) or {*table} != {"steps"}:
            at.wrong("has one key: steps = [ … ]")
        else:
            steps = parser.steps(table["steps"], at)
            if steps is not None:
                found[name] = steps
    return found
