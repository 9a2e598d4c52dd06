"""Hazards of verbs as data: what each verb may and must do, so that no file starts a motor unasked.

A stop insists on harmless words at once and watches the standstill; a start writes once, after it has refused
on a fault and found the setpoint in force; a reset is refused while the motor turns. See `word_hazards` for
the words themselves and `look_hazards` for what the drive shows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

from multidrop.drive.family import START_TIME
from multidrop.drive.register import Register
from multidrop.drive.state import Condition
from multidrop.drive.verbs import STOPPING
from multidrop.family_file.declared import TURNING, DeclaredVerbs
from multidrop.family_file.looks import Look
from multidrop.family_file.steps import (
    Awaits,
    AwaitsRunning,
    Insists,
    NeedsSetpoint,
    RefusesWhen,
    VerbStep,
    Waits,
    Writes,
    every_step,
    longest,
)
from multidrop.family_file.words import shown
from multidrop.toml_check import TomlPlace

LONGEST_MOVE = 60.0  # s, of a start, a jog or a reset: nobody stands beside the motor for longer
STARTING = ("start", "jog")
NAMES = (*STARTING, *STOPPING, "reset_fault")

Registers = Mapping[str, Register[Any]]
Steps = tuple[VerbStep, ...]
Check = Callable[[DeclaredVerbs, Registers, str, Steps], Iterator[str]]

_REFUSE = (
    'does not refuse on {look} before it sends: add {{ refuse = "{look}", because = "{because}" }} first'
)
_KINDS: Mapping[type[VerbStep], str] = {
    Writes: "write",
    Insists: "insist",
    Waits: "wait",
    Awaits: "await",
    RefusesWhen: "refuse",
    NeedsSetpoint: "setpoint",
    AwaitsRunning: "started",
}


def check_verbs(declared: DeclaredVerbs, registers: Registers, place: TomlPlace) -> None:
    """Tell each hazard in the steps of the verbs, at the verb's place."""
    for name, steps in declared.steps.items():
        checks = _OF_STOPS if name in STOPPING else _OF_STARTS if name in STARTING else _OF_RESETS
        for check in (*_OF_ALL, *checks):
            for wrong in check(declared, registers, name, steps):
                place.within(f"[verb.{name}]").wrong(wrong)


def _sends(steps: Sequence[VerbStep], kind: type[Writes] = Writes) -> list[Writes]:
    """Return the steps that send, also those of an `else`; `Insists` alone by that kind."""
    return [step for step in every_step(steps) if isinstance(step, kind)]


def _written(steps: Sequence[VerbStep]) -> list[Writes]:
    return [step for step in _sends(steps) if not isinstance(step, Insists)]


# ---- all verbs ----


def _insists_on_harmless(
    declared: DeclaredVerbs, registers: Registers, name: str, steps: Steps
) -> Iterator[str]:
    for step in _sends(steps, Insists):
        harmless = registers[step.register].harmless or ()
        for word in step.words.all:
            if word not in harmless:
                print_as = shown(registers[step.register], word)
                yield (
                    f"insists on {print_as}, which is no harmless word of {step.register}: "
                    "an insist is repeated when its reply is lost"
                )
        if step.words.is_directed:
            yield f"insists on a word for each direction of {step.register}; a harmless word has no direction"


def _writes_once(declared: DeclaredVerbs, registers: Registers, name: str, steps: Steps) -> Iterator[str]:
    seen: set[tuple[str, int]] = set()
    for step in _written(steps):
        for word in step.words.all:
            print_as = f"{shown(registers[step.register], word)} to {step.register}"
            if (step.register, word) in seen:
                yield f"writes {print_as} twice: what may move the motor is sent once in a call"
            seen.add((step.register, word))
            if word in (registers[step.register].harmless or ()):
                yield f"writes {print_as}, which is harmless: write insist, or take it out of harmless"
    for awaited in steps:
        if isinstance(awaited, Awaits) and _written(awaited.otherwise):
            yield "writes in an else: after a step has failed, only harmless words are sent"


def _ends_in_time(declared: DeclaredVerbs, registers: Registers, name: str, steps: Steps) -> Iterator[str]:
    seconds = longest(steps, START_TIME)
    if name not in STOPPING and seconds > LONGEST_MOVE:
        yield f"may take {seconds:g} s by its waits and limits; a {name} takes {LONGEST_MOVE:g} s at most"


_OF_ALL: tuple[Check, ...] = (_insists_on_harmless, _writes_once, _ends_in_time)


# ---- stop, coast, emergency_stop ----


