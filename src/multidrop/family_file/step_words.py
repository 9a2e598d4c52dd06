"""The verbs of a family's file in words, for those who compare them with the manual."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

from multidrop.drive.register import Register
from multidrop.family_file.declared import DeclaredVerbs
from multidrop.family_file.looks import Criterion, Look
from multidrop.family_file.steps import (
    Awaits,
    AwaitsRunning,
    Insists,
    NeedsSetpoint,
    RefusesWhen,
    VerbStep,
    Waits,
    Writes,
)
from multidrop.family_file.words import Words

Registers = Mapping[str, Register[Any]]


def declared_in_words(declared: DeclaredVerbs, registers: Registers) -> Iterator[tuple[str, str]]:
    """Yield each verb and what it does, and before them what the looks and the states are."""
    if declared.identity is not None:
        yield "identify", f"it is one when {_criteria(declared.identity, registers)}"
    for look, state in declared.states:
        yield f"state {state}", f"when {_look(look, registers)}"
    if declared.setpoint is not None:
        of = f" as a part of {declared.setpoint.of}" if declared.setpoint.of else ""
        yield "set-frequency", f"write {declared.setpoint.register}{of}"
    for name, steps in declared.steps.items():
        for number, step in enumerate(steps, 1):
            yield f"{name.replace('_', '-')} {number}", _step(step, registers)


def _step(step: VerbStep, registers: Registers) -> str:
    begin = f"when {_look(step.when, registers)}: " if step.when is not None else ""
    return begin + _done(step, registers)


def _done(step: VerbStep, registers: Registers) -> str:
    match step:
        case Insists():
            return f"write {_words(step.words, registers[step.register])}, again until it is confirmed"
        case Writes():
            return f"write {_words(step.words, registers[step.register])}, once"
        case Waits():
            return f"wait {step.seconds:g} s"
        case Awaits():
            other = "; ".join(_step(each, registers) for each in step.otherwise) or "the verb has failed"
            return f"wait until {_look(step.look, registers)}; after {step.limit:g} s: {other}"
        case RefusesWhen():
            return f"refuse when {_look(step.look, registers)}: {step.because}"
        case NeedsSetpoint():
            return "refuse without a setpoint that was written and is in force"
        case AwaitsRunning():
            return "wait until the motor is seen to run"
        case _:
            return "do what this version has no words for"


def _words(words: Words, register: Register[Any]) -> str:
    def shown(word: int) -> str:
        return f"{word:04X}H to {register.address:04X}H ({register.name}: {_value(register, word)})"

    if not words.is_directed:
        return shown(words.all[0])
    directed = [
        f"{direction.value} {shown(word)}" for direction, word in words.by_direction.items() if direction
    ]
    without = f"; without a direction: {words.without}" if words.without else ""
    return f"{', '.join(directed)}{without}"


def _value(register: Register[Any], word: int) -> str:
    return register.format(register.decode(word)).replace("|", " + ")


def _look(look: Look, registers: Registers) -> str:
    return f"{look.name} ({_criteria(look, registers)})"


def _criteria(look: Look, registers: Registers) -> str:
    return " and ".join(_criterion(each, registers) for each in look.criteria)


def _criterion(criterion: Criterion, registers: Registers) -> str:
    register = registers[criterion.register]
    parts = []
    if criterion.has:
        parts.append(f"has {_value(register, criterion.has)}")
    if criterion.lacks:
        parts.append(f"lacks {_value(register, criterion.lacks)}")
    if criterion.values is not None:
        shown = (
            f"{value:g}" if register.values is None else _value(register, int(value))
            for value in sorted(criterion.values)
        )
        parts.append(f"is {' or '.join(shown)}")
    if criterion.below < math.inf:
        parts.append(f"is below {criterion.below:g} {register.unit}".rstrip())
    if criterion.above > -math.inf:
        parts.append(f"is above {criterion.above:g} {register.unit}".rstrip())
    return f"{register.name} {' and '.join(parts)}"
