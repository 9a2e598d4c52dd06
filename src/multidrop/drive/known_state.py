"""StateReader: compute a drive's state from register values that were already read."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from copy import copy
from typing import Any, cast

from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.drive.verbs import Condition, Read, State
from multidrop.errors import BusError

MOST_STEPS = 20
FAULT = "fault"  # name of the register with the fault code, in every family that has one
# registers with the newest fault, which may have been reset
FAULT_RECORDS = ("last_fault", "fault_record_1")


class StateReader:
    """Computes a drive's state from register values that were already read, by the rules of its family.

    It sends no request. Attributes that the family's `state` method sets are stored in a copy of the drive.
    """

    def __init__(self, drive: Drive) -> None:
        self._drive = copy(drive)
        # the values that the last call used, and the state that it returned
        self._shown: tuple[dict[str, float | None], State | None] | None = None
        self.has_state = type(drive).state is not Drive.state
        """True if the family's document defines a state."""
        self.lacks = ""
        """The register whose value was missing in the last call; "" if none was."""

    def state(self, values: Mapping[str, float]) -> State | None:
        """Return the state that these register values show; None if a value is missing.

        A value is in the register's unit, or is a raw count if the register has named values. If the status
        shows a fault and the fault's code is missing, the state has no fault name. The state is computed
        again only if a value that it depends on has changed, or if the family's `state` method set an
        attribute.
        """
        if self._shown and all(values.get(name) == value for name, value in self._shown[0].items()):
            return self._shown[1]
        self.lacks = ""
        attributes, read = dict(vars(self._drive)), dict[str, float | None]()
        found = self._computed(values, read)
        depends_on_values_alone = found is not None and attributes == vars(self._drive)
        self._shown = (read, found) if depends_on_values_alone else None
        return found

    def _computed(self, values: Mapping[str, float], read: dict[str, float | None]) -> State | None:
        """Return the state, or None if a value is missing. Add the values that it depends on to `read`."""
        try:
            script = self._drive.state.script()
            step = next(script)
            for _ in range(MOST_STEPS):
                if not isinstance(step, Read) or not isinstance(step.register, Register):
                    return None
                register: Register[Any] = step.register
                value = read[register.name] = values.get(register.name)
                if value is None:
                    if register.name != FAULT:
                        self.lacks = register.name
                        return None
                    value = 0.0  # stands for a missing fault code, which families read only during a fault
                step = script.send(value if register.values is None else register.decode(value))
        except StopIteration as end:
            return _known(end.value, read)
        except (BusError, ValueError, ArithmeticError):
            return None
        return None


def _known(state: object, read: Mapping[str, float | None]) -> State | None:
    """Return the result of a family's `state` method if the values in `read` are enough for it, else None.

    If the fault code is missing, a state with a fault is returned without the fault's name.
    """
    if not isinstance(state, State):
        return None
    if read.get(FAULT, 0) is not None:
        return state
    return State(Condition.FAULT) if state.condition is Condition.FAULT else None


def can_show_fault(drive: Drive, polled: Collection[str]) -> bool:
    """Return True if these registers are enough to detect a fault of the drive.

    The register with the newest fault is enough, because its value changes with each new fault.
    """
    if {FAULT, *FAULT_RECORDS} & {*polled}:
        return True
    choices = {name: _choices(drive.registers[name]) for name in polled}
    tried: list[dict[str, float]] = [{}]
    while tried:
        values = tried.pop()
        reader = StateReader(drive)
        found = reader.state(values)
        if found is not None and found.condition is Condition.FAULT:
            return True
        if found is None and reader.lacks not in values:
            tried += [values | {reader.lacks: choice} for choice in choices.get(reader.lacks, ())]
    return False


def _choices(register: Register[Any]) -> list[float]:
    members: list[Any] = [] if register.values is None else list(cast(Any, register.values))
    return [0.0, 1.0, *(float(member.value) for member in members)]
