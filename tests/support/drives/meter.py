"""An energy meter with 39 floats and a serial number, at the addresses of the Eastron SDM630's document."""

from __future__ import annotations

from multidrop.core import NumberFormat
from multidrop.drive import Drive
from multidrop.drive.register import HOLDING, INPUT, Register, reading

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
    """Return the meter's float registers by name, as new objects for each class that declares them."""
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
