"""Hazards of looks: a motor that turns is never taken for one that stands, nor a fault for none.

The file says twice what a drive shows, in [state] and in [shows]; both must agree.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from multidrop.drive.register import Register
from multidrop.drive.state import Condition
from multidrop.drive.verbs import STOPPING
from multidrop.family_file.declared import TURNING, DeclaredVerbs
from multidrop.family_file.hazards import STARTING
from multidrop.family_file.looks import Criterion, Look, limits_of
from multidrop.family_file.sections import FAULT, RUNNING, STANDING
from multidrop.toml_check import TomlPlace

# Readings that tell a motor that stands from one that runs down.
MOTIONS = ("output_frequency", "motor_speed")
NEARLY_ZERO = {"Hz": 1.0, "rpm": 60.0, "%": 2.0}  # the most, in a look that says that a motor stands

Registers = Mapping[str, Register[Any]]

_MEANT = {
    STANDING: ("[shows]", (Condition.STOPPED,)),
    RUNNING: ("[shows.running]", TURNING),
    FAULT: ("[shows.fault]", (Condition.FAULT,)),
}


def check_looks(declared: DeclaredVerbs, registers: Registers, place: TomlPlace) -> None:
    """Tell each hazard in [state], [identify] and [shows], and what is missing there."""
    for wrong in _missing(declared):
        place.wrong(wrong)
    for wrong in _order(declared):
        place.within("[state]").wrong(wrong)
    for look in declared.looks_of(Condition.STOPPED):
        for wrong in _standstill(look, declared, registers):
            place.within(f"[look] {look}").wrong(wrong)
    for look in declared.looks_of(Condition.FAULT):
        for wrong in _narrow(look, declared, registers):
            place.within(f"[look] {look}").wrong(wrong)
    for wrong in _identity(declared):
        place.within("[identify]").wrong(wrong)
    for wrong in _shown(declared, registers):
        place.within("[shows]").wrong(wrong)


def _missing(declared: DeclaredVerbs) -> Iterator[str]:
    verbs = declared.steps
    moving = [name for name in STARTING if name in verbs]
    if (verbs or declared.setpoint) and declared.identity is None:
        yield "[identify] is missing: nothing is sent to a drive that may be another one"
    if moving and "stop" not in verbs:
        yield f"[verb.stop] is missing: what {' and '.join(moving)} begins must have an end"
    watches = moving or any(name in verbs for name in STOPPING)
    if watches and not declared.looks_of(Condition.STOPPED):
        yield '[state] calls no look "stopped": a stop is watched until the motor stands'
    for kind, (label, _) in _MEANT.items():
        if moving and kind not in declared.shows:
            yield f"{label} is missing: say what a drive shows then, so that the looks can be tried on it"


def _order(declared: DeclaredVerbs) -> Iterator[str]:
    others = ""
    for look, state in declared.states:
        if state.condition is Condition.FAULT and others:
            yield f"{look} is a fault and comes after {others}: the first that holds counts; put it first"
        elif state.condition is not Condition.FAULT:
            others = others or look.name


def _standstill(look: Look, declared: DeclaredVerbs, registers: Registers) -> Iterator[str]:
    for turning in declared.looks_of(*TURNING):
        if not look.contradicts(turning):
            yield f"may hold while {turning} holds: a motor that runs would be taken for one that stands"
    motions = [name for name in MOTIONS if name in registers and registers[name].readable]
    if motions and not any(criterion.register in motions for criterion in look.criteria):
        yield f"does not look at {motions[0]}, which shows the run-down: add it with below"
    for criterion in look.criteria:
        yield from _nearly_zero(criterion, registers[criterion.register], criterion.register in motions)


def _nearly_zero(criterion: Criterion, register: Register[Any], is_motion: bool) -> Iterator[str]:
    most, name, unit = NEARLY_ZERO.get(register.unit), criterion.register, register.unit
    if most is None and is_motion:
        yield f"takes {name} in {unit or 'no unit'} for a standstill; it is to be in {', '.join(NEARLY_ZERO)}"
    if is_motion and register.scale_register:
        yield f"takes {name} for a standstill, whose scale the device may change: look at another register"
    if most is None or register.values is not None:
        return
    if criterion.values is not None:
        if any(abs(value) > most for value in criterion.values):
            yield f"takes {name} of more than {most:g} {unit} for a standstill"
        return
    if not 0 < criterion.below <= most:
        yield f"takes {name} below {criterion.below:g} {unit} for a standstill; {most:g} {unit} is the most"
    elif is_motion and limits_of(register)[0] < 0 and criterion.above < -most:
        yield f"takes {name} below 0 for a standstill, which is reverse: add above = {-criterion.below:g}"


def _identity(declared: DeclaredVerbs) -> Iterator[str]:
    for look, state in declared.states:
        if declared.identity is not None and declared.identity.contradicts(look):
            yield f"cannot hold while {look} does: a drive that is {state.condition.value} would not be known"


def _narrow(look: Look, declared: DeclaredVerbs, registers: Registers) -> Iterator[str]:
    """Find conditions of a fault's look that tell it from nothing: a fault without them would not be seen."""
    others = [_values(kind, declared, registers) for kind in (STANDING, RUNNING) if kind in declared.shows]
    for without, what in look.looser():
        if others and not any(without.holds(values) for values in others):
            yield f"needs {what} too, which tells nothing: a fault without it would not be seen"


def _values(kind: str, declared: DeclaredVerbs, registers: Registers) -> dict[str, float]:
    """Return what a drive of this kind shows: 0 where the file does not say."""
    zeros: dict[str, float] = {name: 0 for name, register in registers.items() if register.readable}
    return zeros | dict(declared.shows.get(STANDING, {})) | dict(declared.shows.get(kind, {}))


def _shown(declared: DeclaredVerbs, registers: Registers) -> Iterator[str]:
    if not declared.steps:
        return
    for kind, (label, conditions) in _MEANT.items():
        if kind not in declared.shows:
            continue
        values = _values(kind, declared, registers)
        state = declared.state_of(values)
        if state.condition not in conditions:
            yield f"{label} is {state.condition.value} by [state], and is to be {conditions[0].value}"
        if declared.identity is not None and not declared.identity.holds(values):
            yield f"{label} is no drive of this family by [identify]"
        standing = [look for look in declared.looks_of(Condition.STOPPED) if look.holds(values)]
        if kind == RUNNING and standing:
            yield f"{label} stands by the look {standing[0]}, and is to run"
