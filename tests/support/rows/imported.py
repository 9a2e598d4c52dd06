"""Example files of other programs, small but with all features, for the importers' tests and fuzzer."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

from multidrop.importers import ImportedDevice, family_text, read_devices

IOBROKER = (
    "_address\tname\tdescription\tunit\ttype\tlen\tfactor\toffset\tformula\trole\n"
    "300001\tVoltage L1\tphase 1\tV\tuint16be\t1\t0.1\t0\t\tvalue\n"
    "400011\tSetpoint\t\t°C\tint16be\t1\t0.5\t\tx*2\tlevel\n"
    "300003\tEnergy\t\tkWh\tfloatsw\t2\t1\t0\t\tvalue\n"
)
MODPOLL = """\
# a comment
device,meter,7,,
poll,input_register,0,20,BE_BE
ref,voltage,0,uint16,r,V,0.1
ref,power,2,int16,rw,W,
poll,coil,0,12,BE_BE
ref,coils,0,bool8,rw
poll,holding_register,40000,20,BE_LE
ref,energy,40008,uint32,rw,kWh,
ref,alarm,40010:15,bool,r
ref,reset,40011,uint16,w
"""
NEURON = """\
group,name,address,attribute,type,description,decimal
g,volt,1!400001,Read,UINT16,,0.1
g,hot,1!400002.3,Read,BIT,,
g,power,1!300011#BB,Read,INT32,,
g,work,1!300013#LL,Read,FLOAT,,
g,unsure,1!300015,Read,FLOAT,,
g,swapped,1!300017#LB,Read,UINT32,,
g,words,1!300019#BL,Read,DOUBLE,,
g,wide,1!300023#WS,Read,INT64,,
g,small,1!300027#B,Read,INT16,,
g,setpoint,1!400028,Read Write,INT16,,
g,label,1!400031.10,Read,STRING,,
g,tag,1!400041.4D,Read,STRING,,
g,bytes,1!400045.4E,Read,STRING,,
"""
OWN = """\
Register;Address;Type;Unit;Scale;Notes
Speed;0x0010;uint16;rpm;1;
Temp 1;17;int16;°C;0,1;
1st;18;int16;;2;
Odd;19;int16;;x;
None;20;int16;;0;
"""
TELEGRAF = """\
[[inputs.modbus]]
name = "meter"
slave_id = 3
coils = [{ name = "relay", address = [4] }]
holding_registers = [
  { name = "power", byte_order = "AB", data_type = "INT16", scale = 0.1, address = [10] },
  { name = "energy", byte_order = "ABCD", data_type = "UINT32", scale = 1.0, address = [12, 13] },
  { name = "swapped", byte_order = "CDAB", data_type = "FLOAT32-IEEE", scale = 1.0, address = [14, 15] },
  { name = "long", byte_order = "GHEFCDAB", data_type = "UINT64", scale = 1.0, address = [16, 17, 18, 19] },
  { name = "last", byte_order = "HGFEDCBA", data_type = "FIXED", scale = 1.0, address = [20, 21, 22, 23] },
]
[[inputs.modbus]]
name = "other"
[[inputs.modbus.request]]
slave_id = 4
byte_order = "ABCD"
register = "input"
fields = [
  { address = 0, type = "FLOAT32", name = "volt" },
  { address = 2, type = "UINT16", name = "skipped", omit = true },
  { address = 3, type = "FLOAT16", name = "half" },
  { address = 4, type = "INT64", name = "work" },
  { address = 8, type = "BIT", bit = 5, name = "flag" },
  { address = 9, type = "UINT8H", name = "high" },
  { address = 10, type = "STRING", length = 8, name = "firmware" },
]
[[inputs.modbus.request]]
slave_id = 4
byte_order = "LSW-BE"
fields = [
  { address = 30, type = "FLOAT64", name = "wide" },
  { address = 34, type = "UINT16", name = "narrow" },
]
"""
HOME = """\
modbus:
  - name: hub
    type: serial
    port: !secret port
    sensors:
      - { name: Room temperature, slave: 1, address: 5, input_type: input, data_type: int16, scale: 0.1,
          unit_of_measurement: °C, scan_interval: 30 }
      - { name: Work, slave: 1, address: 6, data_type: uint32 }
      - { name: Serial, slave: 1, address: 20, data_type: string, count: 4 }
      - { name: Phase, slave: 1, address: 40, data_type: float32, virtual_count: 2, swap: word_byte,
          nan_value: nan }
      - { name: Old, slave: 1, address: 50, input_type: input, data_type: uint64, slave_count: 1, swap: word }
      - { name: Odd, slave: 1, address: 60, data_type: custom }
      - { name: Far, slave: 1, address: 65534, data_type: uint32, virtual_count: 1 }
      - { name: Many, slave: 1, address: 0, virtual_count: 5000 }
    binary_sensors:
      - { name: Door, slave: 1, address: 3, input_type: discrete_input, virtual_count: 1 }
      - { name: Alarm, slave: 1, address: 70, input_type: holding }
    switches:
      - { name: Pump, slave: 1, address: 9, write_type: coil }
    climates:
      - { name: Zone, slave: 1, address: 30 }
