"""Family files for tests: a meter with every kind of entry, and its equivalent Python class."""

from __future__ import annotations

from enum import IntEnum, IntFlag
from pathlib import Path

from multidrop import Drive, reading, setting
from multidrop.core import Framing, NumberFormat
from multidrop.drive import COIL, DISCRETE, HOLDING, INPUT, Kept, Option

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
    """The same meter as a Python class."""

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
