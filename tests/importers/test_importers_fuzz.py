"""Damaged and hostile files become a family that loads, or give a one-sentence error, in bounded time."""

from __future__ import annotations

import json
import random
import re
import subprocess
import sys
from pathlib import Path
from time import process_time
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from imported import FILES
from readers import read
from tables import examples, usually

ALL = [f"{suffix}\n{text}".encode() for suffix, texts in FILES.items() for text in texts]
TOKENS = re.compile(rb"[A-Za-z_]+|[0-9.]+|\s+|.", re.DOTALL)
ODD = (
    *(b"", b"\n", b'"', b"." * 200, b"a" * 300, b"&a ", b"*a", b"9" * 30, b"\xff", b"\x1b[2J"),
    *b"-1 0 65535 65536 1e999 nan -0.0 1e-320 0x 18446744073709551615 0x8000000000000000 null [] {}".split(),
    *b'"" true class None [reading] string int64 float64 #WS 1!'.split(),
    *("\u202e".encode(), "é".encode()),
)
ENOUGH = 20.0  # limit of CPU time for one file in s, generous for a slow machine


def damaged(seed: int) -> bytes:
    """Return one of the example files with some words replaced, doubled, swapped or removed."""
    draw = random.Random(seed)
    words = TOKENS.findall(draw.choice(ALL))
    for _ in range(draw.randint(1, 6)):
        at, other = draw.randrange(len(words)), draw.randrange(len(words))
        match draw.randrange(5):
            case 0:
                words[at] = draw.choice(ODD)
            case 1:
                words[at] = words[other]
            case 2:
                words[at:at] = words[at : at + draw.randint(1, 40)] * draw.randint(1, 5)
            case 3:
                words[at], words[other] = words[other], words[at]
            case _:
                del words[at : at + draw.randint(1, 20)]
        words = words or [b"."]
    return b"".join(words)


@pytest.mark.long
@settings(
    max_examples=examples(400), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.integers(0, 1 << 32))
def test_damaged_file_is_imported_or_refused_with_one_error(tmp_path: Path, seed: int) -> None:
    read("import", damaged(seed), tmp_path)


LARGE = st.sampled_from(
    [1 << 31, 1 << 32, (1 << 63) - 1, 1 << 63, (1 << 64) - 1, 1 << 64, -(1 << 63), -(1 << 64)]
)
ANYTHING = st.one_of(
    *(st.none(), st.booleans(), st.integers(-5, 70_000), LARGE, st.floats(), st.text(max_size=12)),
    st.sampled_from(["0x10", "3:1:2", "u32", "float64", "ABCD", "little_endian", "string", "holding", "nan"]),
    st.lists(st.integers(-2, 70_000), max_size=3),
    st.dictionaries(st.text(max_size=4), st.integers(), max_size=2),
)

