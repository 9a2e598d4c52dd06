"""DeclaredVerbs: all that a family's file says about its motor, checked, for the verbs and the simulator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from multidrop.drive.state import Condition, State
from multidrop.family_file.looks import Look
from multidrop.family_file.steps import VerbStep

TURNING = (Condition.RUNNING, Condition.ACCELERATING, Condition.DECELERATING)


@dataclass(frozen=True)
class DeclaredSetpoint:
    """The register of the setpoint, and what 100 % of it is: an option or a register in Hz, or "" for Hz."""

    register: str
    of: str = ""


@dataclass(frozen=True)
class DeclaredVerbs:
    """The motor of a family's file."""

    looks: Mapping[str, Look] = field(default_factory=dict)
    states: tuple[tuple[Look, State], ...] = ()  # the first that holds
    identity: Look | None = None
    setpoint: DeclaredSetpoint | None = None
    steps: Mapping[str, tuple[VerbStep, ...]] = field(default_factory=dict)  # by verb
    shows: Mapping[str, Mapping[str, float]] = field(default_factory=dict)  # values by "standing" and others

    def looks_of(self, *conditions: Condition) -> list[Look]:
        """Return the looks that [state] calls so, in its order."""
        return [look for look, state in self.states if state.condition in conditions]

    def state_of(self, values: Mapping[str, float]) -> State:
        """Return the state that these values of registers show."""
        for look, state in self.states:
            if look.holds(values):
                return state
        return State(Condition.UNKNOWN, note="it shows none of the looks in [state]")
