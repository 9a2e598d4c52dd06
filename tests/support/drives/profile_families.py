"""Shipped families that command motors, with the control words that start them; a meter's family file."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum, IntFlag
from functools import partial
from pathlib import Path
from typing import Any

from multidrop import reading, setting
from multidrop.core import Framing, Message, NumberFormat
from multidrop.drive import COIL, DISCRETE, HOLDING, INPUT, Drive, Kept, Option
from multidrop.families.profiles import Profile
from multidrop.families.registry import SHIPPED, shipped_family

READ_ONLY = ("erman-er-g-220-03", "erman-er-g-220-05")
EXTENDED = {"erman-er-g-220-02": "erman-er-g-220", "innovert-idd-mini-plus": "innovert-ibd"}
COMMANDED = tuple(name for name in SHIPPED if name not in READ_ONLY)
OF_PROFILE = tuple(name for name in COMMANDED if name not in EXTENDED)


def shipped(name: str, address: int) -> Drive:
    """Return a drive of a shipped family with the options that its owner must set, such as `confirmed`."""
    family = shipped_family(name)
    is_percent = issubclass(family, Profile) and family.reference.unit == "%"
    options = {"maximum_frequency": 50} if is_percent else {}
    return family(address, confirmed=1, **options)


ALL: dict[str, Callable[[int], Drive]] = {name: partial(shipped, name) for name in OF_PROFILE}

# One family of each profile, for tests that run once per profile.
REPRESENTATIVES = (
    *("abb-acs355", "siemens-v20", "schneider-atv320", "danfoss-fc51", "delta-vfd-el", "invt-goodrive"),
    *("delixi-e", "powtran-pi130", "optidrive-e3", "yaskawa-a1000"),
)
MAKE = {name: ALL[name] for name in REPRESENTATIVES}

# Family classes that tests subclass.
Acs355: Any = shipped_family("abb-acs355")
Atv320: Any = shipped_family("schneider-atv320")
Fc51: Any = shipped_family("danfoss-fc51")
Goodrive: Any = shipped_family("invt-goodrive")
VfdEl: Any = shipped_family("delta-vfd-el")


def _word(request: Message) -> int:
    return int.from_bytes(request.data[:2])


def _at(address: int, starts: Callable[[int], bool]) -> Callable[[Message], bool]:
    return lambda each: each.start == address and starts(_word(each))


def _bit_1(word: int) -> bool:
    return bool(word & 0x02)


def _jog_or_run(word: int) -> bool:
    return word in (1, 2, 3, 4)


# Writes (address, control word) that start the motor, typed from the manuals.
STARTS: dict[str, Callable[[Message], bool]] = {
    "abb-acs355": _at(0, lambda word: word & 0x09 == 0x09),
    "siemens-v20": _at(99, lambda word: word & 0x09 == 0x09),
    "schneider-atv320": _at(8501, lambda word: word & 0x0F == 0x0F),
    "danfoss-fc51": _at(49999, lambda word: bool(word & 0x0140)),
    "delta-vfd-el": _at(0x2000, _bit_1),
    "delta-ms300": _at(0x2000, _bit_1),
    "delta-cp2000": _at(0x2000, _bit_1),
    "invt-goodrive": _at(0x2000, _jog_or_run),
    "invt-chf100a": _at(0x1000, _jog_or_run),
    "fuling-dzb": _at(0x1000, _jog_or_run),
    "delixi-e": _at(0xA000, _jog_or_run),
    "powtran-pi130": _at(0x2000, _jog_or_run),
    "optidrive-e3": _at(0, lambda word: bool(word & 0x01)),
    "yaskawa-a1000": _at(1, lambda word: bool(word & 0x03)),
    "yaskawa-v1000": _at(1, lambda word: bool(word & 0x03)),
}


# ---- family files for tests: a meter with every kind of entry, and its equivalent Python class ----


METER = """\
[family]
title = "Meter M-1"
manual = "Meter M-1, protocol 2"
counts_from = 0
addresses = [1, 99]
baudrates = [9600, 19200]
formats = ["8E1", "8N1"]
together = { input = 40, holding = 20 }
gaps = { input = [0x0000, 0x000F] }
silence = "5 ms"
response_delay = "10 ms"
response_timeout = "400 ms"
exceptions = { 1 = "unknown function", 0x80 = "locked" }
registers = ["meter.csv"]

[default]
table = "input"
number_format = "F32"

[reading]
voltage = { at = 0x0000, unit = "V", place = "table 2" }
current = { at = "0002H", unit = "A" }
mode = { at = "40017", number_format = "U16", values = { manual = 0, automatic = 1 } }
alarms = { at = 0x0020, table = "holding", number_format = "U16", bits = { hot = 0, open = 3 } }
lamp = { at = "10001" }

[setting]
ratio = { at = 0x0030, table = "holding", number_format = "U16", step = 0.1, span = [1, 50], kept = "eeprom" }

[option]
rated = { unit = "A", span = [1, 100], meaning = "on its plate" }
"""
METER_CSV = """\
name,at,unit,step,number_format,table,note
power,4,W,0.1,I16,,"Of all phases, signed."
energy,0x0006,kWh,,U32,,
relay,0,,,,coil,
"""


class Mode(IntEnum):
    manual = 0
    automatic = 1


class Alarms(IntFlag):
    hot = 1
    open = 8


class Meter(Drive):
    """The meter that METER declares, as a Python class."""

    model = "meter"
    title = "Meter M-1"
    manual = "Meter M-1, protocol 2"
    addresses = range(1, 100)
    baudrates = (9600, 19200)
    formats = {Framing.RTU: ("8E1", "8N1")}
    most_registers = {INPUT: 40, HOLDING: 20}
    readable_gaps = {INPUT: range(0, 0x10)}
    silence = 0.005
    response_delay = 0.01
    response_timeout = 0.4
    exceptions = {1: "unknown function", 0x80: "locked"}
    options = {"rated": Option("A", (1, 100), "on its plate")}

    voltage = reading(0, "V", table=INPUT, number_format=NumberFormat.F32, place="table 2")
    current = reading(2, "A", table=INPUT, number_format=NumberFormat.F32)
    mode = reading(16, Mode)
    alarms = reading(0x20, Alarms)
    lamp = reading(0, table=DISCRETE)
    ratio = setting(0x30, "", step=0.1, span=(1, 50), kept=Kept.EEPROM)
    power = reading(
        4, "W", step=0.1, table=INPUT, number_format=NumberFormat.I16, note="Of all phases, signed."
    )
    energy = reading(6, "kWh", table=INPUT, number_format=NumberFormat.U32)
    relay = reading(0, table=COIL)


def write_meter(folder: Path, name: str = "meter.toml") -> Path:
    """Write the meter's family file and its table meter.csv; return the path of the family file."""
    path = folder / name
    path.write_text(METER, "utf-8")
    (folder / "meter.csv").write_text(METER_CSV, "utf-8")
    return path