def _stops_at_once(declared: DeclaredVerbs, registers: Registers, name: str, steps: Steps) -> Iterator[str]:
    for step in every_step(steps):
        if not isinstance(step, (Insists, Waits, Awaits)):
            kind = _KINDS[type(step)]
            yield f"has the step {kind}, which may keep a stop back; it has insist, wait and await only"
    first = steps[0]
    if not isinstance(first, Insists) or first.when is not None:
        yield "does not begin with an insist without `when`: a stop is sent before anything is looked at"


def _stop_is_watched(declared: DeclaredVerbs, registers: Registers, name: str, steps: Steps) -> Iterator[str]:
    standing = declared.looks_of(Condition.STOPPED)
    last = steps[-1]
    ends = [last]
    if isinstance(last, Awaits) and last.otherwise:
        ends.append(last.otherwise[-1])
    for end in ends:
        if not isinstance(end, Awaits) or end.when is not None or end.look not in standing:
            known = ", ".join(look.name for look in standing) or "none yet"
            yield f'does not end with an await of a look that [state] calls "stopped" ({known})'


_OF_STOPS: tuple[Check, ...] = (_stops_at_once, _stop_is_watched)


# ---- start, jog ----


def _before_sending(steps: Sequence[VerbStep]) -> list[VerbStep]:
    """Return the steps without a condition that come before the first one that sends."""
    found: list[VerbStep] = []
    for step in steps:
        if _sends([step]):
            return found
        if step.when is None:
            found.append(step)
    return found


def _refuses(steps: Sequence[VerbStep], look: Look) -> bool:
    """Return True where a call is refused before anything is sent, whenever the look holds."""
    return any(isinstance(step, RefusesWhen) and look.implies(step.look) for step in _before_sending(steps))


def _unrefused(steps: Sequence[VerbStep], looks: Iterable[Look], because: str) -> Iterator[str]:
    """Yield a sentence for each of these looks at which a call is not refused in time."""
    for look in looks:
        if not _refuses(steps, look):
            yield _REFUSE.format(look=look, because=because)


def _start_refuses_on_fault(
    declared: DeclaredVerbs, registers: Registers, name: str, steps: Steps
) -> Iterator[str]:
    faults = declared.looks_of(Condition.FAULT)
    if not faults:
        yield 'has no fault to refuse on: [state] calls no look "fault"'
    yield from _unrefused(steps, faults, "it has a fault")


def _start_needs_setpoint(
    declared: DeclaredVerbs, registers: Registers, name: str, steps: Steps
) -> Iterator[str]:
    if name == "start" and declared.setpoint is None:
        yield "has no setpoint: add [set_frequency]"
    if name == "start" and not any(isinstance(step, NeedsSetpoint) for step in _before_sending(steps)):
        yield 'does not ask for the setpoint before it sends: add { setpoint = "in force" } first'


def _start_writes(declared: DeclaredVerbs, registers: Registers, name: str, steps: Steps) -> Iterator[str]:
    written = _written(steps)
    if not [step for step in written if step.when is None]:
        yield "writes no word without `when`: nothing starts the motor for sure"
    is_by_state = any(step.words.without == "as it turns" for step in written)
    if is_by_state and not any(state.direction for _, state in declared.states):
        yield 'cannot tell how it turns: [state] has no "running forward" and "running reverse"'


def _start_is_watched(
    declared: DeclaredVerbs, registers: Registers, name: str, steps: Steps
) -> Iterator[str]:
    last = steps[-1]
    is_seen = isinstance(last, AwaitsRunning) or (
        isinstance(last, Awaits) and last.look in declared.looks_of(*TURNING)
    )
    if not is_seen or last.when is not None:
        yield "does not end with started = true, or an await of a look that [state] calls running"
    if not declared.looks_of(*TURNING):
        yield 'cannot be seen: [state] calls no look "running"'


_OF_STARTS: tuple[Check, ...] = (
    _start_refuses_on_fault,
    _start_needs_setpoint,
    _start_writes,
    _start_is_watched,
)


# ---- reset_fault ----


def _reset_refuses_while_running(
    declared: DeclaredVerbs, registers: Registers, name: str, steps: Steps
) -> Iterator[str]:
    turning = declared.looks_of(*TURNING)
    if not turning:
        yield 'cannot be refused while the motor turns: [state] calls no look "running"'
    yield from _unrefused(steps, turning, "it runs")


def _reset_only_resets(
    declared: DeclaredVerbs, registers: Registers, name: str, steps: Steps
) -> Iterator[str]:
    for step in every_step(steps):
        if isinstance(step, (AwaitsRunning, NeedsSetpoint)):
            yield f"has the step {_KINDS[type(step)]}, which belongs to a start"
    if not _written(steps):
        yield "writes nothing: add the word that resets a fault"
    if any(step.words.is_directed for step in _written(steps)):
        yield "writes a word for each direction; a reset turns nothing"


_OF_RESETS: tuple[Check, ...] = (_reset_refuses_while_running, _reset_only_resets)
