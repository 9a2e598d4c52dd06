"""Simulated drives of families' files: a motor that obeys the words of the file's verbs.

The model is the file's own: a word does what the name of the verb that sends it says, and status registers
show the looks of [state], beginning with what [shows] says of a drive that stands. So it proves that a file
agrees with itself, and nothing about the drive that the file describes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from multidrop.drive.register import Register
from multidrop.drive.state import Condition, Direction
from multidrop.family_file.declared import TURNING, DeclaredVerbs
from multidrop.family_file.looks import Look, shown_by
from multidrop.family_file.sections import FAULT, RUNNING, STANDING
from multidrop.family_file.steps import Awaits, Insists, VerbStep, Writes
from multidrop.sim.memory import MemoryCell
from multidrop.sim.motor import MONITORS, Phase
from multidrop.sim.motor_drive import MotorDrive

_TURNS = {Direction.FORWARD: 1, Direction.REVERSE: -1, None: None}
_CONDITIONS = {Phase.ACCELERATING: Condition.ACCELERATING, Phase.DECELERATING: Condition.DECELERATING}


class _Sent(NamedTuple):
    """A step of a verb that sends, and the look that is awaited after it."""

    step: Writes
    awaited: Look | None


class SimulatedDeclared(MotorDrive):
    """A drive of a family's file. The words of a start count only in their order; others do nothing."""

    def prepare(self) -> None:
        self.declared: DeclaredVerbs = type(self.drive).declared_verbs  # type: ignore[attr-defined]
        self.unknown_words = 0  # those that no verb sends
        self._sequences = {verb: _sequence(steps) for verb, steps in self.declared.steps.items()}
        self._controls = {sent.step.register for sequence in self._sequences.values() for sent in sequence}
        self._reached: dict[str, int] = {}  # by verb, the words of its sequence that came
        self._ready: Look | None = None  # shown while it stands
        for name, value in self.declared.shows.get(STANDING, {}).items():
            self.memory.set(self.drive.register(name), value)
        self._following: dict[MemoryCell, list[Register[Any]]] = {}  # those that show what the motor does
        for name in self._shown():
            register = self.drive.register(name)
            if name not in MONITORS and not register.writable:
                for cell in self.memory.of(register):  # parts of one word share their cell
                    self._following.setdefault(cell, []).append(register)

    # ---- commands ----

    def changed(self, cell: MemoryCell) -> None:
        super().changed(cell)
        if cell.register is not None and cell.register.name in self._controls:
            self._obey(cell.register.name, int(self.memory.get(cell.register)))  # in its order of bytes

    def _obey(self, name: str, word: int) -> None:
        self._ready = None
        known = [self._advance(verb, name, word) for verb in self._sequences]
        self.unknown_words += not any(known)

    def _advance(self, verb: str, name: str, word: int) -> bool:
        """Carry out the word if it is the verb's next or first one; return True where the verb has it."""
        sequence = self._sequences[verb]
        places = [
            (at, direction)
            for at, sent in enumerate(sequence)
            for direction, own in sent.step.words.by_direction.items()
            if sent.step.register == name and own == word
        ]
        if not places:
            if name in {sent.step.register for sent in sequence}:
                self._reached[verb] = 0
            return False
        reached = self._reached.get(verb, 0)
        nexts = [place for place in places if place[0] in (0, reached)]
        if not nexts:
            return True
        at, direction = max(nexts, key=lambda place: place[0])
        self._reached[verb] = at + 1
        if verb in ("start", "jog"):
            if not isinstance(sequence[at].step, Insists) and at + 1 == len(sequence):
                act = self.motor.run if verb == "start" else self.motor.jog
                act(_TURNS[direction])
            self._ready = sequence[at].awaited
        elif verb == "reset_fault":
            if not isinstance(sequence[at].step, Insists):
                self.motor.reset()
        elif verb == "stop":
            self.motor.stop()
        else:
            self.motor.coast()
        return True

    def setpoint(self) -> float:
        setpoint = self.declared.setpoint
        if setpoint is None:
            return super().setpoint()
        value = float(self.memory.get(self.drive.register(setpoint.register)))
        if not setpoint.of:
            return value
        most = self.drive.option.get(setpoint.of)
        if setpoint.of in self.drive.registers:
            most = float(self.memory.get(self.drive.register(setpoint.of)))
        self.motor.maximum_frequency = most or self.motor.maximum_frequency
        return value / 100 * self.motor.maximum_frequency

    # ---- what it shows ----

    def refresh(self, cell: MemoryCell) -> None:
        super().refresh(cell)
        shown = [register for register in self._following.get(cell, ()) if register not in self._held]
        if shown:
            values = self._shown()
            for register in shown:
                self.memory.set(register, values[register.name])

    def _shown(self) -> dict[str, float]:
        """Return the values of all registers that follow from the motor."""
        shows, motor = self.declared.shows, self.motor
        standing = self._zeros() | dict(shows.get(STANDING, {}))
        if motor.fault:
            looks = self.declared.looks_of(Condition.FAULT)[:1]
            return _after(standing | dict(shows.get(FAULT, {})), looks)
        if motor.energised:
            return _after(standing | dict(shows.get(RUNNING, {})), self._turning())
        return _after(standing, [self._ready] if self._ready else [])

    def _zeros(self) -> dict[str, float]:
        """Return 0 for each register that a look reads, or that shows anything."""
        looked = [name for look in self.declared.looks.values() for name in look.registers()]
        shown = [name for values in self.declared.shows.values() for name in values]
        return dict.fromkeys((*looked, *shown), 0)

    def _turning(self) -> list[Look]:
        """Return the look of a motor that turns as this one does: its direction counts, then its phase."""
        direction = Direction.REVERSE if self.motor.direction < 0 else Direction.FORWARD
        condition = _CONDITIONS.get(self.motor.phase, Condition.RUNNING)

        def unlikeness(state_of: tuple[int, Condition, Direction | None]) -> tuple[bool, bool, bool]:
            _, shown, turns = state_of
            return (
                turns not in (None, direction),
                shown is not condition,
                shown is not Condition.RUNNING,
            )

        turning = [
            (at, state.condition, state.direction)
            for at, (_, state) in enumerate(self.declared.states)
            if state.condition in TURNING
        ]
        return [self.declared.states[min(turning, key=unlikeness)[0]][0]] if turning else []


def _sequence(steps: tuple[VerbStep, ...]) -> list[_Sent]:
    """Return the steps that send, each with what is awaited before the next."""
    found: list[_Sent] = []
    for step in steps:
        if isinstance(step, Writes):
            found.append(_Sent(step, None))
        elif isinstance(step, Awaits) and found and found[-1].awaited is None:
            found[-1] = _Sent(found[-1].step, step.look)
    return found


def _after(values: dict[str, float], looks: list[Look]) -> dict[str, float]:
    for look in looks:
        values = shown_by(look, values)
    return values