"""
SUNSPEC = {
    "id": 103,
    "group": {
        "name": "inverter",
        "points": [
            {"name": "ID", "type": "uint16", "size": 1},
            {"name": "A", "type": "uint16", "size": 1, "sf": "A_SF", "units": "A", "label": "Amps"},
            {"name": "A_SF", "type": "sunssf", "size": 1},
            {"name": "St", "type": "enum16", "size": 1, "symbols": [{"name": "OFF", "value": 1}]},
            {"name": "W", "type": "float32", "size": 2, "units": "W"},
            {"name": "Mn", "type": "string", "size": 16},
            {"name": "Wh", "type": "uint64", "size": 4, "symbols": []},
            {"name": "Net", "type": "int64", "size": 4},
        ],
        "groups": [{"name": "mppt", "points": [{"name": "DCA", "type": "uint16", "size": 1}]}],
    },
}
WB = {
    "title": "Own meter",
    "device": {
        "name": "own",
        "channels": [
            {
                "name": "Voltage",
                "reg_type": "input",
                "address": "0x0010",
                "format": "u32",
                "scale": 0.01,
                "units": "V",
            },
            {"name": "Serial", "reg_type": "input", "address": 40, "format": "string", "string_data_size": 8},
            {"name": "Mode of work", "address": 50, "enum": [0, 1], "enum_titles": ["off", "1st stage"]},
            {"name": "Order", "write_address": 60},
            {"name": "Status bit", "reg_type": "holding", "address": "3:4:2"},
            {"name": "Relay", "reg_type": "coil", "address": 0},
            {"name": "Odd", "reg_type": "press_counter", "address": 1},
        ],
        "parameters": {"mode": {"address": 9, "format": "s16", "error_value": "0x7FFF"}},
        "setup": [{"title": "x", "address": 1, "value": 1}],
    },
}
ESPHOME = """\
esphome: { name: pump-node }
modbus_controller: { id: pump, address: 0x1A, modbus_id: bus }
sensor:
  - { platform: modbus_controller, name: Level, register_type: read, address: 0x10, value_type: FP32_R,
      unit_of_measurement: m }
  - { platform: modbus_controller, name: Part, register_type: holding, address: 18, value_type: U_WORD,
      bitmask: 0x0FF0 }
  - { platform: modbus_controller, name: Split, register_type: holding, address: 19, bitmask: 0x0101 }
  - { platform: modbus_controller, name: Shown, register_type: holding, address: 20, value_type: S_QWORD,
      filters: [{ multiply: 0.1 }, { lambda: !lambda "return x;" }] }
  - { platform: modbus_controller, name: Raw, register_type: read, address: 30, value_type: RAW }
  - { platform: modbus_controller, name: Computed, register_type: read, address: 31, lambda: "return x * 2;" }
  - { platform: dht, name: Room }
binary_sensor:
  - { platform: modbus_controller, name: Running, register_type: coil, address: 2, offset: 1 }
text_sensor:
  - { platform: modbus_controller, name: Label, register_type: holding, address: 40, response_size: 7 }
select:
  - { platform: modbus_controller, name: Mode, address: 50, optionsmap: { Auto: 1, "Hand": 2 } }
output:
  - { platform: modbus_controller, id: speed, address: 60, register_type: holding, value_type: U_WORD }
"""
FILES = {  # file contents by suffix, which selects the importer
    ".tsv": (IOBROKER,),
    ".csv": (MODPOLL, NEURON, OWN),
    ".toml": (TELEGRAF,),
    ".yaml": (HOME, ESPHOME),
    ".json": (json.dumps(SUNSPEC), json.dumps(WB)),
}


def devices(folder: Path, name: str, contents: str | dict[str, Any]) -> list[ImportedDevice]:
    path = folder / name
    path.write_text(contents if isinstance(contents, str) else json.dumps(contents), "utf-8")
    return read_devices(path)


def only(folder: Path, name: str, contents: str | dict[str, Any]) -> ImportedDevice:
    (device,) = devices(folder, name, contents)
    return device


def omissions(device: ImportedDevice) -> list[str]:
    """Return the importer's sentences about entries that could not be imported."""
    return [str(lost) for lost in device.lost]


def entries(device: ImportedDevice) -> dict[str, Any]:
    """Return the family file as parsed TOML; fail if it has a verb or a writable entry."""
    document = tomllib.loads(family_text(device, "source"))
    assert document.keys() <= {"family", "reading", "text"}
    return {**document.get("reading", {}), **document.get("text", {})}


def gaps(device: ImportedDevice, name: str) -> list[str]:
    """Return the gaps that the family file marks for this register or text."""
    mark = f"# gap: {name}: "
    lines = family_text(device, "source").splitlines()
    return [line.removeprefix(mark) for line in lines if line.startswith(mark)]
