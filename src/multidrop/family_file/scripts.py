"""Scripts of verbs as data: the declared steps, carried out with the same helpers as a built-in family's."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

from multidrop.drive.family import Drive
from multidrop.drive.script import Script, insist, until, wait, write
from multidrop.drive.state import Condition, Direction, State
from multidrop.drive.verbs import STOPPING, Verb
from multidrop.errors import Advice, DriveRefused, NotDone, Refused, Unconfirmed
from multidrop.family_file.declared import DeclaredVerbs
from multidrop.family_file.hazards import STARTING
from multidrop.family_file.look_scripts import (
    fault_shown,
    first_seen,
    identify_of,
    set_frequency_of,
    state_verb_of,
)
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
)
from multidrop.family_file.words import Words

RESET_TIME = 1.0  # s, after which a fault that was reset must be gone
_CALLED = {"start": "the start", "jog": "the jog", "reset_fault": "the fault reset"}


def verbs_of(declared: DeclaredVerbs) -> dict[str, Verb[Any, Any]]:
    """Return the verbs of a family's file, to be put into its class."""
    found: dict[str, Callable[..., Script[Any]]] = {}
    if declared.identity is not None:
        found["identify"] = identify_of(declared.identity)
    if declared.states:
        found["state"] = state_verb_of(declared)
    if declared.setpoint is not None:
        found["set_frequency"] = set_frequency_of(declared)
    for name, steps in declared.steps.items():
        found[name] = _MAKERS[name](declared, name, steps)
    verbs: dict[str, Verb[Any, Any]] = {}
    for name, script in found.items():
        script.__name__ = name
        script.__doc__ = getattr(Drive, name).__doc__
        verbs[name] = Verb(script)
    return verbs


# ---- start, jog, reset_fault ----


def _move(declared: DeclaredVerbs, name: str, steps: Sequence[VerbStep]) -> Callable[..., Script[Any]]:
    def move(drive: Drive, direction: Direction | None = None) -> Script[None]:
        yield from _not_within_a_jog(drive, declared, name)
        yield from _carry_out(_Call(drive, declared, name, direction), steps)

    return move


def _not_within_a_jog(drive: Any, declared: DeclaredVerbs, name: str) -> Script[None]:
    """Raise Refused where a motor that turns would get a jog, or one that may still jog a start.

    No file says whether a start ends a jog: the motor is to be stopped in between.
    """
    if name == "start" and not getattr(drive, "is_jogged", False):
        return
    if not (yield from first_seen(drive, declared.looks_of(Condition.STOPPED))):
        why = "may still jog, which a start may not end:" if name == "start" else "is not seen to stand:"
        raise drive._stop_first(why)


def _reset_fault(declared: DeclaredVerbs, name: str, steps: Sequence[VerbStep]) -> Callable[..., Script[Any]]:
    def reset_fault(drive: Drive) -> Script[None]:
        yield from _carry_out(_Call(drive, declared, name, None), steps)
        faults = declared.looks_of(Condition.FAULT)

        def is_gone() -> Script[bool]:
            return not (yield from first_seen(drive, faults))

        if faults and not (yield from until(is_gone, limit=RESET_TIME)):
            fault = (yield from fault_shown(drive)) or "it shows one"
            raise NotDone(drive.name, "the fault reset", f"the fault stands: {fault}")

    return reset_fault


class _Call:
    """One call of a verb that may move the motor."""

    def __init__(self, drive: Any, declared: DeclaredVerbs, name: str, direction: Direction | None) -> None:
        self.drive = drive
        self.declared = declared
        self.name = name
        self.direction = direction

    def word(self, words: Words) -> Script[int]:
        """Return the word for the direction. Raises Refused where there is none, or it is not known."""
        by_direction, asked = words.by_direction, self.direction
        if not words.is_directed:
            return by_direction[None]
        if asked is None:
            asked = yield from self._in_force(words.without)
        return by_direction[asked]

    def _in_force(self, without: str) -> Script[Direction]:
        name = self.drive.name
        if without == "refuse":
            raise Refused(f"{name} starts in a direction: name it, Direction.FORWARD or Direction.REVERSE")
        if (yield from first_seen(self.drive, self.declared.looks_of(Condition.STOPPED, Condition.FAULT))):
            return Direction.FORWARD
        state: State = yield from self.drive.state.script()
        if state.direction is None:
            raise Refused(
                f"{name} is not seen to stand, and cannot say which way it turns: name the direction"
            )
        if without == "forward" and state.direction is not Direction.FORWARD:
            raise Refused(f"{name} turns in reverse: name the direction, or stop it first")
        return state.direction


def _carry_out(call: _Call, steps: Sequence[VerbStep]) -> Script[None]:
    if call.direction is not None and not any(
        isinstance(step, Writes) and step.words.is_directed for step in steps
    ):
        raise Refused(
            f"{call.drive.name}: its family's file has no words for directions; call {call.name} without one"
        )
    for step in steps:
        if step.when is None or (yield from step.when.seen(call.drive)):
            yield from _DO[type(step)](call, step)


