"""Known state: a drive's state, read out of values that somebody has already."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from typing import Any

from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.drive.script import Read
from multidrop.drive.state import State
from multidrop.errors import BusError

MOST_STEPS = 20


class StateReader:
    """Reads a drive's state as its family does, out of values such as those of its polled rows.

    Nothing is sent, and what the family notes at a look is noted for this reader alone.
    """

    def __init__(self, drive: Drive) -> None:
        self._drive = copy(drive)
        self.has_state = type(drive).state is not Drive.state
        """True where the family's document has a state at all."""

    def state(self, values: Mapping[str, float]) -> State | None:
        """Return the state that these values by register's name show; None where others are needed.

        A value is as in a row: in the register's unit, or the raw count where it has names.
        """
        try:
            script = self._drive.state.script()
            step = next(script)
            for _ in range(MOST_STEPS):
                if not isinstance(step, Read) or not isinstance(step.register, Register):
                    return None
                register: Register[Any] = step.register
                if register.name not in values:
                    return None
                value = values[register.name]
                step = script.send(value if register.values is None else register.decode(value))
        except StopIteration as end:
            return end.value if isinstance(end.value, State) else None
        except (BusError, ValueError, ArithmeticError):
            return None
        return None
