"""ProfileDrive: a simulated drive of a profile, whose registers are found by their roles."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar

from multidrop.sim.memory import MemoryCell
from multidrop.sim.motor_drive import MotorDrive


class ProfileDrive(MotorDrive):
    """A drive whose commands and monitors are roles: `heeds` and `tells` have them by name.

    `is_local` takes the command away from the line, as the keypad does. `power_cycle` loses all that is not
    a setting in EEPROM.
    """

    heeds: ClassVar[Mapping[str, Callable[[Any, int], None]]] = {}
    tells: ClassVar[Mapping[str, Callable[[Any], int]]] = {}  # raw counts

    def prepare(self) -> None:
        self.is_local = False
        self.word_before = 0  # the control word before the one that is heeded
        if "signature" in self.drive.registers:
            values: Any = self.drive.register("signature").values
            self["signature"] = next(iter(values))
        if "station" in self.drive.registers:
            self["station"] = self.drive.address

    def setpoint(self) -> float:
        held = self._known("reference") or 0.0
        if self.drive.register("reference").unit != "%":
            return held
        return held / 100 * self.motor.maximum_frequency

    def changed(self, cell: MemoryCell) -> None:
        self.set_up()
        if cell.register is not None and cell.register.name in self.heeds:
            self.heeds[cell.register.name](self, cell.raw)
            if cell.register.name == "control":
                self.word_before = cell.raw

    def refresh(self, cell: MemoryCell) -> None:
        register = cell.register
        if register is None or register in self._held:
            return
        if register.name in self.tells:
            self.memory.set_raw(register, self.tells[register.name](self))
        elif register.name == "reference_in_force":
            self.memory.set(register, self.memory.get(self.drive.register("reference")))
        else:
            super().refresh(cell)

    def rises(self, word: int, bits: int) -> bool:
        """Return True where the bits are set in this word, and were not in the one before."""
        return bool(word & bits) and not self.word_before & bits

    def power_cycle(self) -> None:
        """Take the mains away and give them back: commands, setpoint and faults are gone."""
        self.motor.coast()
        self.motor.reset()
        for name in ("control", "reset", "reference"):
            if name in self.drive.registers:
                self.memory.set_raw(self.drive.register(name), 0)
        self.word_before = 0
        self.set_up()
        self.powered_up()

    def powered_up(self) -> None:
        """Take the state that the drive has when its mains come."""
