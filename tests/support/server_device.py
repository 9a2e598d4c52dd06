"""A device as a user declares it, for servers by other authors."""

from multidrop.core import NumberFormat
from multidrop.drive import Drive, Framing
from multidrop.drive.register import COIL, DISCRETE, HOLDING, INPUT, reading, setting


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
    """The same device, with a register that the server lacks."""

    absent = reading(300, "A")
