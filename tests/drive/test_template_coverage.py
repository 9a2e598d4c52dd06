"""The script that counts which entries of other programs' register templates can be described here."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from multidrop.drive.text import Text, text

ROOT = Path(__file__).parents[2]
SCRIPT = [sys.executable, "-m", "bench.questions.files.coverage"]

HELD = [  # entries that the register model can describe
    {"name": "voltage", "reg_type": "input", "address": "0x10", "format": "s16", "scale": 0.1},
    {"name": "relay", "reg_type": "coil", "address": 0},
    {"name": "door", "reg_type": "discrete", "address": 3},
    {"name": "setpoint", "reg_type": "holding", "address": 4, "write_address": 104},
    {"name": "energy", "reg_type": "input", "address": 20, "format": "u64", "word_order": "little_endian"},
    {"name": "power", "reg_type": "input", "address": 24, "format": "double"},
    {"name": "limit", "reg_type": "holding", "address": 30, "format": "float", "byte_order": "little_endian"},
    {"name": "cold", "reg_type": "input", "address": 40, "format": "s16", "error_value": "0x7FFF"},
    {"name": "mode", "reg_type": "input", "address": "50:4:2", "enum": [0, 1], "enum_titles": ["a", "b"]},
    {"name": "flag", "reg_type": "holding", "address": "50:0:1", "readonly": True},
    {"name": "small", "reg_type": "input", "address": 51, "format": "u8", "sporadic": True},
    {"name": "frost", "reg_type": "input", "address": 52, "format": "s8", "offset": -40},
    {"name": "count", "reg_type": "input", "address": 53, "format": "bcd32", "scale": -1},
    {"name": "alone", "reg_type": "holding_multi", "address": 60},
    {"name": "serial", "reg_type": "input", "address": 70, "format": "string8", "string_data_size": 5},
    {"name": "only this", "reg_type": "holding", "write_address": 91},
    {"name": "version", "reg_type": "input", "address": 80, "format": "string", "string_data_size": 16},
]
READ_ONLY = [{"name": "bit", "reg_type": "holding", "address": "55:1:1"}]
LACKING = [
    {"name": "presses", "reg_type": "press_counter", "address": 0},
    {"name": "odd", "reg_type": "input", "address": 90, "format": "s48"},
    {"name": "far", "reg_type": "input", "address": 70000},
]


def wb(channels: list[dict[str, Any]], **device: Any) -> str:
    return json.dumps({"device_type": "x", "device": {"name": "x", "channels": channels, **device}})


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(ROOT))
    return importlib.import_module("bench.questions.files.coverage")


def covered(bench: Any, folder: Path) -> Any:
    devices, unread = bench.load(folder)
    assert unread == []
    return bench.Coverage(devices)


def shares(coverage: Any) -> dict[str, tuple[int, int]]:
    entries = coverage.entries
    return {
        "templates": (len(coverage.by_device), coverage.whole),
        "entries": (len(entries), sum(entry.is_whole for entry in entries)),
        "read": (len(entries), sum(entry.is_held for entry in entries)),
    }


def test_every_supported_key_of_a_register_template_is_converted(bench: Any, tmp_path: Path) -> None:
    (tmp_path / "all.json").write_text(wb(HELD))
    coverage = covered(bench, tmp_path)
    whole = (len(HELD), len(HELD))
    assert shares(coverage) == {"templates": (1, 1), "entries": whole, "read": whole}
    assert {words: (count, held) for words, count, held in coverage.needed()} == {
        "offset": (1, 1),
        "invalid counts": (1, 1),
        "bits of a word": (3, 3),
        "numbers of 64 bit": (2, 2),
        "order of bytes or words": (2, 2),
        "BCD": (1, 1),
        "signed 8 bit": (1, 1),
        "negative step": (1, 1),
        "scale register": (0, 0),
        "named values or bits": (1, 1),
        "text": (2, 2),
        "text of one character a register": (1, 1),
        "written by 16 alone": (1, 1),
        "float that is written": (1, 1),
        "written at another address": (1, 1),
    }


def test_template_entries_without_required_keys_are_counted_with_reasons(bench: Any, tmp_path: Path) -> None:
    (tmp_path / "some.json").write_text(wb([*HELD, *READ_ONLY, *LACKING, *LACKING]))
    (tmp_path / "more.json").write_text(wb(LACKING[:1]))
    whole = len(HELD) + 1 + 2 * len(LACKING) + 1
    coverage = covered(bench, tmp_path)
    assert shares(coverage) == {
        "templates": (2, 0),
        "entries": (whole, len(HELD)),
        "read": (whole, len(HELD) + 1),
    }
    lacking = {reason: (count, found) for reason, count, found in coverage.lacking()}
    (part,) = [reason for reason in lacking if reason.startswith("is read, and not written: a part is")]
    assert lacking.pop(part) == (1, 1)
    assert lacking == {
        "its register type press_counter has no table": (3, 2),
        "its format s48 has no number format": (2, 1),
        "its address is not from N to N": (2, 1),
    }


def test_template_parameters_nested_devices_and_comments_are_read(bench: Any, tmp_path: Path) -> None:
    parameters = {"p": {"title": "p", "address": 5, "condition": "q==1"}}
    within = [{"device_type": "y", "device": {"channels": [HELD[0]], "parameters": [{"address": 6}]}}]
    used = {"name": "inner", "device_type": "y", "shift": 100}
    text = wb([HELD[0], used], parameters=parameters, subdevices=within, setup=[{"address": 1, "value": 2}])
    (tmp_path / "a.json").write_text(
        "// http://x\n" + text.replace("}", "} /* so */ // too\n", 1).replace("]", ",\n]", 1)
    )
    coverage = covered(bench, tmp_path)
    assert (len(coverage.entries), coverage.whole) == (4, 1)
    assert dict(coverage.besides()) == {
        "it is written there; what a write does is not known here": 2,
        "condition was not carried over": 1,
        "setup (devices)": 1,
    }


def test_template_entries_that_do_not_fit_into_one_class_are_reported(bench: Any, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(wb([{"address": 5, "scale": 0.1}, {"address": 5, "scale": 1}]))
    coverage = covered(bench, tmp_path)
    assert (coverage.whole, coverage.refused.total()) == (0, 1)
    assert "is written at the same address" in next(iter(coverage.refused))


def test_templates_of_other_protocols_and_invalid_files_are_skipped(bench: Any, tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "modbus.json").write_text(wb(HELD[:1]))
    (tmp_path / "other.json").write_text(wb(HELD[:1], protocol="uniel"))
    (tmp_path / "broken.json").write_text("{")
    (tmp_path / "list.json").write_text("[]")
    (tmp_path / "empty.json").write_text(wb([]))
    (tmp_path / "table.csv").write_text("name,value\nvoltage,1\n")
    (tmp_path / "notes.txt").write_text("no template")
    devices, unread = bench.load(tmp_path)
    assert len(devices) == 1
    names = [Path(sentence.partition(": ")[0].partition(" is not")[0]).name for sentence in unread]
    assert names == ["broken.json", "empty.json", "list.json", "other.json", "table.csv"]


MODPOLL = """\
# a meter
device,meter,1,,
poll,holding_register,0,40,BE_LE
ref,voltage,0,uint16,r,V,0.1
ref,energy,2,int64,r
ref,power,8,float32,rw,W
ref,alarm,19:15,bool,r
ref,serial,20,string16,r
ref,half,36,float16,r
ref,reset,37,uint16,w
poll,coil,0,16,BE_BE
ref,coils,0,bool8,rw

