"""Drive classes as users declare them: a fan, the device served by pymodbus, and an energy meter."""

from __future__ import annotations

from enum import IntEnum

from multidrop.core import NumberFormat
from multidrop.drive import Condition, Direction, Drive, Framing, Script, State, insist, read, write
from multidrop.drive.register import COIL, DISCRETE, HOLDING, INPUT, Register, reading, setting
from multidrop.drive.verbs import verb


class Run(IntEnum):
    OFF = 0
    ON = 1


class Fan(Drive):
    """A fan controller whose motor is started and stopped by one register, an ordinary setting."""

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


# ---- an energy meter with 39 floats, at the addresses of the Eastron SDM630 ----


_PHASES = ("voltage", "current", "power", "apparent_power", "reactive_power", "power_factor")
_TOTALS = {
    "power": 0x34,
    "apparent_power": 0x38,
    "reactive_power": 0x3C,
    "power_factor": 0x3E,
    "phase_angle": 0x42,
    "frequency": 0x46,
    "import_energy": 0x48,
    "export_energy": 0x4A,
    "import_reactive": 0x4C,
    "export_reactive": 0x4E,
    "energy": 0x156,
    "reactive_energy": 0x158,
}
_LAST = {"thd": 0xEA, "import": 0x15A, "export": 0x160}
ADDRESSES = {
    **{f"{name}_l{at % 3 + 1}": 2 * at for at, name in enumerate(name for name in _PHASES for _ in range(3))},
    **_TOTALS,
    **{f"{name}_l{phase}": first + 2 * phase - 2 for name, first in _LAST.items() for phase in (1, 2, 3)},
}


def floats() -> dict[str, Register[float]]:
    """Return the meter's float registers by name: new objects at each call, one set for each class."""
    return {
        name: reading(address, table=INPUT, number_format=NumberFormat.F32)
        for name, address in ADDRESSES.items()
    }


Meter: type[Drive] = type(
    "Meter",
    (Drive,),
    {
        "__doc__": "A meter with only its registers stated.",
        **floats(),
        "serial_number": reading(0xFC00, table=HOLDING, number_format=NumberFormat.U32),
    },
)

StatedMeter: type[Drive] = type(
    "StatedMeter",
    (Drive,),
    {
        "__doc__": "The same meter with its documented read limits.",
        "most_registers": {INPUT: 80, HOLDING: 80},
        "readable_gaps": {INPUT: range(0x180)},
        **floats(),
        "serial_number": reading(0xFC00, table=HOLDING, number_format=NumberFormat.U32),
    },
)
