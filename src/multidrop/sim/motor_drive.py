"""MotorDrive: a simulated drive with a motor behind its registers.

Settings of common names set the motor up, monitors of common names show its state. What a family has of
its own is in two tables: `obeys`, the commands of writes, and `shows`, the counts of reads; their keys
are (function code that reads the table, address).
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

_SETTINGS = ("acceleration_time", "deceleration_time", "maximum_frequency")


class MotorDrive(SimulatedDrive):
    """A drive with a motor. A monitor that is set from outside keeps that value."""

    obeys: ClassVar[Mapping[tuple[int, int], Callable[[Any, int], None]]] = {}
    shows: ClassVar[Mapping[tuple[int, int], Callable[[Any], int]]] = {}  # raw counts
    begins: ClassVar[Mapping[int, int]] = {}  # raw counts by the address that function 06 writes

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
        """Set initial state that the class does not declare."""

    def trip(self, code: int) -> None:
        """Provoke a fault by the family's code."""
        self.motor.trip(code)

    def pass_time(self, now: float) -> None:
        self.motor.run_to(now)

    def set_up(self) -> None:
        """Set the motor up as the registers say."""
        for name in _SETTINGS:
            value = self._known(name)
            if value:
                setattr(self.motor, name, value)
        self.motor.target = self.setpoint()

    def setpoint(self) -> float:
        """Return the frequency in Hz that the motor is to reach."""
        return self._known("frequency") or 0.0

    def _known(self, name: str) -> float | None:
        """Return the register's value, if the class has it and its scale is known."""
        register = self.drive.registers.get(name)
        if register is None or register.step is None:
            return None
        return float(self.memory.get(register))

    def run_or_stop(self, action: int, direction: int | None) -> None:
        """Carry out a control word's action, in the usual numbers: 0 none, 1 stop, 2 run, 3 jog."""
        if action == 1:
            self.motor.stop()
        elif action == 2:
            self.motor.run(direction)
        elif action == 3:
            self.motor.jog(direction)
        elif direction is not None:
            self.motor.direction = direction

    def word(self, address: int) -> int:
        """Return the holding register at this address; 0 where the class has none."""
        cell = self.memory.writable(0x06, address)
        return cell.raw if cell else 0

    def accept(self, cell: MemoryCell, raw: int) -> int:
        register = cell.register
        if register is not None and register.while_running is False and self.motor.energised:
            raise Refusal(Reason.LOCKED)
        return super().accept(cell, raw)

    def changed(self, cell: MemoryCell) -> None:
        self.set_up()
        command = self.obeys.get((cell.table.read or cell.table.write or 0, cell.address))
        if command is not None:
            command(self, cell.raw)

    def refresh(self, cell: MemoryCell) -> None:
        register = cell.register
        if register is None or register in self._held:
            return
        show = self.shows.get((register.table.read or 0, register.address))
        if show is not None:
            self.memory.set_raw(register, show(self))
        elif register.name in MONITORS and not register.writable:
            value = MONITORS[register.name](self.motor)
            if register.unit == "%":
                value *= 100 / RATED[register.name](self.motor.rating)
            self.memory.set(register, value)
