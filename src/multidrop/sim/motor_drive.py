"""MotorDrive: a simulated drive with a motor behind its registers.

Registers with usual names need no code: a setting such as `acceleration_time` configures the motor, and a
reading such as `output_current` shows its state. A subclass handles the other registers of its family in two
tables, by register name. A function in `obeys` is called after a write to its register. A function in `shows`
returns the number that a read of its register returns.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar

from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.sim.drive import SimulatedDrive
from multidrop.sim.memory import MemoryCell
from multidrop.sim.motor import MONITORS, RATED, Motor, Rating
from multidrop.sim.protocol import Reason, Refusal

COMMANDS: Mapping[str, Callable[[Motor], None]] = {  # maps the name of a control word to its action
    "FORWARD": lambda motor: motor.run(1),
    "REVERSE": lambda motor: motor.run(-1),
    "JOG_FORWARD": lambda motor: motor.jog(1),
    "JOG_REVERSE": lambda motor: motor.jog(-1),
    "STOP": lambda motor: motor.stop(),
    "STOP_JOG": lambda motor: motor.stop(),
    "COAST": lambda motor: motor.coast(),
    "RESET_FAULT": lambda motor: motor.reset(),
}
_SETTINGS = ("acceleration_time", "deceleration_time", "maximum_frequency")


class MotorDrive(SimulatedDrive):
    """A simulated drive with a motor. A monitor register set by `drive[name] = value` keeps that value."""

    obeys: ClassVar[Mapping[str, Callable[[Any, int], None]]] = {}
    shows: ClassVar[
        Mapping[str, Callable[[Any], int]]
    ] = {}  # maps a register's name to a function that returns its raw count
    begins: ClassVar[Mapping[int, int]] = {}  # address of holding register: raw count at power-up

    def __init__(
        self, drive: Drive, *, response_delay: float | None = None, rating: Rating | None = None
    ) -> None:
        super().__init__(drive, response_delay=response_delay)
        self.motor = Motor(rating)
        most = drive.option.get("maximum_frequency")
        self.motor.maximum_frequency = most or self.motor.rating.frequency
        self._held: set[Register[Any]] = set()
        for name in _SETTINGS:
            register = drive.registers.get(name)
            if register is not None and register.default is None:
                self.memory.set(register, getattr(self.motor, name))
        for address, raw in self.begins.items():
            cell = self.memory.writable(0x06, address)
            if cell is not None:
                cell.raw = raw
        self.prepare()
        self.set_up()

    def __setitem__(self, name: str, value: float) -> None:
        self._held.add(self.drive.register(name))
        super().__setitem__(name, value)

    def prepare(self) -> None:
        """Set up initial state that the drive's class does not declare."""

    def trip(self, code: int) -> None:
        """Trip the motor with this fault code of the family."""
        self.motor.trip(code)

    def pass_time(self, now: float) -> None:
        self.motor.run_to(now)

    def set_up(self) -> None:
        """Configure the motor from the drive's settings."""
        for name in _SETTINGS:
            value = self._known(name)
            if value:
                setattr(self.motor, name, value)
        self.motor.target = self.setpoint()

    def setpoint(self) -> float:
        """Return the frequency setpoint in Hz."""
        return self._known("frequency") or 0.0

    def _known(self, name: str) -> float | None:
        """Return the register's value; None if the class lacks the register or its scale is unknown."""
        register = self.drive.registers.get(name)
        if register is None or register.step is None:
            return None
        return float(self.memory.get(register))

    def run_or_stop(self, action: int, direction: int | None) -> None:
        """Carry out the action of a control word: 0 none, 1 stop, 2 run, 3 jog."""
        if action == 1:
            self.motor.stop()
        elif action == 2:
            self.motor.run(direction)
        elif action == 3:
            self.motor.jog(direction)
        elif direction is not None:
            self.motor.direction = direction

    def carry_out_named(self, raw: int) -> None:
        """Carry out the named control word with this raw count; see COMMANDS."""
        COMMANDS[self.drive.register("control").decode(raw).name](self.motor)

    def word(self, address: int) -> int:
        """Return the raw count of the writable holding register at this address; 0 if there is none."""
        cell = self.memory.writable(0x06, address)
        return cell.raw if cell else 0

    def accept(self, cell: MemoryCell, raw: int) -> int:
        register = cell.register
        if register is not None and register.while_running is False and self.motor.energised:
            raise Refusal(Reason.LOCKED)
        return super().accept(cell, raw)

    def changed(self, cell: MemoryCell) -> None:
        self.set_up()
        if cell.name in self.obeys:
            self.obeys[cell.name](self, cell.raw)

    def refresh(self, cell: MemoryCell) -> None:
        register = cell.register
        if register is None or register in self._held:
            return
        if register.name in self.shows:
            self.memory.set_raw(register, self.shows[register.name](self))
        elif register.name in MONITORS and not register.writable:
            value = MONITORS[register.name](self.motor)
            if register.unit == "%":
                value *= 100 / RATED[register.name](self.motor.rating)
            self.memory.set(register, value)


class ProfileDrive(MotorDrive):
    """A simulated drive of a profile; its registers are named by their roles.

    While `is_local` is set, the keypad is in control and commands from the line are ignored. After a
    `power_cycle` only settings in EEPROM are kept.
    """

    is_local = False
    word_before = 0  # the previous control word

    def prepare(self) -> None:
        if "signature" in self.drive.registers:
            values: Any = self.drive.register("signature").values
            self["signature"] = next(iter(values))
        if "station" in self.drive.registers:
            self["station"] = self.drive.address
        self.powered_up()

    def setpoint(self) -> float:
        held = self._known("reference") or 0.0
        if self.drive.register("reference").unit != "%":
            return held
        return held / 100 * self.motor.maximum_frequency

    def changed(self, cell: MemoryCell) -> None:
        super().changed(cell)
        if cell.name == "control":
            self.word_before = cell.raw

    def refresh(self, cell: MemoryCell) -> None:
        super().refresh(cell)
        register = cell.register
        if register and register.name == "reference_in_force" and register not in self._held:
            self.memory.set(register, self.memory.get(self.drive.register("reference")))

    def rises(self, word: int, bits: int) -> bool:
        """Return True if this control word sets one of the bits, and the previous one set none of them."""
        return bool(word & bits) and not self.word_before & bits

    def power_cycle(self) -> None:
        """Switch the mains off and on, which clears commands, setpoint and faults."""
        self.motor.coast()
        self.motor.reset()
        for name in ("control", "reset", "reference"):
            if name in self.drive.registers:
                self.memory.set_raw(self.drive.register(name), 0)
        self.word_before = 0
        self.set_up()
        self.powered_up()

    def powered_up(self) -> None:
        """Set the drive's state after power-up."""
