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
ref,energy,40008,uint32,rw,kWh,
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


def devices(folder: Path, name: str, contents: str | dict[str, Any]) -> list[ImportedDevice]:
    path = folder / name
    path.write_text(contents if isinstance(contents, str) else json.dumps(contents), "utf-8")
    return read_devices(path)


def only(folder: Path, name: str, contents: str | dict[str, Any]) -> ImportedDevice:
    (device,) = devices(folder, name, contents)
    return device


def told(device: ImportedDevice) -> list[str]:
    """Return the sentences on what was not carried over."""
    return [str(lost) for lost in device.lost]


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
    assert told(device) == []
    assert "# gap: setpoint: only its count is read: its formula is a program" in family_text(device, "x")
    registers = loaded(tmp_path, device, "voltage_l1", "setpoint")
    assert (registers["setpoint"].address, registers["setpoint"].step) == (10, 0.5)


def test_modpoll(tmp_path: Path) -> None:
    device = only(tmp_path, "config.csv", MODPOLL)
    assert (device.title, device.address) == ("meter", 7)
    assert entries(device)["energy"] == {
        "at": "9C48H", "unit": "kWh", "number_format": "U32", "order": "CDAB",
    }  # fmt: skip
    assert told(device) == ["coils: which bits bool8 means is not known"]
    assert "# gap: energy: it is written there" in family_text(device, "x")
    registers = loaded(tmp_path, device, "voltage", "power", "energy")
    assert registers["energy"].address == 40008
    assert (registers["voltage"].table.name, registers["voltage"].step) == ("input register", 0.1)


def test_neuron(tmp_path: Path) -> None:
    device = only(tmp_path, "tags.csv", NEURON)
    found = entries(device)
    assert device.address == 1
    assert found["volt"] == {"at": 0, "step": 0.1}
    assert found["hot"] == {"at": 1, "part": "3"}
    assert found["power"] == {"at": 10, "table": "input", "number_format": "I32", "order": "DCBA"}
    assert [found[name].get("order") for name in ("work", "swapped", "words", "small")] == [
        None, "BADC", "CDAB", "BA",
    ]  # fmt: skip
    assert [found[name] for name in ("label", "tag")] == [
        {"at": 30, "length": 5}, {"at": 40, "length": 4, "order": "B"},
    ]  # fmt: skip
    text = family_text(device, "x")
    assert "# gap: unsure: its order of bytes is its node's; ABCD was assumed, as Neuron does" in text
    assert "# gap: wide: only its count is read: its order of bytes #WS" in text
    assert "# gap: setpoint: it is written there; what a write does is not known here" in text
    assert told(device) == ["bytes: a text of one character a register, in its high byte"]
    assert loaded(tmp_path, device, "volt", "power")["power"].words == 2


def test_a_table_of_one_s_own(tmp_path: Path) -> None:
    device = only(tmp_path, "own.csv", OWN)
    text = family_text(device, "own.csv")
    assert "# gap: speed: whether its address counts from 0 or 1; 0 was assumed" in text
    assert "# gap: temp_1: the comma of 0,1 was taken for a decimal point" in text
    assert "# gap: odd: only its count is read: its scale 'x' or offset '' is no number" in text
    assert entries(device)["temp_1"]["step"] == 0.1
    assert list(loaded(tmp_path, device, "speed", "temp_1", "r_1st")) == ["speed", "temp_1", "r_1st"]


