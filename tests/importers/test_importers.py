"""Importers: an example file of each format becomes a family file that loads, with comments for every gap."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
from commands import Run
from imported import (
    ESPHOME,
    HOME,
    IOBROKER,
    MODPOLL,
    NEURON,
    OWN,
    SUNSPEC,
    TELEGRAF,
    WB,
    devices,
    entries,
    omissions,
    only,
)
from simulated_bus import SimulatedBus
from tables import table, usually

from multidrop import NoValue, load_family
from multidrop.drive.register import Access, Register
from multidrop.importers import device as imported_device
from multidrop.importers import family_text, plant_text, read_devices
from multidrop.importers.device import ImportedDevice, ImportedRegister, declare
from multidrop.sim import SimulatedDrive


def loaded(folder: Path, device: ImportedDevice, *names: str) -> dict[str, Register[Any]]:
    """Return these registers from the family file that was written for the device."""
    device.registers = [register for register in device.registers if register.name in names]
    device.texts = []
    path = folder / "imported.toml"
    path.write_text(family_text(device, "source"), "utf-8")
    registers = load_family(path).registers
    assert {register.access for register in registers.values()} == {Access.READING}
    return dict(registers)


def test_iobroker_table_becomes_a_loadable_family(tmp_path: Path) -> None:
    device = only(tmp_path, "table.tsv", IOBROKER)
    found = entries(device)
    assert found["voltage_l1"] == {
        "at": 0, "table": "input", "unit": "V", "step": 0.1, "note": "Voltage L1",
    }  # fmt: skip
    assert found["energy"] == {
        "at": 2, "table": "input", "unit": "kWh", "number_format": "F32", "order": "CDAB", "note": "Energy",
    }  # fmt: skip
    assert omissions(device) == []
    assert "# gap: setpoint: only its count is read: its formula is a program" in family_text(device, "x")
    registers = loaded(tmp_path, device, "voltage_l1", "setpoint")
    assert (registers["setpoint"].address, registers["setpoint"].step) == (10, 0.5)


def test_modpoll_table_becomes_loadable_families(tmp_path: Path) -> None:
    other_device = "device,other,2\npoll,input_register,0x10,2,LE_LE\nref,current,0x10,uint32,r\n"
    device, other = devices(tmp_path, "config.csv", MODPOLL + other_device)
    assert [(each.title, each.address) for each in (device, other)] == [("meter", 7), ("other", 2)]
    assert entries(other) == {
        "current": {"at": 16, "table": "input", "number_format": "U32", "order": "DCBA"}
    }
    assert entries(device)["alarm"] == {"at": "9C4AH", "part": "15"}
    assert entries(device)["energy"] == {
        "at": "9C48H", "unit": "kWh", "number_format": "U32", "order": "CDAB",
    }  # fmt: skip
    assert omissions(device) == [
        "coils: which bits bool8 means is not known",
        "reset: is only written: a command is never imported",
    ]
    assert "# gap: energy: it is written there" in family_text(device, "x")
    registers = loaded(tmp_path, device, "voltage", "power", "energy")
    assert registers["energy"].address == 40008
    assert (registers["voltage"].table.name, registers["voltage"].step) == ("input register", 0.1)


def test_a_csv_table_of_the_neuron_gateway_becomes_loadable_families(tmp_path: Path) -> None:
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
    assert omissions(device) == ["bytes: a text of one character a register, in its high byte"]
    assert loaded(tmp_path, device, "volt", "power")["power"].words == 2


def test_table_with_other_column_names_becomes_a_loadable_family(tmp_path: Path) -> None:
    device = only(tmp_path, "own.csv", OWN)
    text = family_text(device, "own.csv")
    assert "# gap: speed: whether its address counts from 0 or 1; 0 was assumed" in text
    assert "# gap: temp_1: the comma of 0,1 was taken for a decimal point" in text
    assert "# gap: odd: only its count is read: its scale 'x' or offset '' is not a number" in text
    assert entries(device)["temp_1"]["step"] == 0.1
    assert list(loaded(tmp_path, device, "speed", "temp_1", "r_1st")) == ["speed", "temp_1", "r_1st"]


def test_telegraf_configuration_becomes_loadable_families(tmp_path: Path) -> None:
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
    assert found["half"] == {"at": 3, "table": "input", "number_format": "F16"}
    assert omissions(other) == ["skipped: it is marked omit, and was left out"]
    registers = loaded(tmp_path, meter, "relay", "power", "energy")
    assert registers["relay"].table.name == "coil"
    assert (registers["power"].number_format.name, registers["energy"].words) == ("I16", 2)


def test_home_assistant_document_becomes_loadable_families(tmp_path: Path) -> None:
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
    assert omissions(device) == [
        "Odd: its type custom has no number format",
        "Far_1: its address is not from 0 to 65535",
        "Many: it cannot be read: virtual_count = 5000 is outside 0 to 1000",
        "Zone: a climate has no counterpart",
    ]
    text = family_text(device, "x")
    assert "# gap: room_temperature: it was read every 30 s: `every` in the plant file" in text
    assert "# gap: pump: it is written there; what a write does is not known here" in text
    plant = tomllib.loads(plant_text(device, "hub.toml"))
    assert plant["line"][0]["drive"] == [{"name": "device-1", "model": "hub.toml", "address": 1}]
    assert loaded(tmp_path, device, "room_temperature", "work", "pump")["pump"].table.name == "coil"


def test_sunspec_model_becomes_a_loadable_family(tmp_path: Path) -> None:
    device = only(tmp_path, "model_103.json", SUNSPEC)
    found = entries(device)
    assert found["a"]["scale_register"] == "a_sf"
    assert (found["a"]["at"], found["w"]["at"], found["mn"]["at"]) == ("9C41H", "9C44H", "9C46H")
    assert (found["w"]["invalid"], found["st"]["values"]) == ("NaN", {"off": 1})
    assert found["mn"]["length"] == 16
    assert any("mend every `at`" in sentence for sentence in omissions(device))
    assert "mppt.DCA: its group repeats as often as the device says" in omissions(device)
    registers = loaded(tmp_path, device, "a", "a_sf", "wh", "net")
    assert registers["a"].address == 40001
    assert registers["wh"].number_in(b"\xff" * 8, 0) is None
    assert registers["net"].number_in(b"\x80" + bytes(7), 0) is None
    assert registers["wh"].number_in(b"\x80" + bytes(7), 0) == 2.0**63


# The points of SunSpec's model 101 in order, and the reply of a SolarEdge inverter in evcc-io/evcc#15445.
POINTS = """
    A AphA AphB AphC A_SF V1 V2 V3 PhVphA PhVphB PhVphC V_SF W W_SF Hz Hz_SF VA VA_SF VAr VAr_SF PF PF_SF
    WH WH_SF DCA DCA_SF DCV DCV_SF DCW DCW_SF TmpCab TmpSnk TmpTrns TmpOt Tmp_SF