device,other,2
poll,input_register,0x10,2,LE_LE
ref,current,0x10,uint32,r
"""
OTHERS = {
    "neuron.csv": "name,address,type\na,1!400001#BL,FLOAT\nb,1!400003#WS,INT64\n",
    "iobroker.tsv": "_address\tname\ttype\tformula\n300001\ta\tuint16be\t\n300002\tb\tuint16be\tx*2\n",
    "telegraf.conf": '[[inputs.modbus]]\nholding_registers = [{ name = "a", data_type = "INT32",'
    ' byte_order = "CDAB", address = [1, 2] }]\n',
    "home.yaml": "modbus:\n  - sensors:\n    - { name: a, address: 1, slave: 1, swap: byte }\n",
    "esp.yaml": "modbus_controller: { address: 1 }\nsensor:\n"
    "  - { platform: modbus_controller, register_type: read, address: 1, value_type: S_QWORD_R }\n",
    "sunspec.json": '{"id": 1, "group": {"points": [{"name": "A", "type": "int16", "size": 1, "sf": "S"},'
    '{"name": "S", "type": "sunssf", "size": 1}], "groups": [{"name": "r", "points": [{"name": "B"}]}]}}',
}


def test_template_tables_of_modpoll_are_read(bench: Any, tmp_path: Path) -> None:
    (tmp_path / "meter.csv").write_text(MODPOLL)
    coverage = covered(bench, tmp_path)
    assert shares(coverage) == {"templates": (2, 1), "entries": (9, 8), "read": (9, 8)}
    assert list(coverage.lacking()) == [("which bits bool8 means is not known", 1, 1)]
    needed = {words: count for words, count, _ in coverage.needed()}
    assert (needed["order of bytes or words"], needed["bits of a word"], needed["text"]) == (3, 1, 1)


def test_template_files_of_every_importer_layout_are_read(bench: Any, tmp_path: Path) -> None:
    pytest.importorskip("yaml")
    for name, contents in OTHERS.items():
        (tmp_path / name).write_text(contents)
    coverage = covered(bench, tmp_path)
    assert shares(coverage) == {"templates": (6, 3), "entries": (10, 7), "read": (10, 7)}
    assert {reason for reason, _, _ in coverage.lacking()} == {
        "its order of bytes #WS",
        "its formula is a program",
        "its group repeats as often as the device says",
    }


@pytest.mark.slow
def test_template_coverage_script_prints_its_tables(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(wb([*HELD, *LACKING]))
    (tmp_path / "b.json").write_text("{")
    done = subprocess.run([*SCRIPT, str(tmp_path)], capture_output=True, text=True, cwd=ROOT, check=True)
    whole = len(HELD) + len(LACKING)
    lines = [" ".join(line.split()) for line in done.stdout.splitlines()]
    assert "templates, whole 1 0 0.0%" in lines
    assert f"entries, as they are {whole} {len(HELD)} {len(HELD) / whole:.1%}" in lines
    assert "its register type press_counter has no table 1 1" in lines
    assert lines[-1].startswith(f"not read: {tmp_path / 'b.json'}: ")


@pytest.mark.slow
@pytest.mark.parametrize(("folder", "sentence"), [("none", "is no folder"), (".", "has no template")])
def test_folder_without_register_templates_is_reported(tmp_path: Path, folder: str, sentence: str) -> None:
    command = [*SCRIPT, str(tmp_path / folder)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert sentence in done.stderr


def test_template_text_with_one_character_per_register_uses_the_low_bytes() -> None:
    version = text(250, 5, order="B")
    assert version.decode(bytes.fromhex("0034 002E 0031 0000 0041")) == "4.1"
    assert version.decode(bytes.fromhex("FF34 FF2E FF31 FF38 FF20")) == "4.18"
    assert version.encode("4.1") == bytes.fromhex("0034 002E 0031 0000 0000")
    with pytest.raises(ValueError, match="holds 5 characters, not 6"):
        version.encode("4.18.1")
    with pytest.raises(ValueError, match="a text has order = 'A'; it must be 'AB', 'BA' or 'B'"):
        Text(1, 1, order="A")