PLAUSIBLE: dict[str, st.SearchStrategy[Any]] = {
    "address": st.sampled_from(
        [0, 1, 2, 10_001, 30_001, 40_001, 65_532, 65_534, 65_535, "0x10", "3:4:2", "9:9:9", "3:30:4"]
    ),
    "name": st.sampled_from(["a", "A", "class", "address", "1st", "", "\u202e", "a.b" * 99, "sf"]),
    "reg_type": st.sampled_from(["holding", "input", "coil", "holding_multi"]),
    "register_type": st.sampled_from(["holding", "read", "coil"]),
    "input_type": st.sampled_from(["holding", "input", "coil"]),
    "format": st.sampled_from(
        ["u8", "s8", "s24", "u16", "s16", "u32", "u64", "float", "double", "bcd8", "string", "string8"]
    ),
    "type": st.sampled_from(
        ["int16", "uint32", "sunssf", "string", "pad", "bitfield32", "enum16", "float64"]
    ),
    "data_type": st.sampled_from(
        ["int16", "uint32", "int64", "float16", "float32", "int", "float", "custom", "string"]
    ),
    "structure": st.sampled_from([">f", ">h", "<q", ">2h", "?"]),
    "slave": st.sampled_from([0, 1, 247, 248, 255, "1", "!secret a", 256]),
    "verify": st.fixed_dictionaries({}, optional={"address": st.integers(0, 70_000), "state_on": ANYTHING}),
    "shift": st.sampled_from([0, 256, "0x100", 65_000, -1]),
    "stride": st.integers(-1, 5),
    "device_type": st.sampled_from(["inner", "other"]),
    "value_type": st.sampled_from(["U_WORD", "S_DWORD_R", "U_QWORD", "FP32"]),
    "size": st.integers(-1, 200),
    "sf": st.sampled_from(["a", "a_2", "sf", -2, 400]),
    "symbols": st.lists(st.fixed_dictionaries({"name": st.text(max_size=4), "value": st.integers(-1, 99)})),
    "error_value": st.one_of(LARGE, st.sampled_from(["0x7FFF", "nan"])),
    "nan_value": LARGE,
    "enum": st.lists(st.integers(-1, 99), max_size=5),
    "enum_titles": st.lists(st.sampled_from(["on", "On", "class", "name", "real", "1", "é"]), max_size=5),
    "string_data_size": st.integers(-1, 400),
    "scale": st.sampled_from([0, -1, 0.1, 1e-300, 1e300, "0,1"]),
    "write_address": st.integers(0, 70_000),
}


def entries_of(needed: str, keys: str) -> st.SearchStrategy[list[dict[str, Any]]]:
    """Return a strategy for lists of entries with required keys, and with random values or null in others."""
    value = {key: PLAUSIBLE.get(key, ANYTHING) for key in (*needed.split(), *keys.split())}
    plausible = st.fixed_dictionaries(
        {key: value[key] for key in needed.split()}, optional={key: value[key] for key in keys.split()}
    )
    anyhow = st.dictionaries(st.sampled_from(list(value)), ANYTHING, max_size=8)
    return st.lists(st.one_of(plausible, plausible, anyhow), max_size=6)


CHANNELS = entries_of(
    "address format",
    "name reg_type scale offset error_value enum enum_titles readonly units word_order byte_order"
    " write_address string_data_size consists_of device_type shift stride oneOf",
)
POINTS = entries_of("name type size", "sf units access symbols label")
SENSORS = entries_of(
    "name address",
    "slave input_type data_type structure swap reverse_order scale offset nan_value count virtual_count"
    " scan_interval verify min_value",
)
ENTITIES = entries_of(
    "address register_type",
    "name value_type bitmask offset byte_offset filters lambda optionsmap register_count multiply",
)
INNER = [{"device_type": "inner", "device": {"channels": [{"name": "a", "address": 5, "device_type": "x"}]}}]
ROWS = st.lists(st.lists(st.text("0123456789!#.BLWS,;xH-au\t \"'", max_size=8), max_size=7), max_size=5)