"""
SIGNED = {"W", "VA", "VAr", "PF", "DCW", "TmpCab", "TmpSnk", "TmpTrns", "TmpOt"}
SCALED = {"A": "A_SF", "W": "W_SF", "Hz": "Hz_SF", "DCW": "DCW_SF", "TmpCab": "Tmp_SF", "TmpSnk": "Tmp_SF"}
REPLY = """
    024e 024e ffff ffff fffe 0933 ffff ffff 0933 ffff ffff ffff 3646 ffff c33e fffd 3665 ffff dba4 fffe
    d907 fffe 00df f1da 0000 0d6b fffd 100a ffff 3719 ffff 8000 1049 8000 8000 fffe
"""


def test_values_decoded_from_a_published_sunspec_reply_are_right(tmp_path: Path) -> None:
    points: list[dict[str, Any]] = [{"name": name, "type": "uint16", "size": 1} for name in ("ID", "L")]
    for name in POINTS.split():
        kind = "sunssf" if name.endswith("_SF") else "int16" if name in SIGNED else "uint16"
        point = {"name": name, "type": kind, "size": 1} if name != "WH" else {"name": name, "type": "acc32"}
        points.append({"size": 2, **point, **({"sf": SCALED[name]} if name in SCALED else {})})
    device = only(tmp_path, "101.json", {"id": 101, "group": {"name": "inverter", "points": points}})
    (tmp_path / "inverter.toml").write_text(family_text(device, "inverter"))
    sim = SimulatedDrive(load_family(tmp_path / "inverter.toml")(1))
    for address, word in enumerate(bytes.fromhex(REPLY).hex(" ", 2).split(), 40002):
        if (cell := sim.memory.readable(3, address)) is not None:
            cell.raw = int(word, 16)
    drive = SimulatedBus(sim).attach(sim.drive)
    found = {name: drive.read(drive.register(name)) for name in ("w", "dcw", "hz", "tmpsnk")}
    assert found == pytest.approx({"w": 1389.4, "dcw": 1410.5, "hz": 49.982, "tmpsnk": 41.69})
    with pytest.raises(NoValue):
        drive.read(drive.register("tmpcab"))


def test_sunspec_scale_register_too_far_away_is_left_out_and_reported(tmp_path: Path) -> None:
    """A register and its scale register must fit into one request of at most 125 registers."""
    points = [
        {"name": "A", "type": "int16", "size": 1, "sf": "S"},
        {"name": "gap", "type": "pad", "size": 130},
        {"name": "S", "type": "sunssf", "size": 1},
    ]
    device = only(tmp_path, "far.json", {"group": {"points": points}})
    assert "scale_register" not in entries(device)["a"]
    assert "# gap: a: only its count is read: one request reads at most 125 registers" in family_text(
        device, "x"
    )
    assert loaded(tmp_path, device, "a", "s")["a"].address == 40000


def test_wb_mqtt_serial_template_becomes_a_loadable_family(tmp_path: Path) -> None:
    device = only(tmp_path, "config-own.json", WB)
    found = entries(device)
    assert found["voltage"] == {
        "at": 16, "table": "input", "unit": "V", "step": 0.01, "number_format": "U32", "note": "Voltage",
    }  # fmt: skip
    assert found["status_bit"]["part"] == "4-5"
    assert (found["mode"]["number_format"], found["mode"]["invalid"]) == ("I16", 0x7FFF)
    assert found["serial"] == {"at": 40, "table": "input", "length": 8, "order": "B"}
    assert found["mode_of_work"]["values"] == {"off": 0, "r_1st_stage": 1}
    assert omissions(device) == [
        "Order: is only written: a command is never imported",
        "Odd: its register type press_counter has no table",
        "setup: writes at every start are never sent, for they wear the EEPROM",
    ]
    assert loaded(tmp_path, device, "voltage", "relay")["voltage"].words == 2


def test_esphome_document_becomes_a_loadable_family(tmp_path: Path) -> None:
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
    assert omissions(device) == [
        "Raw: its value_type RAW has no number format",
        "speed: is only written: a command is never imported",
    ]
    assert loaded(tmp_path, device, "level", "part", "running")["part"].part == (4, 11)


def bomb(levels: int) -> str:
    """Return YAML in which each list contains the previous list ten times."""
    lists = "".join(
        f"a{at}: &a{at} [{', '.join([f'*a{at - 1}' if at else '1'] * 10)}]\n" for at in range(levels)
    )
    return f"{lists}modbus: *a{levels - 1}\n"


@pytest.mark.long
@pytest.mark.parametrize(
    ("text", "expected"),
    [
        *usually(
            (bomb(9), "has more than 50000 entries, if each alias is replaced by its entries"),
            ("modbus: [" + "1," * 60_000 + "]", "has more than 50000 entries"),
        ),
        ("a: &a [*a]\nmodbus: *a\n", "has more than 50000 entries"),
        ("[" * 5_000, "is YAML that is nested too deeply"),
        ("a" * 1_000_001, "has more than 1000000 characters"),
        ("modbus: !!python/object/apply:os.system [true]", "is not YAML"),
        ("modbus: [}", "is not YAML"),
    ],
)
def test_yaml_that_is_costly_or_unsafe_to_read_is_refused(tmp_path: Path, text: str, expected: str) -> None:
    pytest.importorskip("yaml")
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(ValueError, match=re.escape(expected)):
        read_devices(tmp_path / "a.yaml")


def test_registers_above_the_limit_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Entries above the limit are not checked, because that would be slow for a large file."""
    declared: list[str] = []

    def noted(found: ImportedRegister) -> Register[Any]:
        declared.append(found.name)
        return declare(found)

    monkeypatch.setattr(imported_device, "MOST_REGISTERS", 2)
    monkeypatch.setattr(imported_device, "declare", noted)
    rows = "".join(f"r{address},{address},uint16\n" for address in (1, 99_999, 2, 3, 4))
    device = only(tmp_path, "a.csv", f"name,address,type\n{rows}")
    assert [register.name for register in device.registers] == ["r1", "r2"]
    assert omissions(device)[-2:] == [f"{name}: a family has at most 2 registers" for name in ("r3", "r4")]
    assert declared[-1] == "r2"


