"""A drive of each family, and what starts its motor."""

from __future__ import annotations

from collections.abc import Callable

from multidrop.core import Message
from multidrop.drive import Drive
from multidrop.drives import MODELS, YD1000, DelixiModbus, DelixiNative, ErmanERG220, InnovertIBD, InvtCHE

MAKE: dict[str, Callable[[int], Drive]] = {
    "erman-er-g-220": ErmanERG220,
    "invt-che": lambda address: InvtCHE(address, maximum_frequency=50),
    "innovert-ibd": InnovertIBD,
    "delixi-modbus": lambda address: DelixiModbus(address, framing="rtu"),
    "delixi-native": DelixiNative,
    "yd1000": YD1000,
}
assert set(MAKE) == set(MODELS)

# What starts the motor, of each family, by address and value, in the documents' words.
STARTS: dict[str, Callable[[Message], bool]] = {
    "erman-er-g-220": lambda it: it.function in (5, 15) and it.start == 0 and it.data != b"\0\0",
    "invt-che": lambda it: it.start == 0x1000 and it.data[-1] in (1, 2, 3, 4),
    "innovert-ibd": lambda it: it.start == 0x2000 and bool(it.data[-1] & 2),
    "delixi-modbus": lambda it: it.start == 0x2000 and bool(it.data[-1] & 2),
    "delixi-native": lambda it: it.function == 2 and it.start in (2, 3),
    "yd1000": lambda it: it.start == 0x1000 and (bool(it.data[0] & 0x05) or not it.data[0] & 0x80),
}