def test_telegraf(tmp_path: Path) -> None:
    meter, other = devices(tmp_path, "telegraf.conf", TELEGRAF)
    assert (meter.address, other.address) == (3, 4)
    assert entries(meter)["long"] == {"at": 16, "number_format": "U64", "order": "CDAB"}
    assert entries(meter)["last"] == {"at": 20, "number_format": "I64", "order": "DCBA"}
    assert entries(meter)["swapped"] == {"at": 14, "number_format": "F32", "order": "CDAB"}
    found = entries(other)
    assert found["volt"] == {"at": 0, "table": "input", "number_format": "F32"}
    assert found["work"] == {"at": 4, "table": "input", "number_format": "I64"}
    assert (found["flag"]["part"], found["high"]["part"]) == ("5", "8-15")
    assert found["firmware"] == {"at": 10, "table": "input", "length": 8}
    assert found["wide"] == {"at": 30, "number_format": "F64", "order": "CDAB"}
    assert found["narrow"] == {"at": 34}
    assert told(other) == [
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
    assert [(found[name]["at"], found[name]["order"]) for name in ("phase", "phase_1", "phase_2")] == [
        (40, "DCBA"), (42, "DCBA"), (44, "DCBA"),
    ]  # fmt: skip
    assert [(found[name]["at"], found[name]["order"]) for name in ("old", "old_1")] == [
        (50, "CDAB"), (54, "CDAB"),
    ]  # fmt: skip
    assert [found[name]["at"] for name in ("door", "door_1")] == [3, 4]
    assert found["phase"]["invalid"] == "NaN"
    assert found["alarm"]["part"] == "0"
    assert told(device) == [
        "Odd: its type custom has no number format",
        "Far_1: its address is none from 0 to 65535",
        "Many: it cannot be read: ValueError virtual_count = 5000 is not 0 to 1000",
        "Zone: a climate has no counterpart",
    ]
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
    assert (found["a"]["at"], found["w"]["at"], found["mn"]["at"]) == ("9C41H", "9C44H", "9C46H")
    assert (found["w"]["invalid"], found["st"]["values"]) == ("NaN", {"off": 1})
    assert found["mn"]["length"] == 16
    assert any("mend every `at`" in sentence for sentence in told(device))
    assert "mppt.DCA: its group repeats as often as the device says" in told(device)
    assert loaded(tmp_path, device, "a", "a_sf")["a"].address == 40001


def test_wb(tmp_path: Path) -> None:
    device = only(tmp_path, "config-own.json", WB)
    found = entries(device)
    assert found["voltage"] == {
        "at": 16, "table": "input", "unit": "V", "step": 0.01, "number_format": "U32", "note": "Voltage",
    }  # fmt: skip
    assert found["status_bit"]["part"] == "4-5"
    assert (found["mode"]["number_format"], found["mode"]["invalid"]) == ("I16", 0x7FFF)
    assert found["serial"] == {"at": 40, "table": "input", "length": 8, "order": "B"}
    assert found["mode_of_work"]["values"] == {"off": 0, "r_1st_stage": 1}
    assert told(device) == [
        "Order: is only written: a command is never imported",
        "Odd: its register type press_counter has no table",
        "setup: writes at every start are never sent, for they wear the EEPROM",
    ]
    assert loaded(tmp_path, device, "voltage", "relay")["voltage"].words == 2


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


def test_esphome(tmp_path: Path) -> None:
    pytest.importorskip("yaml")
    device = only(tmp_path, "pump.yaml", ESPHOME)
    found = entries(device)
    assert (device.title, device.address) == ("pump-node", 26)
    assert found["level"] == {
        "at": 16, "table": "input", "unit": "m", "number_format": "F32", "order": "CDAB", "note": "Level",
    }  # fmt: skip
    assert (found["part"]["part"], found["shown"]["step"]) == ("4-11", 0.1)
    assert (found["running"]["at"], found["running"]["table"]) == (3, "coil")
    assert found["label"] == {"at": 40, "length": 4}
    assert found["mode"]["values"] == {"auto": 1, "hand": 2}
    text = family_text(device, "x")
    assert "# gap: split: only its count is read: bits that are not side by side: 0x101" in text
    assert "# gap: shown: not all of its filters were carried over: lambda" in text
    assert "# gap: computed: only its count is read: its lambda is a program" in text
    assert told(device) == [
        "Raw: its value type RAW has no number format",
        "speed: is only written: a command is never imported",
    ]
    assert loaded(tmp_path, device, "level", "part", "running")["part"].part == (4, 11)


# ---- what is refused ----


def bomb(levels: int) -> str:
    """Return YAML in which each list has the one before it ten times."""
    lists = "".join(
        f"a{at}: &a{at} [{', '.join([f'*a{at - 1}' if at else '1'] * 10)}]\n" for at in range(levels)
    )
    return f"{lists}modbus: *a{levels - 1}\n"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (bomb(9), "has more than 50000 entries, aliases counted as what they stand for"),
        ("a: &a [*a]\nmodbus: *a\n", "has more than 50000 entries"),
        ("modbus: [" + "1," * 60_000 + "]", "has more than 50000 entries"),
        ("[" * 50_000, "is YAML that is nested too deeply"),
        ("a" * 1_000_001, "has more than 1000000 characters"),
        ("modbus: !!python/object/apply:os.system [true]", "is not YAML"),
        ("modbus: [}", "is not YAML"),
    ],
)
def test_yaml_that_would_be_costly_is_refused(tmp_path: Path, text: str, told: str) -> None:
    pytest.importorskip("yaml")
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(ValueError, match=re.escape(told)):
        read_devices(tmp_path / "a.yaml")


# ---- of any file ----


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
    assert (status, "not carried over: coils: which bits bool8 means" in err) == (0, True)
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