@table(
    ("name", "text", "expected"),
    [
        ("a.csv", "", "is empty"),
        ("a.json", "[]", "is neither a wb-mqtt-serial template nor a SunSpec model: it is a list"),
        ("a.json", "{", "a.json: "),
        ("a.json", '{"device": {"channels": 5}}', "is not a file of a supported program"),
        ("a.toml", "\na = ", "a.toml:2: the file is not TOML"),
        ("a.xls", "a", "the file's suffix is not one of .csv"),
    ],
)
def test_file_without_registers_is_refused(tmp_path: Path, name: str, text: str, expected: str) -> None:
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(ValueError, match=re.escape(expected)):
        read_devices(path)


def test_texts_from_an_imported_file_cannot_inject_toml(tmp_path: Path) -> None:
    name = 'a"]\n[command]\nrun = { at = 1 }\n'
    document = {"device": {"channels": [{"name": name, "reg_type": "holding", "address": 1, "units": name}]}}
    device = only(tmp_path, "x.json", document)
    device.lost.append("a\n[command]\nb = { at = 1 }")
    assert list(tomllib.loads(family_text(device, "x\n[command]\n"))) == ["family", "reading"]


HUBS = """
modbus:
  - {name: north, type: serial, port: /dev/ttyUSB3, baudrate: 19200, parity: E, method: rtu,
     sensors: [{name: volt, slave: 1, address: 0}]}
  - {name: south, type: rtuovertcp, host: 10.0.0.7, port: 4001, sensors: [{name: amp, slave: 1, address: 9}]}
  - {name: west, type: tcp, host: "fe80::1", sensors: [{name: watt, slave: 1, address: 9}]}
  - {name: east, type: serial, port: /dev/ttyS1, baudrate: 300, bytesize: 7, parity: E, method: ascii,
     sensors: [{name: hertz, slave: 2, address: 9}]}
"""


