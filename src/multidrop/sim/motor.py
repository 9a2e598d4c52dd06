"""A simulated motor with its power stage, and MotorDrive: a simulated drive with such a motor.

Only `run` and `jog` start the motor, and not during a fault. Time is an argument.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, ClassVar

from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.sim.drive import Reason, Refusal, SimulatedDrive
from multidrop.sim.memory import MemoryCell

MAGNETISING = 0.3  # no-load current as a fraction of the rated current
ACCELERATING_TORQUE = 0.5  # fraction of the rated torque that acceleration adds to the torque of the load
BRAKING_TORQUE = 0.3
SLIP = 0.04  # relative slip at the rated torque
HEATING = 35.0  # rise of the heatsink temperature at the rated current, in K
WARMING_TIME = 120.0  # thermal time constant of the heatsink in s
RUN_OUT_TIME = 10.0  # time in s in which the motor coasts from the rated frequency to rest
REGENERATION = 0.06  # relative rise of the DC bus voltage while the motor brakes
SAG = 0.02  # relative fall of the DC bus voltage at the rated current


class Phase(Enum):
    STOPPED = 0
    CONSTANT = 1
    ACCELERATING = 2
    DECELERATING = 3


@dataclass(frozen=True)
class Rating:
    """The rated values on the nameplate of a motor."""

    frequency: float = 50.0  # Hz
    voltage: float = 400.0  # rated voltage in V, which is also the mains voltage
    current: float = 5.0  # A
    power: float = 2.2  # kW
    torque: float = 14.6  # Nm
    pole_pairs: int = 2


class Motor:
    """The state of one motor at the time of the last call of `run_to`.

    `target`, `acceleration_time`, `deceleration_time`, `maximum_frequency` and `load` may be changed at any
    time. The ramp times, in s, are those from 0 to the maximum frequency, and back to 0.
    """

    def __init__(self, rating: Rating | None = None) -> None:
        self.rating = rating or Rating()
        self.now = 0.0
        self.target = 0.0  # frequency in Hz to run at; a negative value reverses `direction`
        self.jog_frequency = 5.0
        self.maximum_frequency = self.rating.frequency
        self.acceleration_time = 10.0
        self.deceleration_time = 10.0
        self.load = 0.4  # torque of the load as a fraction of the rated torque
        self.ambient = 25.0  # degrees Celsius
        self.direction = 1  # 1 forward, -1 reverse
        self.frequency = 0.0  # output frequency in Hz, negative in reverse
        self.shaft = 0.0  # rotor speed in Hz
        self.energised = False
        self.heatsink = self.ambient
        self.run_seconds = 0.0
        self.fault = 0
        self.faults: deque[int] = deque(maxlen=4)  # fault codes, the latest first
        self._goal: float | None = 0.0  # frequency in Hz at the end of the ramp; None: `target`
        self._brakes = False  # True while the motor is held with direct current

    def run(self, direction: int | None = None) -> None:
        """Run at `target`, which may change at any time. Without `direction`, keep the present direction."""
        self._start(direction, None)

    def jog(self, direction: int | None = None) -> None:
        self._start(direction, self.jog_frequency)

    def _start(self, direction: int | None, goal: float | None) -> None:
        if self.fault:
            return
        self.direction = direction or self.direction
        self.energised = True
        self._goal = goal
        self._brakes = False

    def stop(self) -> None:
        """Ramp down, then switch the voltage off."""
        self._goal = 0.0
        self._brakes = False

    def brake(self) -> None:
        """Hold the motor with direct current until the next command."""
        if self.fault:
            return
        self.coast()
        self._brakes = self.energised = True

    def coast(self) -> None:
        """Switch the voltage off; the shaft coasts to rest."""
        self._goal = 0.0
        self._brakes = False
        self.frequency = 0.0
        self.energised = False

    def trip(self, code: int) -> None:
        """Switch the voltage off because of a fault. The motor stays off until `reset` is called."""
        self.coast()
        self.fault = code
        self.faults.appendleft(code)

    def reset(self) -> None:
        """Clear the fault; the motor stays off."""
        self.fault = 0

    def run_to(self, now: float) -> None:
        """Advance the motor's state to the time `now` in s."""
        seconds = now - self.now
        if seconds <= 0:
            return
        self.now = now
        if self.energised:
            self.run_seconds += seconds
            self._ramp(seconds)
            self.shaft = self.frequency
        else:
            lost = seconds * self.rating.frequency / RUN_OUT_TIME
            self.shaft = math.copysign(max(abs(self.shaft) - lost, 0.0), self.shaft)
        settled = self.ambient + HEATING * (self.current / self.rating.current) ** 2
        self.heatsink = settled + (self.heatsink - settled) * math.exp(-seconds / WARMING_TIME)

    def _ramp(self, seconds: float) -> None:
        goal = self.goal
        if self.frequency * goal < 0:
            seconds = self._approach(0.0, self.deceleration_time, seconds)
        slowing = abs(goal) < abs(self.frequency)
        self._approach(goal, self.deceleration_time if slowing else self.acceleration_time, seconds)
        if self._goal == 0.0 and self.frequency == 0.0 and not self._brakes:
            self.energised = False

    def _approach(self, goal: float, ramp_time: float, seconds: float) -> float:
        """Ramp towards `goal`, in Hz, for at most `seconds`.

        Return the seconds that remain when `goal` is reached, or 0.
        """
        distance = abs(goal - self.frequency)
        needed = distance * ramp_time / self.maximum_frequency
        if needed <= seconds:
            self.frequency = goal
            return seconds - needed
        self.frequency += math.copysign(distance * seconds / needed, goal - self.frequency)
        return 0.0

    def fault_record(self, number: int) -> int:
        """Return the code of a fault: 1 is the latest, 2 the one before.

        Return 0 if there were fewer faults.
        """
        return self.faults[number - 1] if number <= len(self.faults) else 0

    @property
    def goal(self) -> float:
        """The output frequency in Hz at the end of the ramp, negative in reverse."""
        wanted = self.target if self._goal is None else self._goal
        return self.direction * max(-self.maximum_frequency, min(wanted, self.maximum_frequency))

    @property
    def phase(self) -> Phase:
        if not self.energised:
            return Phase.STOPPED
        if self.frequency == self.goal:
            return Phase.CONSTANT
        if self.frequency * self.goal < 0 or abs(self.goal) < abs(self.frequency):
            return Phase.DECELERATING
        return Phase.ACCELERATING

    @property
    def torque(self) -> float:
        """Torque as a fraction of the rated torque. It is negative while the motor brakes."""
        if not self.energised:
            return 0.0
        extra = {Phase.ACCELERATING: ACCELERATING_TORQUE, Phase.DECELERATING: -BRAKING_TORQUE}
        return self.load + extra.get(self.phase, 0.0)

    @property
    def current(self) -> float:
        return self.rating.current * math.hypot(MAGNETISING, self.torque) if self.energised else 0.0

    @property
    def voltage(self) -> float:
        """Output voltage in V, proportional to the frequency up to the rated frequency (V/f)."""
        return self.rating.voltage * min(1.0, abs(self.frequency) / self.rating.frequency)

    @property
    def power(self) -> float:
        return self.rating.power * self.torque * abs(self.frequency) / self.rating.frequency

    @property
    def dc_bus_voltage(self) -> float:
        idle = self.rating.voltage * math.sqrt(2)
        if self.phase is Phase.DECELERATING:
            return idle * (1 + REGENERATION)
        return idle * (1 - SAG * self.current / self.rating.current)

    @property
    def speed(self) -> float:
        """Speed of the shaft in rpm, never negative."""
        return abs(self.shaft) * 60 / self.rating.pole_pairs * (1 - SLIP * max(self.torque, 0.0))