@pytest.mark.long
@settings(
    max_examples=examples(100), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(CHANNELS, POINTS, SENSORS, ENTITIES, ROWS)
def test_imported_device_with_random_keys_gives_a_family_that_loads(
    tmp_path: Path, channels: Any, points: Any, sensors: Any, entities: Any, rows: Any
) -> None:
    """The YAML importers get JSON, which YAML parsers accept."""
    platform = [{"platform": "modbus_controller", **entity} for entity in entities]
    documents = {
        ".json": (
            {"device": {"channels": channels, "subdevices": INNER}},
            {"ports": [{"path": "/dev/ttyS0", "devices": [{"slave_id": "0", "channels": channels}]}]},
            {"group": {"points": points}},
        ),
        ".yaml": (
            {"modbus": [{"sensors": sensors, "binary_sensors": sensors, "switches": sensors}]},
            {"modbus": [{"type": "serial", "port": "/dev/ttyS0", "sensors": sensors}]},
            {"modbus_controller": {"address": 7}, "sensor": platform, "text_sensor": platform},
            {"number": platform, "binary_sensor": platform},
        ),
    }
    for suffix, listed in documents.items():
        for document in listed:
            read("import", f"{suffix}\n{json.dumps(document)}".encode(), tmp_path)
    for header in ("name,address,type,unit,scale,offset,len", "address,fc,gain,decimal,bit,signed,access"):
        table = "\n".join([header, *map(",".join, rows)])
        read("import", f".csv\n{table}".encode(), tmp_path)


def csv(rows: str) -> bytes:
    return f".csv\nname,address,type\n{rows}".encode()


HOSTILE = {
    "a row of a million cells": b".csv\naddress" + b"," * 1_000_000 + b"\n1" + b"," * 1_000_000,
    "a cell of a million characters": csv('a,"' + "x" * 1_000_000 + '",uint16'),
    "many rows of one name": csv("a,1,uint16\n" * 15_000),
    "too many rows": csv("a,1,uint16\n" * 100_000),
    "many devices": csv("".join(f"a,{slave % 250}!400001,INT16\n" for slave in range(15_000))),
    "one long name": csv("a" * 2_000_000 + ",1,uint16"),
    "deep lists": b".json\n" + b"[" * 1_000_000,
    "deep devices": b".json\n" + b'{"device":' * 100_000,
    "a number of many digits": b'.json\n{"device":{"channels":[{"address":' + b"1" * 1_000_000 + b"}]}}",
    "comments without an end": b".json\n" + b"/*" * 1_000_000,
    "texts without an end": b".json\n" + b'"\\' * 1_000_000,
    "many commas": b".json\n" + b", " * 1_000_000,
    "many entries": b'.json\n{"device":{"channels":['
    + b",".join(b'{"address":1,"name":"a","enum":[1,2],"enum_titles":["a","b"]}' for _ in range(30_000))
    + b"]}}",
    "large groups": b'.json\n{"group":{"points":['
    + b",".join(b'{"name":"a","type":"uint16","size":1,"sf":"a"}' for _ in range(15_000))
    + b"]}}",
    "deep toml": b".toml\na = " + b"[" * 100_000,
    "many tables": b".toml\n" + b"[[inputs.modbus]]\n" * 50_000,
    "lists in lists of yaml": b".yaml\n" + b"[" * 500_000,
    "aliases": b".yaml\na: &a [1]\nmodbus: [" + b"*a," * 200_000 + b"]",
}

COSTLY = (  # files that need up to one second each; a short test run uses only the first
    *("a row of a million cells", "aliases", "many tables", "many rows of one name", "too many rows"),
    *("many devices", "many entries", "large groups", "lists in lists of yaml"),
)


@pytest.mark.long
@pytest.mark.uncounted
@pytest.mark.parametrize("name", [*(name for name in HOSTILE if name not in COSTLY), *usually(*COSTLY)])
def test_hostile_file_is_imported_or_refused_in_bounded_time(tmp_path: Path, name: str) -> None:
    begin = process_time()
    read("import", HOSTILE[name], tmp_path)
    assert process_time() - begin < ENOUGH


MEASURE = """
import resource, sys
sys.path[:0] = sys.argv[3:]
from pathlib import Path
from readers import read
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
read("import", Path(sys.argv[1]).read_bytes(), Path(sys.argv[2]))
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""
MOST_MEMORY = 400_000  # limit in KiB for a file of up to 5 MB; one row of a million empty cells needs 150,000


@pytest.mark.long
@pytest.mark.skipif(sys.platform == "win32", reason="getrusage tells memory on POSIX alone")
@pytest.mark.parametrize("name", usually("aliases", "a row of a million cells", "many entries", "deep lists"))
def test_hostile_file_is_imported_or_refused_in_bounded_memory(tmp_path: Path, name: str) -> None:
    (tmp_path / "given").write_bytes(HOSTILE[name])
    tests = Path(__file__).parents[1]
    folders = [tests / "fuzz", *(tests / "support").iterdir()]
    command = [sys.executable, "-c", MEASURE, str(tmp_path / "given"), str(tmp_path), *folders]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert int(done.stdout) < MOST_MEMORY