def test_imported_line_settings_are_written_into_the_plant_file(tmp_path: Path) -> None:
    pytest.importorskip("yaml")
    north, south, west, east = devices(tmp_path, "configuration.yaml", HUBS)
    assert [list(entries(hub)) for hub in (north, south, west)] == [["volt"], ["amp"], ["watt"]]
    lines = [tomllib.loads(plant_text(hub, "hub.toml"))["line"][0] for hub in (north, south, west, east)]
    assert [line["port"] for line in lines] == [
        "/dev/ttyUSB3", "socket://10.0.0.7:4001", "tcp://[fe80::1]:502", "/dev/ttyS1",
    ]  # fmt: skip
    known = [
        {key: drive[key] for key in ("baudrate", "format", "framing") if key in drive}
        for line in lines
        for drive in line["drive"]
    ]
    assert known == [{"baudrate": 19200, "format": "8E1"}, {}, {}, {"framing": "ascii", "format": "7E1"}]
    assert "gap: baudrates, formats, together: what the manual says of the line; there it is 300, 7E1" in (
        family_text(east, "x")
    )


def test_line_settings_of_telegraf_and_esphome_are_imported(tmp_path: Path) -> None:
    plugin = (
        '[[inputs.modbus]]\nslave_id = 1\ncontroller = "{}"\n{}\n'
        'holding_registers = [{{ name = "a", byte_order = "AB", data_type = "INT16", address = [7] }}]\n'
    )
    serial = 'baud_rate = 4800\ndata_bits = 8\nparity = "N"\nstop_bits = 2'
    given = [
        plugin.format("file:///dev/ttyUSB1", serial),
        plugin.format("tcp://gate:1502", ""),
        plugin.format("tcp://gate", 'transmission_mode = "RTUoverTCP"'),
    ]
    found = devices(tmp_path, "t.conf", "".join(given))
    assert [(str(each.line), each.line.port) for each in found] == [
        ("4800, 8N2", "/dev/ttyUSB1"), ("", "tcp://gate:1502"), ("", "socket://gate:502"),
    ]  # fmt: skip
    pytest.importorskip("yaml")
    node = "uart: {baud_rate: 9600, parity: EVEN, stop_bits: 1}\nmodbus_controller: {id: m, address: 2}\n"
    sensor = "sensor:\n  - {platform: modbus_controller, name: a, address: 1, register_type: holding}\n"
    assert str(only(tmp_path, "node.yaml", node + sensor).line) == "9600, 8E1"


