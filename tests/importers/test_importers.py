"""Importers: files of each layout, written here, become families that load, with every gap marked."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
from commands import Run

from multidrop import load_family
from multidrop.drive.register import Access, Register
from multidrop.importers import family_text, plant_text, read_devices
from multidrop.importers.device import ImportedDevice

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
ref,energy,40008,uint32,r,kWh,
"""
NEURON = """\
group,name,address,attribute,type,description,decimal
g,volt,1!400001,Read,UINT16,,0.1
g,hot,1!400002.3,Read,BIT,,
g,power,1!300011#BB,Read,INT32,,
g,work,1!300013#LL,Read,FLOAT,,
g,unsure,1!300015,Read,FLOAT,,
"""
OWN = """\
Register;Address;Type;Unit;Scale;Notes
Speed;0x0010;uint16;rpm;1;
Temp 1;17;int16;°C;0,1;
1st;18;int16;;2;
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
        ],
        "groups": [{"name": "mppt"}],
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
            {"name": "Status bit", "reg_type": "holding", "address": "3:4:2"},
            {"name": "Relay", "reg_type": "coil", "address": 0},
            {"name": "Odd", "reg_type": "press_counter", "address": 1},
        ],
        "parameters": {
            "mode": {"address": 9, "format": "s16", "error_value": "0x7FFF", "unsupported_value": 9}
        },
        "setup": [{"title": "x", "address": 1, "value": 1}],
    },
}


def devices(folder: Path, name: str, contents: str | dict[str, Any]) -> list[ImportedDevice]:
    path = folder / name
    path.write_text(contents if isinstance(contents, str) else json.dumps(contents), "utf-8")
    return read_devices(path)


def only(folder: Path, name: str, contents: str | dict[str, Any]) -> ImportedDevice:
    (device,) = devices(folder, name, contents)
    return device


def entries(device: ImportedDevice) -> dict[str, Any]:
    """Return what the family file says, as TOML reads it; it never has a verb, nor anything that writes."""
    document = tomllib.loads(family_text(device, "source"))
    assert document.keys() <= {"family", "reading", "text"}
    return {**document.get("reading", {}), **document.get("text", {})}


def loaded(folder: Path, device: ImportedDevice, *names: str) -> dict[str, Register[Any]]:
    """Return these registers of the family that the file makes."""
    device.registers = [register for register in device.registers if register.name in names]
    device.texts = []
    path = folder / "imported.toml"
    path.write_text(family_text(device, "source"), "utf-8")
    registers = load_family(path).registers
    assert {register.access for register in registers.values()} == {Access.READING}
    return dict(registers)


def test_iobroker(tmp_path: Path) -> None:
    device = only(tmp_path, "table.tsv", IOBROKER)
    found = entries(device)
    assert found["voltage_l1"] == {
        "at": 0, "table": "input", "unit": "V", "step": 0.1, "note": "Voltage L1",
    }  # fmt: skip
    assert found["energy"] == {
        "at": 2, "table": "input", "unit": "kWh", "number_format": "F32", "order": "CDAB", "note": "Energy",
    }  # fmt: skip
    assert device.lost == []
    registers = loaded(tmp_path, device, "voltage_l1", "setpoint")
    assert (registers["setpoint"].address, registers["setpoint"].step) == (10, None)
    assert "# gap: setpoint: its formula x*2 was not carried over" in family_text(device, "t")


def test_modpoll(tmp_path: Path) -> None:
    device = only(tmp_path, "config.csv", MODPOLL)
    assert (device.title, device.address) == ("meter", 7)
    assert entries(device)["energy"] == {
        "at": "0x9C48", "unit": "kWh", "number_format": "U32", "order": "CDAB",
    }  # fmt: skip
    assert device.lost == ["coils: which bits bool8 means is not known"]
    assert "# gap: power: it is written there" in family_text(device, "x")
    registers = loaded(tmp_path, device, "voltage", "power")
    assert (registers["voltage"].table.name, registers["voltage"].step) == ("input register", 0.1)


def test_neuron(tmp_path: Path) -> None:
    device = only(tmp_path, "tags.csv", NEURON)
    found = entries(device)
    assert device.address == 1
    assert found["volt"] == {"at": 0, "step": 0.1}
    assert found["hot"] == {"at": 1, "part": "3"}
    assert found["power"] == {"at": 10, "table": "input", "number_format": "I32"}
    assert found["work"]["order"] == "DCBA"
    assert "# gap: unsure: the order of its words is not stated" in family_text(device, "x")
    assert loaded(tmp_path, device, "volt", "power")["power"].words == 2


def test_a_table_of_one_s_own(tmp_path: Path) -> None:
    device = only(tmp_path, "own.csv", OWN)
    text = family_text(device, "own.csv")
    assert "# gap: speed: whether its address counts from 0 or 1; 0 was assumed" in text
    assert "# gap: temp_1: its scale '0,1' or offset '' is no number" in text
    registers = loaded(tmp_path, device, "speed", "temp_1", "r_1st")
    assert list(registers) == ["speed", "temp_1", "r_1st"]
    assert registers["temp_1"].step is None


def test_telegraf(tmp_path: Path) -> None:
    meter, other = devices(tmp_path, "telegraf.conf", TELEGRAF)
    assert (meter.address, other.address) == (3, 4)
    assert entries(meter)["swapped"] == {"at": 14, "number_format": "F32", "order": "CDAB"}
    assert entries(other)["volt"] == {"at": 0, "table": "input", "number_format": "F32"}
    assert other.lost == [
        "skipped: it is marked omit, and was left out",
        "half: its type FLOAT16 has no number format",
    ]
    registers = loaded(tmp_path, meter, "relay", "power", "energy")
    assert registers["relay"].table.name == "coil"
    assert (registers["power"].number_format.name, registers["energy"].words) == ("I16", 2)


def test_home_assistant(tmp_path: Path) -> None:
    pytest.importorskip("yaml")
    device = only(tmp_path, "configuration.yaml", HOME)
    found = entries(device)
    assert found["room_temperature"] == {
        "at": 5, "table": "input", "unit": "°C", "step": 0.1, "number_format": "I16",
        "note": "Room temperature",
    }  # fmt: skip
    assert found["serial"]["length"] == 4
    assert device.lost == ["Zone: a climate has no counterpart"]
    text = family_text(device, "x")
    assert "# gap: room_temperature: it was read every 30 s: `every` in the plant file" in text
    assert "# gap: pump: it is written there; what a write does is not known here" in text
    plant = tomllib.loads(plant_text(device, "hub.toml"))
    assert plant["line"][0]["drive"] == [{"name": "device-1", "model": "hub.toml", "address": 1}]
    assert loaded(tmp_path, device, "room_temperature", "work", "pump")["pump"].table.name == "coil"


def test_sunspec(tmp_path: Path) -> None:
    device = only(tmp_path, "model_103.json", SUNSPEC)
    found = entries(device)
    assert found["a"]["scale_register"] == "a_sf"
    assert (found["a"]["at"], found["w"]["at"], found["mn"]["at"]) == ("0x9C41", "0x9C44", "0x9C46")
    assert (found["w"]["invalid"], found["st"]["values"]) == ("NaN", {"off": 1})
    assert found["mn"]["length"] == 16
    assert any("mend every `at`" in sentence for sentence in device.lost)
    assert any("mppt repeats" in sentence for sentence in device.lost)
    assert loaded(tmp_path, device, "a", "a_sf")["a"].address == 40001


def test_wb(tmp_path: Path) -> None:
    device = only(tmp_path, "config-own.json", WB)
    found = entries(device)
    assert found["voltage"] == {
        "at": 16, "table": "input", "unit": "V", "step": 0.01, "number_format": "U32", "note": "Voltage",
    }  # fmt: skip
    assert found["status_bit"]["part"] == "4-5"
    assert (found["mode"]["number_format"], found["mode"]["invalid"]) == ("I16", [0x7FFF, 9])
    assert device.lost == [
        "Odd: it has no table or address that can be read",
        "setup: writes at every start are never sent, for they wear the EEPROM",
    ]
    assert loaded(tmp_path, device, "voltage", "relay")["voltage"].words == 2


# ---- what is refused ----


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("a.csv", "", "is empty"),
        ("a.csv", "x,y\n1,2\n", "no column is called address"),
        ("a.csv", "name,address\n", "has no register that can be imported"),
        ("a.json", "[]", "is not laid out as its kind of file is"),
        ("a.json", "{", "a.json: "),
        ("a.json", '{"device": {"channels": 5}}', "is not laid out"),
        ("a.toml", "a = 1", "has no register that can be imported"),
        ("a.toml", "a = ", "is not TOML"),
        ("a.xls", "a", "its suffix is none of .csv"),
    ],
)
def test_what_is_no_table_is_refused(tmp_path: Path, name: str, text: str, told: str) -> None:
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(ValueError, match=re.escape(told)):
        read_devices(path)


def test_why_nothing_can_be_imported_is_told_on_one_line(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("name;address\nx;1,5\n")
    with pytest.raises(ValueError, match=r'that can be imported: x: "1,5" is no address'):
        read_devices(path)
    path = tmp_path / "a.toml"
    path.write_text('[family]\ntitle = "T"\n')
    with pytest.raises(ValueError, match="is a family's file already"):
        read_devices(path)
    pytest.importorskip("yaml")
    path = tmp_path / "a.yaml"
    path.write_text("a: [")
    with pytest.raises(ValueError, match="is not YAML") as refused:
        read_devices(path)
    assert "\n" not in str(refused.value)


def test_texts_of_a_file_cannot_leave_their_places(tmp_path: Path) -> None:
    name = 'a"]\n[command]\nrun = { at = 1 }\n'
    document = {"device": {"channels": [{"name": name, "reg_type": "holding", "address": 1, "units": name}]}}
    device = only(tmp_path, "x.json", document)
    device.lost.append("a\n[command]\nb = { at = 1 }")
    assert list(tomllib.loads(family_text(device, "x\n[command]\n"))) == ["family", "reading"]


# ---- the command ----


def test_import_writes_a_family_and_a_plant(run: Run, tmp_path: Path) -> None:
    source, family, plant = (tmp_path / name for name in ("c.csv", "meter.toml", "plant.toml"))
    source.write_text(MODPOLL)
    status, out, err = run("import", source, "--out", family, "--plant", plant)
    assert (status, "not carried over: coils" in err) == (0, True)
    assert f"multidrop check {family}" in out
    assert run("check", family)[0] == 0
    assert run("plan", plant)[0] == 0
    assert run("import", source, "--out", family)[0] == 2


def test_import_asks_which_device(run: Run, tmp_path: Path) -> None:
    source = tmp_path / "telegraf.conf"
    source.write_text(TELEGRAF)
    status, _, err = run("import", source)
    assert (status, "the file has devices at 3, 4: say which, such as --address 3" in err) == (2, True)
    status, out, _ = run("import", source, "--address", "4")
    assert status == 0
    assert "volt = { at = 0x0000" in out