def _write(call: _Call, step: Writes) -> Script[None]:
    register = call.drive.register(step.register)
    word = yield from call.word(step.words)
    if call.name in STARTING:
        call.drive.is_jogged = call.name == "jog"
    yield from write(register, register.decode(word))


def _insist(call: _Call, step: Insists) -> Script[None]:
    register = call.drive.register(step.register)
    yield from insist(register, register.decode(step.words.all[0]))


def _wait(call: _Call, step: Waits) -> Script[None]:
    yield from wait(step.seconds)


def _await(call: _Call, step: Awaits) -> Script[None]:
    """Await a look; a fault that comes meanwhile ends a start at once."""
    drive, faults = call.drive, call.declared.looks_of(Condition.FAULT)

    def is_seen() -> Script[bool]:
        values: dict[str, Any] = {}
        if (yield from step.look.seen(drive, values)):
            return True
        for look in faults if call.name in STARTING else ():
            if (yield from look.seen(drive, values)):
                fault = (yield from fault_shown(drive)) or look.name
                raise NotDone(drive.name, _CALLED[call.name], f"it tripped: {fault}")
        return False

    if not (yield from until(is_seen, limit=step.limit)):
        for otherwise in step.otherwise:
            if otherwise.when is None or (yield from otherwise.when.seen(drive)):
                yield from _DO[type(otherwise)](call, otherwise)
        raise Unconfirmed(
            drive.name, _CALLED[call.name], f"after {step.limit:g} s it does not show {step.look}"
        )


def _refuse(call: _Call, step: RefusesWhen) -> Script[None]:
    drive = call.drive
    if not (yield from step.look.seen(drive)):
        return
    fault = ""
    if step.look in call.declared.looks_of(Condition.FAULT):
        fault = yield from fault_shown(drive)
    shown = f" (it shows {fault})" if fault else ""
    verbs = [verb for verb in (*_CALLED, "stop", "coast") if f"call {verb}()" in step.because]
    advice = Advice.call(verbs[0]) if verbs else None
    raise Refused(f"{drive.name}: {step.because}{shown}", rule=f"it shows {step.look}", advice=advice)


def _needs_setpoint(call: _Call, step: NeedsSetpoint) -> Script[None]:
    yield from call.drive._setpoint_in_force()


def _started(call: _Call, step: AwaitsRunning) -> Script[None]:
    yield from call.drive._started(call.direction)


_DO: Mapping[type[VerbStep], Callable[[_Call, Any], Script[None]]] = {
    Writes: _write,
    Insists: _insist,
    Waits: _wait,
    Awaits: _await,
    RefusesWhen: _refuse,
    NeedsSetpoint: _needs_setpoint,
    AwaitsRunning: _started,
}


# ---- stop, coast, emergency_stop ----


def _stop(declared: DeclaredVerbs, name: str, steps: Sequence[VerbStep]) -> Callable[..., Script[Any]]:
    """Make a stop: nothing but the port keeps it back, and it ends when the motor is seen to stand."""
    standing = declared.looks_of(Condition.STOPPED)

    def stop(drive: Drive) -> Script[None]:
        yield from _stop_steps(drive, standing, steps)

    return stop


def _stop_steps(drive: Any, standing: Sequence[Look], steps: Sequence[VerbStep]) -> Script[None]:
    for at, step in enumerate(steps):
        if step.when is not None and not (yield from step.when.seen(drive)):
            continue
        if isinstance(step, Insists):
            try:
                yield from _insist_on_stop(drive, standing, step)
            except Unconfirmed:  # a drive that is not heard may hear
                yield from _send_what_follows(drive, steps[at + 1 :])
                raise
        elif isinstance(step, Waits):
            yield from wait(step.seconds)
        elif isinstance(step, Awaits):
            yield from _await_standstill(drive, standing, step)


def _insist_on_stop(drive: Any, standing: Sequence[Look], step: Insists) -> Script[None]:
    register = drive.register(step.register)
    try:
        yield from insist(register, register.decode(step.words.all[0]))
    except DriveRefused:  # as it may in a fault, in which it stands already
        if not (yield from first_seen(drive, standing)):
            raise


def _send_what_follows(drive: Any, steps: Sequence[VerbStep]) -> Script[None]:
    """Write once each what these steps write before anything is looked at or waited for."""
    for step in steps:
        if not isinstance(step, Insists) or step.when is not None:
            return
        register = drive.register(step.register)
        with suppress(Unconfirmed, DriveRefused):
            yield from insist(register, register.decode(step.words.all[0]), attempts=1)


def _await_standstill(drive: Any, standing: Sequence[Look], step: Awaits) -> Script[None]:
    def is_seen() -> Script[bool]:
        return (yield from step.look.seen(drive))

    if not step.otherwise:
        yield from drive._stopped(is_seen, step.limit)
    elif not (yield from until(is_seen, limit=step.limit)):
        yield from _stop_steps(drive, standing, step.otherwise)


_MAKERS = {
    "start": _move,
    "jog": _move,
    "reset_fault": _reset_fault,
    **dict.fromkeys(STOPPING, _stop),
}