# functions that compute a register's value, by register name
MONITORS: Mapping[str, Callable[[Motor], float]] = {
    "output_frequency": lambda motor: abs(motor.frequency),
    "reference_frequency": lambda motor: abs(motor.target),
    "output_current": lambda motor: motor.current,
    "output_voltage": lambda motor: motor.voltage,
    "output_power": lambda motor: motor.power,
    "output_torque": lambda motor: motor.torque * motor.rating.torque,
    "dc_bus_voltage": lambda motor: motor.dc_bus_voltage,
    "heatsink_temperature": lambda motor: motor.heatsink,
    "motor_speed": lambda motor: motor.speed,
    "run_hours": lambda motor: motor.run_seconds // 3600,
    "fault": lambda motor: motor.fault,
    "last_fault": lambda motor: motor.fault_record(1),
} | {f"fault_record_{nth}": lambda motor, nth=nth: motor.fault_record(nth) for nth in range(1, 5)}

# the motor's rated values, which are 100 % for registers in percent, by name of the register
RATED: Mapping[str, Callable[[Rating], float]] = {
    "output_frequency": lambda rating: rating.frequency,
    "reference_frequency": lambda rating: rating.frequency,
    "output_current": lambda rating: rating.current,
    "output_voltage": lambda rating: rating.voltage,
    "output_power": lambda rating: rating.power,
    "output_torque": lambda rating: rating.torque,
    "dc_bus_voltage": lambda rating: rating.voltage * math.sqrt(2),
}


