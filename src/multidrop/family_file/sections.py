"""Sections [state], [identify], [set_frequency] and [shows] of a family's file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from multidrop.drive.register import Register
from multidrop.drive.state import Condition, Direction, State
from multidrop.family_file.declared import DeclaredSetpoint
from multidrop.family_file.looks import Look, parse_look
from multidrop.family_file.places import number, whole
from multidrop.family_file.words import word_of
from multidrop.toml_check import TomlPlace

STANDING, RUNNING, FAULT = "standing", "running", "fault"  # what a drive shows; the first without a name
_OF_CONDITION = {condition.value: condition for condition in Condition if condition is not Condition.UNKNOWN}
_OF_DIRECTION = {direction.value: direction for direction in Direction}


def parse_states(
    document: Mapping[str, Any], looks: Mapping[str, Look], place: TomlPlace
) -> tuple[tuple[Look, State], ...]:
    """Return the looks of [state] with what each means, in the file's order."""
    table = document.get("state", {})
    if not isinstance(table, Mapping):
        place.wrong(f'state = {table!r} is not right; write [state], and under it tripped = "fault"')
        return ()
    place = place.within("[state]")
    found = []
    for name, given in table.items():
        state = _state(given)
        if name not in looks:
            place.wrong(f"{name} is no look of [look]; there are {', '.join(looks) or 'none that is right'}")
        elif state is None:
            right = ", ".join(f'"{word}"' for word in _OF_CONDITION)
            place.wrong(f'{name} = {given!r} is not right; write {right}, or "running reverse"')
        else:
            found.append((looks[name], state))
    return tuple(found)


def _state(given: Any) -> State | None:
    words = given.split() if isinstance(given, str) else []
    condition = _OF_CONDITION.get(words[0]) if words else None
    if condition is None or len(words) > 2:
        return None
    if len(words) == 1:
        return State(condition)
    direction = _OF_DIRECTION.get(words[1])
    turns = condition not in (Condition.STOPPED, Condition.FAULT)
    return State(condition, direction) if direction and turns else None


def parse_identity(
    document: Mapping[str, Any], registers: Mapping[str, Register[Any]], place: TomlPlace
) -> Look | None:
    """Return the look by which a drive of the family is known; None where there is none."""
    if "identify" not in document:
        return None
    return parse_look("identify", document["identify"], registers, place.within("[identify]"))


def parse_setpoint(
    document: Mapping[str, Any],
    registers: Mapping[str, Register[Any]],
    options: Mapping[str, str],
    place: TomlPlace,
) -> DeclaredSetpoint | None:
    """Return the setpoint of [set_frequency]; `options` are the units of the file's options by name."""
    if "set_frequency" not in document:
        return None
    table, place = document["set_frequency"], place.within("[set_frequency]")
    if not isinstance(table, Mapping) or not {*table} <= {"register", "of"} or "register" not in table:
        place.wrong(
            f'{table!r} is not right; write register = "reference", and of = "reference_maximum" for %'
        )
        return None
    name, of = table["register"], table.get("of", "")
    register = registers.get(name) if isinstance(name, str) else None
    if register is None:
        place.wrong(f"register = {name!r} is no register of this file")
        return None
    before = len(place.config_errors)
    for wrong in _not_a_setpoint(name, register):
        place.wrong(wrong)
    if register.unit == "%" and not of:
        place.wrong(f'{name} is in %: add of = "NAME" of an option or a register in Hz that 100 % is')
    if of and register.unit == "Hz":
        place.wrong(f"{name} is in Hz: leave of out")
    if of and not _is_in_hz(of, registers, options):
        place.wrong(f"of = {of!r} is neither an option nor a register in Hz that can be read")
    return DeclaredSetpoint(name, of) if len(place.config_errors) == before else None


def _not_a_setpoint(name: str, register: Register[Any]) -> list[str]:
    wrong = []
    if not register.writable:
        wrong.append(f"{name} is a {register.access.value}, which is never written")
    if register.values is not None:
        wrong.append(
            f"{name} has bits or names: a setpoint is a number, in a register that carries nothing else"
        )
    if register.unit not in ("Hz", "%") or register.step is None:
        wrong.append(f"{name} is in {register.unit or 'no unit'}: a setpoint is in Hz or %, with its step")
    if (register.step or 0) < 0 or register.offset:
        wrong.append(f"{name} has a step below 0 or an offset: its count 0 is to be 0, a greater one more")
    if register.harmless:
        wrong.append(f"{name} has harmless words, as what runs the motor has: a setpoint is another register")
    if register.span is None:
        wrong.append(f"{name} has no span: add span = [0, 50], the least and the most that may be written")
    elif register.span[0] < 0:
        wrong.append(
            f"{name} may be {register.span[0]:g}: a negative setpoint may reverse; let its span begin at 0"
        )
    if any(count != 0 for count in register.broadcast):
        wrong.append(f"{name} has a broadcast of {register.broadcast}: only 0 does no harm")
    return wrong


def _is_in_hz(of: Any, registers: Mapping[str, Register[Any]], options: Mapping[str, str]) -> bool:
    if not isinstance(of, str):
        return False
    if of in options:
        return options[of] == "Hz"
    register = registers.get(of)
    return register is not None and register.readable and register.unit == "Hz" and register.step is not None


def parse_shows(
    document: Mapping[str, Any], registers: Mapping[str, Register[Any]], place: TomlPlace
) -> dict[str, dict[str, float]]:
    """Return the values of registers that a standing drive shows, and a running one, and one with a fault."""
    table = document.get("shows", {})
    if not isinstance(table, Mapping):
        place.wrong(f'shows = {table!r} is not right; write [shows], and under it status = ["ready"]')
        return {}
    place = place.within("[shows]")
    standing = {name: given for name, given in table.items() if not isinstance(given, Mapping)}
    found = {STANDING: _shown(standing, registers, place)} if standing else {}
    for name, given in table.items():
        if not isinstance(given, Mapping):
            continue
        if name not in (RUNNING, FAULT):
            place.wrong(f"{name} is none of [shows.{RUNNING}] and [shows.{FAULT}]")
            continue
        found[name] = _shown(given, registers, place.within(name))
    return found


def _shown(
    table: Mapping[str, Any], registers: Mapping[str, Register[Any]], place: TomlPlace
) -> dict[str, float]:
    values: dict[str, float] = {}
    for name, given in table.items():
        register = registers.get(name)
        if register is None or not register.readable:
            place.wrong(f"{name} is no register of this file that can be read")
        elif register.values is None and number(given):
            values[name] = given
        elif register.values is None:
            place.wrong(f"{name} = {given!r} is no number")
        elif whole(given) and 0 <= given <= 0xFFFF:  # a drive may show bits that have no name
            values[name] = given
        else:
            word = place.attempt(word_of, register, name, given)
            if word is not None:
                values[name] = word
    return values


def option_units(namespace: Mapping[str, Any], document: Mapping[str, Any]) -> dict[str, str]:
    """Return the units of the file's options by name, of the class that is made or else of [option]."""
    made = namespace.get("options") or {}
    units = {name: option.unit for name, option in made.items()}
    table = document.get("option", {})
    for name, given in table.items() if isinstance(table, Mapping) else ():
        if isinstance(given, Mapping) and isinstance(given.get("unit"), str):
            units.setdefault(name, given["unit"])
    return units
