"""Drive classes as users declare them: a fan, and the device served by pymodbus."""

from __future__ import annotations

from enum import IntEnum

from multidrop.core import NumberFormat
from multidrop.drive import Condition, Direction, Drive, Framing, Script, State, insist, read, write
from multidrop.drive.register import COIL, DISCRETE, HOLDING, INPUT, reading, setting
from multidrop.drive.verbs import verb


class Run(IntEnum):
    OFF = 0
    ON = 1


class Fan(Drive):
    """A fan controller that starts and stops with one ordinary setting."""

    model = "fan"
    speed = reading(0x0010, "rpm", step=1)
    current = reading(0x0011, "A", step=0.01)
    run = setting(0x0030, Run)

    @verb
    def start(self, direction: Direction | None = None) -> Script[None]:
        yield from read(self.speed)
        yield from write(self.run, Run.ON)

    @verb
    def stop(self) -> Script[None]:
        yield from insist(self.run, Run.OFF)
        yield from self._stopped(self._stands, 5.0)

    def _stands(self) -> Script[bool]:
        return (yield from read(self.speed)) == 0

    @verb
    def state(self) -> Script[State]:
        turns = (yield from read(self.speed)) > 0
        return State(Condition.RUNNING if turns else Condition.STOPPED)


class Device(Drive):
    """Three input registers, two settings, a relay and a door."""

    framings = (Framing.RTU, Framing.ASCII)
    response_timeout = 0.2
    most_registers = {HOLDING: 16, INPUT: 16}

    current = reading(10, "A", step=0.1, table=INPUT)
    voltage = reading(11, "V", table=INPUT)
    temperature = reading(12, "degC", table=INPUT, number_format=NumberFormat.I16)
    frequency = setting(20, "Hz", step=0.01, span=(0, 400))
    energy = setting(22, "kWh", step=0.01, number_format=NumberFormat.U32)
    relay = setting(5, table=COIL)
    door = reading(5, table=DISCRETE)


class Mistaken(Device):
    """The same device, declared with an additional register that the server lacks."""

    absent = reading(300, "A")