def test_invalid_telegraf_controller_address_is_reported(tmp_path: Path) -> None:
    plugin = '[[inputs.modbus]]\ncontroller = "{}"\n'
    for controller in ("tcp://gate:99999", "tcp://gate:modbus", "tcp://[fe80::1"):
        named = rf"t\.conf: controller = '{re.escape(controller)}' is not an address: "
        with pytest.raises(ValueError, match=named):
            devices(tmp_path, "t.conf", plugin.format("tcp://hall") + plugin.format(controller))


def test_telegraf_register_with_scattered_addresses_is_not_imported(tmp_path: Path) -> None:
    field = '{{ name = "{}", byte_order = "ABCD", data_type = "UINT32", address = {} }}'
    listed = ", ".join(
        field.format(*each) for each in (("good", [4, 5]), ("split", [4, 9]), ("one", [4, 5, 6]))
    )
    device = only(tmp_path, "t.conf", f"[[inputs.modbus]]\nslave_id = 1\nholding_registers = [{listed}]\n")
    assert list(entries(device)) == ["good"]
    assert omissions(device) == [
        "split: its addresses 4, 9 are not those of a UINT32, side by side",
        "one: its addresses 4, 5, 6 are not those of a UINT32, side by side",
    ]


def test_read_limits_of_a_device_are_imported(tmp_path: Path) -> None:
    template = '{{"device": {{"max_read_registers": {}, "channels": [{}]}}}}'
    channels = ", ".join(
        f'{{"name": "{name}", "address": {at}, "format": "{kind}"}}'
        for name, at, kind in (("a", 1, "u16"), ("b", 2, "u64"))
    )
    for most in (1, 2, 60):
        device = only(tmp_path, f"t{most}.json", template.format(most, channels))
        assert f"together = {{ holding = {most}, input = {most} }}" in family_text(device, "x")
        assert set(loaded(tmp_path, device, "a", "b")) == {"a", "b"}
    assert "together =" not in family_text(only(tmp_path, "t.json", template.format(0, channels)), "x")


def test_devices_with_the_same_address_on_two_hubs_stay_separate(run: Run, tmp_path: Path) -> None:
    pytest.importorskip("yaml")
    source = tmp_path / "configuration.yaml"
    source.write_text(HUBS)
    status, _, err = run("import", source, "--address", "1")
    assert status == 2
    assert "devices, at 1 of 'north', 1 of 'south'" in err
    assert "Choose one with an option, such as --address 1 --title 'north'" in err
    status, out, _ = run("import", source, "--address", "1", "--title", "south")
    assert (status, "amp = " in out) == (0, True)


def test_the_import_command_writes_a_family_file_and_a_plant_file(run: Run, tmp_path: Path) -> None:
    source, family, plant = (tmp_path / name for name in ("c.csv", "meter.toml", "plant.toml"))
    source.write_text(MODPOLL)
    status, out, err = run("import", source, "--out", family, "--plant", plant)
    assert (status, "not imported: coils: which bits bool8 means" in err) == (0, True)
    assert f"multidrop check {family}" in out
    assert run("check", family)[0] == 0
    assert run("plan", plant)[0] == 0
    assert run("import", source, "--out", family)[0] == 2


def test_imported_device_with_only_text_registers_gets_no_plant_file(run: Run, tmp_path: Path) -> None:
    source, family, plant = (tmp_path / name for name in ("c.csv", "label.toml", "plant.toml"))
    source.write_text("name,address,type\nlabel,1!400001.8,STRING\n")
    status, _, err = run("import", source, "--out", family, "--plant", plant)
    assert (status, "only text registers, which are never polled" in err) == (2, True)
    assert not family.exists()


def test_the_import_command_asks_which_of_several_devices_to_import(run: Run, tmp_path: Path) -> None:
    source = tmp_path / "telegraf.conf"
    source.write_text(TELEGRAF)
    status, _, err = run("import", source)
    assert (
        status,
        "the file has several devices, at 3, 4. Choose one with an option, such as --address 3" in err,
    ) == (2, True)
    status, out, _ = run("import", source, "--address", "4")
    assert status == 0
    assert "volt = { at = 0x0000" in out