COMMANDS: Mapping[str, Callable[[Motor], None]] = {  # effects on the motor, by name of the control word
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
    """A simulated drive with a motor. A register that is set with `drive[name] = value` keeps that value.

    Settings such as `acceleration_time` configure the motor, and readings such as `output_current` show its
    state. Other registers have functions, by register name: `write_handlers` get the raw count that was
    written, and `read_handlers` return the raw count to read.
    """

    write_handlers: ClassVar[Mapping[str, Callable[[Any, int], None]]] = {}
    read_handlers: ClassVar[Mapping[str, Callable[[Any], int]]] = {}
    # raw counts after power-up, by address of the holding register
    initial_values: ClassVar[Mapping[int, int]] = {}

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
        for address, raw in self.initial_values.items():
            cell = self.memory.writable(0x06, address)
            if cell is not None:
                cell.raw = raw
        self.prepare()
        self.set_up()

    def __setitem__(self, name: str, value: float) -> None:
        self._held.add(self.drive.register(name))
        super().__setitem__(name, value)

    def prepare(self) -> None:
        """Set up initial state that the drive class does not declare."""

    def trip(self, code: int) -> None:
        """Trip the motor with this fault code of the drive's family."""
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
        """Return the register's value; None if the drive lacks the register or its scale is unknown."""
        register = self.drive.registers.get(name)
        if register is None or register.step is None:
            return None
        return float(self.memory.get(register))

    def run_or_stop(self, action: int, direction: int | None) -> None:
        """Carry out an action: 0 none, 1 stop, 2 run, 3 jog."""
        if action == 1:
            self.motor.stop()
        elif action == 2:
            self.motor.run(direction)
        elif action == 3:
            self.motor.jog(direction)
        elif direction is not None:
            self.motor.direction = direction

    def carry_out_named(self, raw: int) -> None:
        """Carry out the control word with this raw count."""
        COMMANDS[self.drive.register("control").decode(raw).name](self.motor)

    def word(self, address: int) -> int:
        """Return the raw count of the writable holding register at this address; 0 if none is there."""
        cell = self.memory.writable(0x06, address)
        return cell.raw if cell else 0

    def accept(self, cell: MemoryCell, raw: int) -> int:
        register = cell.register
        if register is not None and register.while_running is False and self.motor.energised:
            raise Refusal(Reason.LOCKED)
        return super().accept(cell, raw)

    def changed(self, cell: MemoryCell) -> None:
        self.set_up()
        if cell.name in self.write_handlers:
            self.write_handlers[cell.name](self, cell.raw)

    def refresh(self, cell: MemoryCell) -> None:
        register = cell.register
        if register is None or register in self._held:
            return
        if register.name in self.read_handlers:
            self.memory.set_raw(register, self.read_handlers[register.name](self))
        elif register.name in MONITORS and not register.writable:
            value = MONITORS[register.name](self.motor)
            if register.unit == "%":
                value *= 100 / RATED[register.name](self.motor.rating)
            self.memory.set(register, value)
