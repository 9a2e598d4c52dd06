"""A family of each profile, declared in Python, with the addresses printed in its public manual."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum, IntFlag
from functools import partial

from multidrop.core import Message, NumberFormat
from multidrop.drive import Drive
from multidrop.drive.register import Kept, command, reading, setting
from multidrop.families.profiles import CiA402, DanfossFC, Delta, Invt, Optidrive, Profidrive
from multidrop.families.registry import shipped_family


class AbbProfile(IntEnum):
    DRV_LIM = 0
    DRV_FULL = 2


class Acs355(Profidrive):
    """ABB ACS355: register 4xxxx is sent as xxxx - 1; 20000 is 1105."""

    title = "ABB ACS355"
    control = command(0, kept=Kept.RAM, place="40001")
    reference = setting(
        1, "%", step=0.005, span=(0, 100), number_format=NumberFormat.I16, kept=Kept.RAM, place="40002"
    )
    status = reading(3, place="40004")
    output_frequency = reading(102, "Hz", step=0.1, place="0103")
    fault = reading(400, place="0401")
    station = reading(5301, place="5302")
    signature = reading(5304, AbbProfile, place="5305")


class V20(Profidrive):
    """Siemens V20: 40100 STW, 40101 HSW (4000H is P2000), 40110 ZSW, 40111 HIW."""

    title = "SINAMICS V20"
    control = command(99, kept=Kept.RAM)
    reference = setting(
        100, "%", step=100 / 0x4000, span=(0, 100), number_format=NumberFormat.I16, kept=Kept.RAM
    )
    status = reading(109)
    output_frequency = reading(110, "%", step=100 / 0x4000, number_format=NumberFormat.I16)


class ExtraBits(IntFlag):
    REVERSE = 1 << 11


class Atv320(CiA402):
    """Schneider ATV320: 8501 CMD, 8502 LFR, 3201 ETA, 3202 rFr."""

    title = "Altivar 320"
    control = command(8501, ExtraBits, kept=Kept.RAM)
    reference = setting(8502, "Hz", step=0.1, span=(0, 500), kept=Kept.RAM)
    status = reading(3201)
    output_frequency = reading(3202, "Hz", step=0.1)


class FcProtocol(IntEnum):
    MODBUS_RTU = 2


class Fc51(DanfossFC):
    """Danfoss FC 51: register 50000 is sent as 49999; 4000H is 3-03."""

    title = "Danfoss FC 51"
    control = command(49999, kept=Kept.RAM)
    reference = command(50009, "%", step=100 / 0x4000, span=(0, 100), kept=Kept.RAM)
    status = reading(50199)
    output_frequency = reading(16129, "Hz", step=0.1)
    station = reading(8309)
    signature = reading(8299, FcProtocol)


class VfdEl(Delta):
    """Delta VFD-EL: 2000H, 2001H, 2002H, 2100H to 2103H."""

    title = "Delta VFD-EL"
    control = command(0x2000, kept=Kept.RAM)
    reference = command(0x2001, "Hz", step=0.01, span=(0, 600), kept=Kept.RAM)
    reset = command(0x2002, kept=Kept.RAM)
    fault = reading(0x2100)
    status = reading(0x2101)
    reference_in_force = reading(0x2102, "Hz", step=0.01)
    output_frequency = reading(0x2103, "Hz", step=0.01)
    station = reading(0x0900)


class GoodriveDevice(IntEnum):
    GD200L = 0x010C


class Goodrive(Invt):
    """INVT Goodrive: 2000H, 2001H, 2100H, 2102H, 2103H, 3000H."""

    title = "INVT Goodrive 200L"
    control = command(0x2000, kept=Kept.RAM)
    reference = setting(0x2001, "Hz", step=0.01, span=(0, 400), kept=Kept.RAM)
    status = reading(0x2100)
    fault = reading(0x2102)
    signature = reading(0x2103, GoodriveDevice)
    output_frequency = reading(0x3000, "Hz", step=0.01)


class E3Source(IntEnum):
    MODBUS = 3
    MODBUS_AND_RAMP = 4


class OptidriveE3(Optidrive):
    """Invertek Optidrive E3: register 1 is sent as 0; P-12 is register 140."""

    title = "Optidrive E3"
    control = command(0, kept=Kept.RAM)
    reference = setting(1, "Hz", step=0.1, span=(0, 500), kept=Kept.RAM)
    status = reading(5)
    output_frequency = reading(6, "Hz", step=0.1)
    signature = reading(139, E3Source)


MAKE: dict[str, Callable[[int], Drive]] = {
    "abb-acs355": lambda address: Acs355(address, maximum_frequency=50),
    "siemens-v20": lambda address: V20(address, maximum_frequency=50),
    "schneider-atv320": Atv320,
    "danfoss-fc51": lambda address: Fc51(address, maximum_frequency=50),
    "delta-vfd-el": VfdEl,
    "invt-goodrive": Goodrive,
    "optidrive-e3": OptidriveE3,
}


def _word(request: Message) -> int:
    return int.from_bytes(request.data[:2])


# Writes that start the motor, by address and word, in the manuals' words; typed manually.
STARTS: dict[str, Callable[[Message], bool]] = {
    "abb-acs355": lambda each: each.start == 0 and _word(each) & 0x09 == 0x09,
    "siemens-v20": lambda each: each.start == 99 and _word(each) & 0x09 == 0x09,
    "schneider-atv320": lambda each: each.start == 8501 and _word(each) & 0x0F == 0x0F,
    "danfoss-fc51": lambda each: each.start == 49999 and bool(_word(each) & 0x0140),
    "delta-vfd-el": lambda each: each.start == 0x2000 and bool(_word(each) & 0x02),
    "invt-goodrive": lambda each: each.start == 0x2000 and _word(each) in (1, 2, 3, 4),
    "optidrive-e3": lambda each: each.start == 0 and bool(_word(each) & 0x01),
}

# The families that ship as files, each with the class above that has the same words.
SHIPPED_AS = {
    "abb-acs355": "abb-acs355",
    "danfoss-fc51": "danfoss-fc51",
    "delta-ms300": "delta-vfd-el",
    "delta-vfd-el": "delta-vfd-el",
    "optidrive-e3": "optidrive-e3",
}
KIND = {**{name: name for name in MAKE}, **{f"shipped {name}": kind for name, kind in SHIPPED_AS.items()}}


def shipped(name: str, address: int) -> Drive:
    """Return a drive of a shipped family as its owner declares it."""
    of_percent = {"maximum_frequency": 50} if name in ("abb-acs355", "danfoss-fc51") else {}
    return shipped_family(name)(address, confirmed=1, **of_percent)


ALL = {
    **MAKE,
    **{f"shipped {name}": partial(shipped, name) for name in SHIPPED_AS},
}
