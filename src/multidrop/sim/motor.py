"""A motor and the power part that feeds it: ramps, volts and amperes, heat, faults.

Only physics: no registers, and time is an argument. Only `run` and `jog` start the motor, and not during a
fault.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum

MAGNETISING = 0.3  # current at no load, as a part of the rated current
ACCELERATING_TORQUE = 0.5  # part of the rated torque, added to the load
BRAKING_TORQUE = 0.3
SLIP = 0.04  # at rated torque
HEATING = 35.0  # degrees above ambient at rated current
WARMING_TIME = 120.0  # s
RUN_OUT_TIME = 10.0  # s until the shaft stands still without voltage, from the rated frequency
REGENERATION = 0.06  # rise of the DC bus while braking
SAG = 0.02  # fall of the DC bus at rated current


class Phase(Enum):
    STOPPED = 0
    CONSTANT = 1
    ACCELERATING = 2
    DECELERATING = 3


@dataclass(frozen=True)
class Rating:
    """The name plate of a motor."""

    frequency: float = 50.0  # Hz
    voltage: float = 400.0  # V, also of the mains
    current: float = 5.0  # A
    power: float = 2.2  # kW
    torque: float = 14.6  # Nm
    pole_pairs: int = 2


class Motor:
    """One motor on its drive, at the time of the last `run_to`.

    `target`, `acceleration_time`, `deceleration_time`, `maximum_frequency` and `load` may be
    changed at any time; the ramp times are those from 0 to the maximum frequency and back.
    """

    def __init__(self, rating: Rating | None = None, *, now: float = 0.0) -> None:
        self.rating = rating or Rating()
        self.now = now
        self.target = 0.0  # Hz; negative: in the other direction
        self.jog_frequency = 5.0
        self.maximum_frequency = self.rating.frequency
        self.acceleration_time = 10.0
        self.deceleration_time = 10.0
        self.load = 0.4  # part of the rated torque
        self.ambient = 25.0  # degrees Celsius
        self.direction = 1  # or -1
        self.frequency = 0.0  # Hz at the output, negative backwards
        self.shaft = 0.0  # speed of the rotor, in Hz
        self.energised = False
        self.heatsink = self.ambient
        self.run_seconds = 0.0
        self.fault = 0
        self.faults: deque[int] = deque(maxlen=4)  # the latest first
        self._goal: float | None = 0.0  # Hz; None: the target
        self._brakes = False  # True while direct current brakes the motor

    def run(self, direction: int | None = None) -> None:
        """Run at `target`, which may change meanwhile. Without `direction`, keep the current one."""
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
        """Hold the motor by direct current until the next command."""
        if self.fault:
            return
        self.coast()
        self._brakes = self.energised = True

    def coast(self) -> None:
        """Switch the voltage off and let the shaft run out."""
        self._goal = 0.0
        self._brakes = False
        self.frequency = 0.0
        self.energised = False

    def trip(self, code: int) -> None:
        """Coast because of a fault; the motor stays off until `reset`."""
        self.coast()
        self.fault = code
        self.faults.appendleft(code)

    def reset(self) -> None:
        """Clear the fault; the motor stays off."""
        self.fault = 0

    def run_to(self, now: float) -> None:
        """Let time pass until `now`."""
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
        """Ramp towards `goal` for at most `seconds`; return the seconds that are left."""
        distance = abs(goal - self.frequency)
        needed = distance * ramp_time / self.maximum_frequency
        if needed <= seconds:
            self.frequency = goal
            return seconds - needed
        self.frequency += math.copysign(distance * seconds / needed, goal - self.frequency)
        return 0.0

    def fault_record(self, number: int) -> int:
        """Return the code of the fault with this number (1: the latest); 0 if there is none."""
        return self.faults[number - 1] if number <= len(self.faults) else 0

    @property
    def goal(self) -> float:
        """The frequency in Hz at the end of the ramp, negative backwards."""
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
        """Part of the rated torque; negative while it brakes."""
        if not self.energised:
            return 0.0
        extra = {Phase.ACCELERATING: ACCELERATING_TORQUE, Phase.DECELERATING: -BRAKING_TORQUE}
        return self.load + extra.get(self.phase, 0.0)

    @property
    def current(self) -> float:
        return self.rating.current * math.hypot(MAGNETISING, self.torque) if self.energised else 0.0

    @property
    def voltage(self) -> float:
        """Output in V, proportional to the frequency up to the rated one (V/f)."""
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
        """Speed of the shaft in rpm, without direction."""
        return abs(self.shaft) * 60 / self.rating.pole_pairs * (1 - SLIP * max(self.torque, 0.0))


# Values of monitor registers, by their names.
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

# Values that mean 100 % if the register's unit is %.
RATED: Mapping[str, Callable[[Rating], float]] = {
    "output_frequency": lambda rating: rating.frequency,
    "reference_frequency": lambda rating: rating.frequency,
    "output_current": lambda rating: rating.current,
    "output_voltage": lambda rating: rating.voltage,
    "output_power": lambda rating: rating.power,
    "output_torque": lambda rating: rating.torque,
    "dc_bus_voltage": lambda rating: rating.voltage * math.sqrt(2),
}
