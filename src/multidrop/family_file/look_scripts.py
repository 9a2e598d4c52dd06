"""Scripts that look and set: `identify`, `state` and `set_frequency` of a family's file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from multidrop.drive.family import Drive
from multidrop.drive.script import Script, read
from multidrop.drive.state import Condition, State
from multidrop.errors import Advice, Refused
from multidrop.family_file.declared import DeclaredVerbs
from multidrop.family_file.looks import Look

# ---- what a drive shows ----


def identify_of(identity: Look) -> Callable[..., Script[Any]]:
    def identify(drive: Drive) -> Script[None]:
        values: dict[str, Any] = {}
        if not (yield from identity.seen(drive, values)):
            shown = ", ".join(
                f"{name} = {drive.register(name).format(value)}" for name, value in values.items()
            )
            raise Refused(f"{drive.name} shows {shown}: it is no {drive.title or type(drive).__name__}")

    return identify


def state_verb_of(declared: DeclaredVerbs) -> Callable[..., Script[Any]]:
    def state(drive: Drive) -> Script[State]:
        values: dict[str, Any] = {}
        for look, state in declared.states:
            if not (yield from look.seen(drive, values)):
                continue
            if state.condition is not Condition.FAULT:
                return state
            return State(Condition.FAULT, fault=(yield from fault_shown(drive)) or look.name)
        return declared.state_of(values)

    return state


def fault_shown(drive: Drive) -> Script[str]:
    """Return the fault by name, where the file has a reading of that name; else nothing."""
    register = drive.registers.get("fault")
    if register is None or not register.readable:
        return ""
    return register.format((yield from read(register)))


def first_seen(drive: Drive, looks: Sequence[Look]) -> Script[Look | None]:
    """Return the first of the looks that holds."""
    values: dict[str, Any] = {}
    for look in looks:
        if (yield from look.seen(drive, values)):
            return look
    return None


# ---- the setpoint ----


def set_frequency_of(declared: DeclaredVerbs) -> Callable[..., Script[Any]]:
    setpoint = declared.setpoint
    assert setpoint is not None

    def set_frequency(drive: Drive, hz: float) -> Script[None]:
        register = drive.register(setpoint.register)
        if not hz >= 0:
            raise Refused(f"{drive.name}: {hz:g} Hz is below 0; a direction is said to start()")
        if not setpoint.of:
            return (yield from drive._hold(register, hz))
        most = yield from _full_scale(drive, setpoint.of)
        if not hz <= most:
            raise Refused(f"{drive.name}: {hz:g} Hz is outside 0 to {most:g} Hz, its {setpoint.of}")
        return (yield from drive._hold(register, hz / most * 100))

    return set_frequency


def _full_scale(drive: Drive, of: str) -> Script[float]:
    """Return the frequency in Hz that 100 % is, of an option or a register."""
    if of in drive.registers:
        most: float = yield from read(drive.register(of))
        if not most > 0:
            raise Refused(
                f"{drive.name} says that its {of} is {most:g} Hz: no setpoint in % can be made of that"
            )
        return most
    declared = drive.option.get(of)
    if not declared:
        raise Refused(
            f"{drive.name} takes its setpoint in % of {of}: declare {of} = HZ",
            advice=Advice.declare(of, "HZ"),
        )
    return declared
