"""Load families from files: the resulting class; every mistake is reported with its place and correction."""

from __future__ import annotations

import dataclasses
import os
import random
import re
import tempfile
import time
from enum import IntFlag
from pathlib import Path
from typing import Any

import pytest
import seeds
from hypothesis import given, settings
from hypothesis import strategies as st
from profile_families import METER, METER_CSV, Meter, write_meter
from readers import read
from tables import examples, table, usually

from multidrop import Drive, load_family
from multidrop.core import NumberFormat
from multidrop.drive import Kept
from multidrop.drive.parameters import parameters_of
from multidrop.drive.register import HOLDING, INPUT, Register
from multidrop.families.files import FamilyError
from multidrop.families.files.loader import SECTIONS
from multidrop.families.files.registers import REGISTER_KEYS
from multidrop.families.files.sections import FAMILY_KEYS

HEAD = '[family]\ntitle = "T"\nmanual = "M"\ncounts_from = 0\n'


def family(folder: Path, text: str, name: str = "t.toml") -> type[Drive]:
    path = folder / name
    path.write_text(text, "utf-8")
    return load_family(path)


def mistakes(folder: Path, text: str) -> list[str]:
    with pytest.raises(FamilyError) as wrong:
        family(folder, text)
    assert str(wrong.value) == "\n".join(wrong.value.mistakes)
    start = re.compile(re.escape(f"{folder}{os.sep}") + r"([\w.]+)(:\d+)?: ")
    return [start.sub(r"\1: ", mistake, count=1) for mistake in wrong.value.mistakes]


def facts(register: Register[Any]) -> dict[str, Any]:
    """Return a register's declared attributes, with the names of its enumeration."""
    found = {one.name: getattr(register, one.name) for one in dataclasses.fields(register)}
    values = register.values
    found["values"] = values and ({each.name: each.value for each in values}, values.__mro__[1])
    return found


def test_class_from_a_family_file_equals_the_hand_written_class(tmp_path: Path) -> None:
    loaded = load_family(write_meter(tmp_path))
    assert {name: facts(one) for name, one in loaded.registers.items()} == {
        name: facts(one) for name, one in Meter.registers.items()
    }
    for name in ("title", "manual", "addresses", "baudrates", "formats", "framings", "silence", "exceptions"):
        assert getattr(loaded, name) == getattr(Meter, name), name
    for name in ("response_delay", "response_timeout", "options", "broadcasts"):
        assert getattr(loaded, name) == getattr(Meter, name), name
    assert [loaded.most_registers[table] for table in (INPUT, HOLDING)] == [40, 20]
    assert loaded.readable_gaps[INPUT] == range(0, 16)
    assert issubclass(loaded, Drive)
    assert (loaded.__name__, loaded.model, loaded.declared_in) == ("Meter", "meter.toml", "meter.toml")


def test_named_values_in_a_family_file_are_decoded(tmp_path: Path) -> None:
    loaded = load_family(write_meter(tmp_path))
    assert loaded.register("mode").format(loaded.register("mode").decode(1)) == "automatic"
    alarms = loaded.register("alarms").decode(9)
    assert isinstance(alarms, IntFlag)
    assert loaded.register("alarms").format(alarms) == "hot|open"


def test_loading_a_family_file_twice_gives_the_same_class(tmp_path: Path) -> None:
    path = write_meter(tmp_path)
    first = load_family(path)
    assert load_family(str(path)) is first
    path.touch()
    assert load_family(tmp_path / "." / "meter.toml") is first


@pytest.mark.parametrize("name", ["meter.toml", "meter.csv"])
def test_loading_a_changed_family_file_gives_another_class(tmp_path: Path, name: str) -> None:
    first = load_family(write_meter(tmp_path))
    before = (tmp_path / name).stat()
    text = {"meter.toml": METER.replace("table 2", "table 3"), "meter.csv": METER_CSV.replace("all", "two")}
    (tmp_path / name).write_text(text[name], "utf-8")
    os.utime(tmp_path / name, ns=(before.st_atime_ns, before.st_mtime_ns))
    again = load_family(tmp_path / "meter.toml")
    assert again is not first
    assert list(again.registers) == list(first.registers)


def test_byte_order_mark_of_a_family_file_is_skipped(tmp_path: Path) -> None:
    path = write_meter(tmp_path)
    for file in (path, tmp_path / "meter.csv"):
        file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
    assert load_family(path).title == "Meter M-1"


def test_every_key_of_a_register_in_a_family_file_is_loaded(tmp_path: Path) -> None:
    text = (
        HEAD
        + """\
[setting]
low = { at = 1, unit = "Hz", step = "unknown" }
high = { at = 2, unit = "Hz", step = 0.1, span = [0, 50], default = 10, at_least = "low", \
kept = "ram", ram_address = 0x1002, while_running = true, moves = false, \
place = "P", outside = "O", note = "N", title.ru = "верх" }
[command]
control = { at = 3, bits = { on = 0, reset = 1 }, harmless = [0], broadcast = [0], never_together = [3] }
"""
    )
    loaded = family(tmp_path, text)
    high, control = loaded.register("high"), loaded.register("control")
    assert loaded.register("low").step is None
    assert (high.span, high.default, high.at_least, high.kept) == ((0, 50), 10, "low", Kept.RAM)
    assert (high.ram_address, high.while_running, high.moves) == (0x1002, True, False)
    assert (high.place, high.outside, high.note) == ("P", "O", "N")
    assert (high.title, high.title_in("ru"), high.title_in("zh")) == ("high", "верх", "high")
    assert (control.harmless, control.broadcast, control.never_together) == ((0,), (0,), (3,))
    assert loaded.broadcasts


def test_family_file_can_declare_registers_written_by_function_10h(tmp_path: Path) -> None:
    loaded = family(
        tmp_path, HEAD + 'write = "multiple"\n[setting]\na = { at = 1 }\nb = { at = 2, write = "single" }\n'
    )
    assert [loaded.register(name).table.write for name in "ab"] == [0x10, 0x06]


def test_family_file_can_declare_a_device_without_a_motor(tmp_path: Path) -> None:
    reading = "[reading]\npower = { at = 1 }\n"
    assert family(tmp_path, HEAD + reading).has_motor
    assert not family(tmp_path, f"{HEAD}motor = false\n{reading}").has_motor


def test_a_family_file_may_allow_drive_addresses_0_to_255(tmp_path: Path) -> None:
    head = HEAD + "addresses = [0, 255]\n[reading]\nlevel = { at = 1 }\n"
    loaded = family(tmp_path, head)
    assert loaded.addresses == range(256)
    for unit in (0, 248, 255):
        loaded(unit).take_framing_of("tcp://10.0.0.7")
        with pytest.raises(ValueError, match=rf"address {unit} is valid only on Modbus TCP; on /dev/ttyUSB0"):
            loaded(unit).take_framing_of("/dev/ttyUSB0")
    assert any("addresses = [0, 256]" in one for one in mistakes(tmp_path, head.replace("255", "256")))


TWENTY = """\
[family]
title = "Meter M-1"
manuel = "Meter M-1, section 4"
baudrates = [9600, "fast"]
formats = ["7E1"]
addresses = [1, 300]
together = { holding = 200 }
silence = "soon"
registers = ["twenty.csv"]

[default]
tabel = "input"

[reading]
"speed 1" = { at = 0x0010 }
speed = { at = 0x0010, stepp = 0.1 }
voltage = { at = "40001", table = "input" }
level = { at = 40002, unit = "V" }
power = { at = "8192" }
mode = { at = 0x0020, values = { off = 0, on = 0 } }
flags = { at = 0x0021, bits = { a = 0, b = 99 } }
both = { at = 0x0022, unit = "V", values = { off = 0 } }

[setting]
limit = { at = 0x0030, span = [50, 0] }
target = { at = 0x0031, at_most = "limitt" }
speed = { at = 0x0032 }
gain = { at = 0x0033, while_running = "no" }
"""
TWENTY_CSV = "name;at;step;access\nan;1E10;0,1;reading\nbn;0x12;0.1;readings\n"
TWENTY_MISTAKES = [
    "twenty.toml:3: [family]: unknown key 'manuel'; did you mean manual?",
    "twenty.toml:8: [family]: silence = 'soon' is not a duration from 100 us to 24 h, such as \"50 ms\", "
    '"2 s" or "1 min"',
    "twenty.toml:6: [family]: addresses = [1, 300]: a range has a first and a last address from 1 to "
    "247 (0 to 255 on Modbus TCP); write addresses = [1, 247]",
    "twenty.toml:4: [family]: baudrates = [9600, 'fast']: 'fast' is not a baud rate; "
    "write baudrates = [9600, 19200]",
    "twenty.toml:7: [family]: together: holding = 200 is not a number of registers from 1 to 125",
    'twenty.toml:5: [family]: formats has "7E1", but an RTU frame needs 8 data bits; write "8E1"',
    "twenty.toml:12: [default]: unknown key 'tabel'; did you mean table?",
    "twenty.toml:15: [reading] speed 1: 'speed 1' cannot be a register's name: it may have letters a to "
    "z, digits and _, and must begin with a letter; write speed_1",
    "twenty.toml:16: [reading] speed: unknown key 'stepp'; did you mean step?",
    'twenty.toml:17: [reading] voltage: at: "40001" begins with 4, which stands for table holding, but '
    'table = "input"; remove the key table, or write an address of table input',
    "twenty.toml:18: [reading] level: at: 40002 may be the number 40002, or register 2 of table holding; "
    'write "9C42H" for that number, or "40002" in quotes for the register of the table (in a '
    "CSV file, remove counts_from)",
    'twenty.toml:19: [reading] power: at: "8192" may be decimal or hex; write 8192, or "8192H"',
    "twenty.toml:20: [reading] mode: values: on and off are both 0; give each its own",
    "twenty.toml:21: [reading] flags: bits: b = 99 is not a bit's number, 0 to 63",
    "twenty.toml:22: [reading] both: values and unit are both given; a register has only one of unit, values "
    "and bits",
    "twenty.toml:25: [setting] limit: span = [50, 0]: the value is in the wrong order: give the smallest "
    "first; write span = [0, 50]",
    "twenty.toml:27: [setting] speed: speed is declared twice, first in [reading] speed; "
    "every register has its own name",
    "twenty.toml:28: [setting] gain: while_running = 'no': the value is neither true nor false; "
    "write while_running = false",
    "twenty.csv: line 2, column step: '0,1' has a decimal comma; write 0.1",
    "twenty.csv: line 2, an: at: 1E10 is a power of ten, into which a spreadsheet has converted a hex "
    "number; write 1E10H",
    "twenty.csv: line 3, column access: 'readings' is not known; write reading, setting, command",
    "twenty.toml:1: [family]: 'counts_from' is missing, so the number 16 is ambiguous. Add counts_from = 0 "
    "if the manual's numbers are sent unchanged, or 1 if its register 1 is sent as 0",
    "twenty.toml:26: [setting] target: its bound limitt is neither an option nor a register with a readable "
    "number",
]


def test_more_than_twenty_mistakes_in_a_family_file_are_reported_together(tmp_path: Path) -> None:
    (tmp_path / "twenty.csv").write_text(TWENTY_CSV)
    path = tmp_path / "twenty.toml"
    path.write_text(TWENTY)
    with pytest.raises(FamilyError) as wrong:
        load_family(path)
    assert [
        mistake.removeprefix(f"{tmp_path}{os.sep}") for mistake in wrong.value.mistakes
    ] == TWENTY_MISTAKES
    assert len(TWENTY_MISTAKES) > 20


PROVING_NOTHING = {
    "above = -1": "every value is accepted",
    "above = -inf": "every value is accepted",
    "above = 5\nbelow = 3": "no value of the register is within these limits",
    "below = nan": "no value of the register is within these limits",
    "is = [70000]": "is = [70000] has no value that the register can hold within the limits",
}
DEVICE = HEAD + "[reading]\ndevice = { at = 3 }\nspeed = { at = 4, unit = 'Hz', step = 0.1 }\n"


@table(
    ("section", "mistakes"),
    [
        ('[[identify]]\nregister = "speed"\nabove = 71.5', []),
        ('[identify]\nregister = "device"\nis = [0x10A]', []),
        (
            '[[identify]]\nregister = "devise"\nis = [1]',
            ["identify number 1: register = 'devise' is not the name of a readable register in this file"],
        ),
        (
            '[[identify]]\nregister = "device"',
            ["identify number 1: has no expected value; add is = [0x010A], or the keys above and below"],
        ),
        (
            '[[identify]]\nregister = "device"\nis = ["x"]',
            ["identify number 1: is = ['x'] is not right; write is = [0x010A]"],
        ),
        (
            '[[identify]]\nregister = "device"\nist = [1]',
            ["identify number 1: unknown key 'ist'; did you mean is?"],
        ),
        (
            "\n".join(f'[[identify]]\nregister = "device"\n{limits}' for limits in PROVING_NOTHING),
            [
                f"identify number {number}: {why}; give values of device that other drives do not have"
                for number, why in enumerate(PROVING_NOTHING.values(), 1)
            ],
        ),
        ("[[identify]]\nis = [1]", ["identify number 1: 'register' is missing; add register = \"device\""]),
        ("identify = 5", ["identify number 1: 5 is not a table with register, is, above, below"]),
        (
            "[verb.stop]\nsteps = []",
            ["[verb] is not supported; add profile to [family], or write the drive as a Python class"],
        ),
    ],
)
def test_mistakes_in_identify_and_verb_sections_are_reported(
    tmp_path: Path, section: str, mistakes: list[str]
) -> None:
    first, rest = ("", DEVICE + section) if section.startswith("[") else (section + "\n", DEVICE)
    (tmp_path / "t.toml").write_text(first + rest)
    found: tuple[str, ...] = ()
    try:
        load_family(tmp_path / "t.toml")
    except FamilyError as wrong:
        found = wrong.mistakes
    assert [mistake.partition("t.toml:")[2].partition(": ")[2] for mistake in found] == mistakes


WRONG_KEYS = [  # each text has one wrong key of a register
    ("harmless = [0]", "[reading] a: a reading is never written"),
    ("step = inf", "step = inf: the value is not a finite number; write step = 0.1"),
    ("step = 0", "step = 0: every reading would be 0; write step = 0.1"),
    ("number_format = 'F31'", "number_format = 'F31': the value is not known; did you mean"),
    ("values = {}", "values is empty; remove it"),
    (
        "title.de = 'Strom'",
        "title = {'de': 'Strom'}: the language de is unknown, not one of ru, zh; write title.ru",
    ),
    ("title = 'ток'", "title = 'ток': the value is not a table of titles by language"),
    ("title.ru = ''", "has a title of 0 characters, not 1 to 100"),
    ("bits = { real = 0 }", "'real' is a name that all enumerations"),
    ("bits = { On = 0, on = 1 }", "on and On differ in capitals alone"),
    ("unit = 5", "unit = 5: the value is not a text; write unit = "),
    ('unit = "a\\tb"', "the value has unprintable characters; remove them"),
    (f"note = '{1001 * 'x'}'", "the value has more than 1000 characters"),
    ("offset = 'x'", "offset = 'x': the value is not a number; write offset = -40"),
    ("span = 5", "span = 5: the value is not two numbers; write span = [0, 50]"),
    ("harmless = 0", "harmless = 0: the value is not a list of raw counts"),
    (f"harmless = {101 * [0]}", "the value has more than 100 raw counts"),
    ("invalid = []", "invalid = []: the value is not a list of 1 to 100 raw counts"),
    ("part = 1.5", "part = 1.5: the value is not a bit's number or a range of bits"),
    ("part = '7-4'", "part = '7-4': the value is in the wrong order: give the lowest bit first"),
    ("values = 5", "values = 5: the value must be a table of names and numbers"),
    ("values = { 1a = 0 }", "values: '1a' is not a name: it may have letters a to z"),
    (f"values = {{ {', '.join(f'v{n} = {n}' for n in range(501))} }}", "values has 501 names, more than"),
]
WRONG_SECTIONS = [  # each text is a wrong section before a valid section [reading]
    ("[option]\nx = { span = [2, 1], meaning = 'm' }", "span = [2, 1]"),
    (
        "[option]\nconfirmed = { span = [1, 2], meaning = 'm' }",
        "[option] confirmed: 'confirmed' cannot be an option's name: reserved name: every drive",
    ),
    ("gaps = { input = [9, 1] }", "gaps: input = [9, 1] is in the wrong"),
    ("silence = '2 s'", "silence = '2 s' is more than 1 s"),
    ("response_timeout = '11 s'", "'11 s' is more than 10 s"),
    ("framings = ['tcp']", "'tcp' is not one of rtu, ascii"),
    ("framings = ['delixi']", "'delixi' is not one of rtu, ascii"),
    ("exceptions = { 300 = 'x' }", "300 = 'x' is not an exception code from 1 to 255"),
    ("exceptions = { 8g = 'x' }", "'8g' is not an exception code"),
    ("write = 'both'", "write = 'both' is not right; write write = \"single\""),
    ("formats = [5]", "formats = [5]: 5 is not a format"),
    ("formats = { rtu = 5 }", "formats = {'rtu': 5}: 5 is not a list of formats"),
    ("formats = { rtu = ['8N1'], tcp = ['8N1'] }", "formats has 'tcp', which is not one of the framings rtu"),
    ("framings = ['rtu', 'ascii']\nformats = { rtu = ['8N1'] }", "formats has no list for ascii; add ascii"),
    ("framings = ['rtu', 'ascii']\nformats = { ascii = ['7E1'] }", "formats has no list for rtu; add rtu"),
    ("formats = {}", "formats has no list for rtu; add rtu"),
    ("read_together = [5]", "read_together = [5]: 5 is not a list of registers' names"),
    ("gaps = { inputs = [1, 2] }", "gaps has 'inputs', which is not a register table; write holding, input"),
    ("gaps = { input = 5 }", "gaps: input = 5 is not a list of a first and a last address"),
    ("gaps = { input = ['x', 2] }", 'gaps: input: "x" is not an address'),
    ("profile = 'delta'\nextends = 'yd1000'", "has the keys profile and extends; remove one of them"),
    (f"registers = {[f'{n}.csv' for n in range(21)]}", "registers names 21 files, more than the allowed 20"),
    ("[default]\nstep = 0", "[default]: step = 0: every reading would be 0"),
    ("[option]\na = { span = [1, 2], meaning = 'm' }", "[option] a: a register has the same name"),
    (21 * "[[identify]]\nregister = 'a'\nis = [1]\n", "[[identify]] has 21 tables, more than the allowed 20"),
]
WRONG_TEXTS = [  # each text has a mistake, and follows the valid text HEAD
    ("", "t.toml: declares no register; add [reading] and NAME = { at = 0x0010 }"),
    ("[readings]\na = { at = 1 }\n", "t.toml: unknown key 'readings'; did you mean reading?"),
    ("[reading]\na = 5\n", "t.toml: [reading] a: 5 is not a register; write { at = 0x0010"),
    ("[reading]\na = {}\n", "t.toml: [reading] a: the register's address is missing; add at = 0x2000"),
    ("[reading]\nname = { at = 1 }\n", "t.toml: [reading] name: reserved name: every drive"),
    ("[reading]\nclass = { at = 1 }\n", "t.toml: [reading] class: 'class' cannot be a register's"),
    ('[setting]\na = { at = "30001" }\n', "an input register cannot be written"),
    ("[setting]\na = { at = 1 }\nb = { at = 1, step = 2 }\n", "b: a is written at the same address"),
    ("[reading]\nstart = { at = 1 }\n", "[reading] start: reserved name: every drive has an attribute"),
    ("registers = ['/etc/passwd']\n", "registers = '/etc/passwd' is not a CSV file"),
    (
        "registers = ['/etc/x.csv']\n",
        "is outside the family file's folder: put the CSV file there, or below it",
    ),
    (
        "registers = ['../x.csv']\n",
        "is outside the family file's folder: put the CSV file there, or below it",
    ),
    (
        "registers = ['C:\\x.csv']\n",
        "is outside the family file's folder: put the CSV file there, or below it",
    ),
    ("registers = ['C:x.csv']\n", "is outside the family file's folder: put the CSV file there, or below it"),
    (
        "registers = ['..\\x.csv']\n",
        "is outside the family file's folder: put the CSV file there, or below it",
    ),
    ("registers = ['x.csv']\n", 'registers = ["x.csv"]: there is no such file'),
    ("option = 3\n", "declares no register"),
    (f"[reading]\n{61 * 'a'} = {{ at = 1 }}\n", "it has more than 60 characters; give it a shorter one"),
    (
        "[reading]\n" + "".join(f"a{n} = {{ at = {n} }}\n" for n in range(2001)),
        "declares more than 2000 registers; remove unused ones",
    ),
]
WRONG_FILES = [  # each text is a whole family file with a mistake
    ("", "t.toml: has no [family]; add it, with the title and the manual"),
    ("[family", "t.toml: the file is not TOML: a header lacks a bracket"),
    (
        '[[line]]\nname = "L"\n',
        "is a plant file, not a family file; to name one of its drives, write PLANT.toml DRIVE",
    ),
    ("family = 3\n", "[family]: 3 is not a table with title"),
    ("family = 3\nreading = 4\n", "[reading] is not a table"),
    ("default = 5\n" + HEAD, "[default]: is not a table; write [default] and table ="),
    ("option = 5\n" + HEAD, "[option] is not a table; write [option] and NAME ="),
    ("text = 5\n" + HEAD, "[text] is not a table; write [text] and NAME ="),
    (HEAD.replace("= 0", "= 2"), "counts_from = 2 is not right; write counts_from = 0, or 1"),
]


@table(
    ("text", "expected"),
    [
        *((f"{HEAD}[reading]\na = {{ at = 1, {key} }}\n", expected) for key, expected in WRONG_KEYS),
        *((f"{HEAD}{part}\n[reading]\na = {{ at = 1 }}\n", expected) for part, expected in WRONG_SECTIONS),
        *((HEAD + text, expected) for text, expected in WRONG_TEXTS),
        *WRONG_FILES,
    ],
)
def test_mistake_in_a_family_file_is_reported_with_its_line(tmp_path: Path, text: str, expected: str) -> None:
    found = mistakes(tmp_path, text)
    assert any(expected in mistake for mistake in found), found


@table(
    ("data", "expected"),
    [
        (b"", "c.csv: is empty; its first line names the columns"),
        (
            b"at,unit\n1,V\n",
            "c.csv: line 1: no column is called 'name'; the first line names the columns: name",
        ),
        (b"name,adress\na,1\n", "c.csv: line 1: unknown key 'adress'"),
        (b"name,at,at\na,1,2\n", "c.csv: line 1: two columns are called 'at'"),
        (b"name,at\na,1,5\n", "c.csv: line 2: has 3 cells, but the first line names 2 columns"),
        (b"name;at;step\na;1;0,1\n", "c.csv: line 2, column step: '0,1' has a decimal comma; write 0.1"),
        (b'name,at,step\na,1,"1.000,5"\n', "column step: '1.000,5' has a decimal comma; write 1000.5"),
        (
            b"name,at,invalid\na,1,7FFF\n",
            "column invalid: '7FFF' is not a number; write it as 0.1, 10 or 0x7FFF",
        ),
        (b"name,at,harmless\na,1,1E10\n", "column harmless: '1E10' is not a whole number; write 0x1E10"),
        (
            b"name,at,values\na,1,off\n",
            "column values: 'off' is not of the form name=number; write off=0 | on=1",
        ),
        (b"name,at,title\na,1,tok\n", "column title: 'tok' is not of the form language=title; write ru="),
        (b"name,at,title\na,1,ru=a|ru=b\n", "column title: ru is given twice; give it once"),
        (b"name,at,moves\na,1,maybe\n", "column moves: 'maybe' is neither true nor false"),
        (b'name,at\na,"1\n', "c.csv: line 2: is not CSV: "),
        (b"name,at\n\xff,1\n", "c.csv: is not text in UTF-8, from byte 8 on; save it as CSV UTF-8"),
        (b"\xff\xfen\0a\0", "c.csv: is not text in UTF-8, from byte 0 on"),
        (b"name,at\na,1\na,2\n", "line 3, a: a is declared twice, first in line 2, a"),
        (b"name,at\n\na b,1\n", "c.csv: line 3, a b: 'a b' cannot be a register's name"),
        (b"name,at,,\n,1,,\n", "c.csv: line 2, column name: the register's name is missing"),
        (b"name,at\na\0,1\n", "c.csv: contains NUL bytes; save it as CSV UTF-8"),
        (
            b"name,at,harmless\na,1,1234567890123456789012\n",
            "column harmless: '1234567890123456789012' has too many digits",
        ),
        (
            b"name,at\n" + b"".join(b"a%d,%d\n" % (n, n) for n in range(2001)),
            "c.csv: has more than 2000 registers; remove unused ones",
        ),
    ],
)
def test_mistake_in_a_csv_table_is_reported_with_its_line(tmp_path: Path, data: bytes, expected: str) -> None:
    (tmp_path / "c.csv").write_bytes(data)
    found = mistakes(tmp_path, HEAD + 'registers = ["c.csv"]\n')
    assert any(expected in mistake for mistake in found), found


@pytest.mark.parametrize(
    "text", ["name;at;unit\na;0x10;V\n", "name\tat\tunit\na\t16\tV\n", 'Name,At,Unit\n"a","10H",V\n']
)
def test_csv_register_table_may_use_any_delimiter(tmp_path: Path, text: str) -> None:
    (tmp_path / "c.csv").write_text(text)
    loaded = family(tmp_path, HEAD + 'registers = ["c.csv"]\n')
    assert (loaded.register("a").address, loaded.register("a").unit) == (16, "V")


def test_csv_register_table_may_use_addresses_such_as_40001(tmp_path: Path) -> None:
    (tmp_path / "c.csv").write_text("name,at\na,40001\nb,300010\nc,00001\nd,10002\n")
    loaded = family(tmp_path, '[family]\ntitle = "T"\nmanual = "M"\nregisters = ["c.csv"]\n')
    found = [(one.table.name, one.address) for one in loaded.registers.values()]
    assert found == [("holding register", 0), ("input register", 9), ("coil", 0), ("discrete input", 1)]


def test_every_column_of_a_csv_register_table_is_loaded(tmp_path: Path) -> None:
    (tmp_path / "c.csv").write_text(
        "name,at,access,step,span,values,kept,while_running,harmless\n"
        "a,1,setting,0.5,0 | 50,,eeprom,no,\n"
        "b,2,command,,,off=0 | on=0x10,ram,,0 | 0x10\n"
    )
    loaded = family(tmp_path, HEAD + 'registers = ["c.csv"]\n')
    a, b = loaded.register("a"), loaded.register("b")
    assert (a.step, a.span, a.kept, a.while_running) == (0.5, (0, 50), Kept.EEPROM, False)
    assert b.harmless == (0, 16)
    assert b.values is not None
    assert [(each.name, each.value) for each in b.values] == [("off", 0), ("on", 16)]


def test_missing_or_invalid_family_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FamilyError, match="there is no such file"):
        load_family(tmp_path / "none.toml")
    for path in (tmp_path, Path("/dev/zero")):
        with pytest.raises(FamilyError, match="is not a file, but a directory or a device; name a file"):
            load_family(path)


def test_number_of_reported_mistakes_in_a_family_file_is_limited(tmp_path: Path) -> None:
    text = HEAD + "[reading]\n" + "".join(f"a{number} = 5\n" for number in range(300))
    found = mistakes(tmp_path, text)
    assert (len(found), found[-1]) == (201, "t.toml: 100 more mistakes are not shown; correct these first")


def test_reference_page_documents_every_key_of_a_family_file() -> None:
    page = (Path(__file__).parents[3] / "docs" / "reference" / "family-file.md").read_text("utf-8")
    missing = [key for key in (*FAMILY_KEYS, *REGISTER_KEYS) if f"`{key}`" not in page]
    assert missing == []
    assert [section for section in SECTIONS if f"[{section}]" not in page] == []


def test_family_file_can_declare_text_registers(tmp_path: Path) -> None:
    entries = 'serial = { at = 0xFC00, length = 8, order = "BA" }\nkind = { at = "30011", length = 2 }\n'
    loaded: Any = family(tmp_path, HEAD + "[text]\n" + entries)
    assert (loaded.serial.address, loaded.serial.length, loaded.serial.order) == (0xFC00, 8, "BA")
    assert (loaded.kind.table, loaded.kind.address) == (INPUT, 10)
    assert list(loaded.texts) == ["serial", "kind"]


@table(
    ("entry", "expected"),
    [
        ("a = { at = 1 }", "[text] a: 'length' is missing; add length = 8"),
        ("a = { at = 1, length = 126 }", "length = 126 of a text is not 1 to 125 registers"),
        ("a = { at = 1, length = 2, order = 'CDAB' }", "a text has order = 'CDAB'"),
        ("a = { at = '00001', length = 2 }", "a text has the table 'coil'; a text must be in"),
        ("a = { at = 1, length = 2 }\n[reading]\na = { at = 1 }", "a register has the same name"),
        (
            "name = { at = 1, length = 2 }",
            "[text] name: reserved name: every drive has an attribute",
        ),
        ("1a = { at = 1, length = 2 }", "[text] 1a: '1a' cannot be a text's name: it may have letters"),
        ("a = { at = '8192', length = 2 }", '[text] a: "8192" may be decimal or hex'),
        (
            "".join(f"a{n} = {{ at = 1, length = 2 }}\n" for n in range(101)),
            "[text] has 101 texts, more than",
        ),
    ],
)
def test_mistakes_in_text_registers_are_reported(tmp_path: Path, entry: str, expected: str) -> None:
    found = mistakes(tmp_path, HEAD + "[text]\n" + entry + "\n")
    assert any(expected in mistake for mistake in found), found


RULE = """[setting]
ramp = { at = "0001H", unit = "s", step = 0.1 }
[parameters]
groups = [{ code = "P00.", at = "0000H", count = 3 }, { code = "P", at = "1000H", count = 2, digits = 3 }]
"""


def test_parameter_addresses_are_computed_by_the_rule_in_a_family_file(tmp_path: Path) -> None:
    more = 'line = ["P00.00"]\npasswords = ["P001"]\nnever = { "P00.02" = "it starts a test" }\n'
    found = parameters_of(family(tmp_path, HEAD + RULE + more))
    assert {code: (one.name, one.address) for code, one in found.items()} == {
        "P00.00": ("P00.00", 0),
        "P00.01": ("ramp", 1),
        "P00.02": ("P00.02", 2),
        "P000": ("P000", 0x1000),
        "P001": ("P001", 0x1001),
    }
    assert [code for code, one in found.items() if one.never] == ["P00.00", "P00.02", "P001"]
    assert [code for code, one in found.items() if one.is_line] == ["P00.00"]


@table(
    ("rule", "expected"),
    [
        ("line = []", "[parameters]: 'groups' is missing; add groups = "),
        ("groups = [{ code = 1 }]", "[parameters], group number 1: code = 1 is not right; write code = "),
        ('groups = [{ code = "P", at = 0, count = 70000 }]', "count = 70000 is not right"),
        ('groups = [{ code = "P", at = 0, count = 20000 }]', "groups have more than 10000 parameter codes"),
        ('groups = [{ code = "P", at = 0, count = 2 }]\nline = [1]', "line = [1] is not right"),
        (
            'groups = [{ code = "P", at = 0, count = 2 }]\nfirmware = "x"',
            "firmware = 'x' is not the name of a register",
        ),
    ],
)
def test_mistakes_in_the_parameters_section_are_reported(tmp_path: Path, rule: str, expected: str) -> None:
    text = f"{HEAD}[reading]\na = {{ at = 1 }}\n[parameters]\n{rule}\n"
    assert any(expected in mistake for mistake in mistakes(tmp_path, text))


EXTENDING = {
    "yd1000": [
        ('[setting]\ncontrol = { at = "1000H" }', "[setting] control: YD1000 has this name already"),
        ('[reading]\ncontrol = { at = "1300H" }', "[reading] control: YD1000 has this name already"),
        ('[text]\ncontrol = { at = "1300H", length = 4 }', "[family]: control: YD1000 has this name"),
        ('[setting]\nhz = { at = "1001H", step = 0.01, unit = "Hz" }', "YD1000 has frequency at this"),
        ('[setting]\nx = { at = "0900H", ram_address = "0800H" }', "has baudrate_setting at this"),
        (
            '[reading]\nx = { at = "1300H" }\n[parameters]\ngroups = [{ code = "F", at = 0, count = 9 }]',
            "[parameters]: YD1000 has its own rule",
        ),
        (
            '[reading]\nx = { at = "1300H" }\n[[identify]]\nregister = "x"\nis = [5]',
            "[[identify]]: YD1000 has its own identity check",
        ),
    ],
    "innovert-ibd": [
        ("[reading]\noutput_frequency = { at = 300, offset = -5 }", "it is 0 only at rest"),
    ],
    "delixi-modbus": [("[setting]\nsource = { at = 0 }", "(Modbus) has run_source at this address")],
}


@table(
    ("extended", "declared", "expected"),
    [(extended, *row) for extended, rows in EXTENDING.items() for row in rows],
)
def test_family_file_that_extends_a_family_cannot_replace_its_safeguards(
    tmp_path: Path, extended: str, declared: str, expected: str
) -> None:
    (only,) = mistakes(tmp_path, f'{HEAD}extends = "{extended}"\n{declared}\n')
    assert expected in only


def test_family_file_that_extends_a_family_may_add_readings_and_settings(tmp_path: Path) -> None:
    more = '[reading]\nheld = { at = "0009H" }\n[setting]\nfan = { at = "0900H" }\n'
    assert {"held", "fan", "control"} <= family(
        tmp_path, f'{HEAD}extends = "yd1000"\n{more}'
    ).registers.keys()


def test_number_format_and_byte_order_in_a_family_file_are_loaded(tmp_path: Path) -> None:
    text = (
        HEAD
        + """\
[default]
number_format = "F32"
order = "CDAB"
invalid = "NaN"
[reading]
power = { at = 1, unit = "W" }
level = { at = 3, number_format = "I16", offset = -40, invalid = [0x7FFF, 0x8000], step = -0.1, order = "BA" }
count = { at = 4, number_format = "U64", order = "DCBA", invalid = 0 }
flag = { at = 8, number_format = "U16", part = "3", order = "ABCD" }
field = { at = 8, number_format = "U16", part = "4-7", values = { off = 0, on = 1 }, order = "ABCD" }
current = { at = 9, number_format = "U16", scale_register = "power_of_ten", order = "ABCD" }
power_of_ten = { at = 10, number_format = "I16", order = "ABCD" }
"""
    )
    found = family(tmp_path, text).registers
    power, level, count = found["power"], found["level"], found["count"]
    assert (power.order, len(power.invalid), power.invalid[0] != power.invalid[0]) == ("CDAB", 1, True)
    assert (level.offset, level.step, level.invalid, level.order) == (-40, -0.1, (0x7FFF, 0x8000), "BA")
    assert (count.number_format, count.order, count.invalid) == (NumberFormat.U64, "DCBA", (0,))
    assert (found["flag"].part, found["field"].part) == ((3, 3), (4, 7))
    assert found["current"].scaled_by is found["power_of_ten"]


SEEDS = list(seeds.family())
WORDS = (
    *(b"-1", b"0", b"65535", b"65536", b"1e400", b"-inf", b"nan", b"true", b'""', b"[]", b"{}", b"[[]]"),
    *(b"9223372036854775807", b"1979-05-27", b"'NaN'", b'"40001"', b'"1E10"', b"0x7FFF", b"[1, 2]", b'["a"]'),
    *(
        b"{ a = 1 }",
        b'{ a = "b" }',
        b"[family]",
        b"[reading]",
        b"[option]",
        b"[[line]]",
        b"= 1",
        b"\xff",
        b"\0",
    ),
    *(b"at = ", b"values = ", b"bits = ", b"table = ", b"unit = ", b"span = ", b"steps = ", b"await = "),
)

ENOUGH = 20.0  # time limit in s for loading one file


def mutated(data: bytes, chosen: random.Random) -> bytes:
    """Return the file with up to four pieces replaced, doubled, moved or removed."""
    for _ in range(chosen.randint(1, 4)):
        begin = chosen.randrange(len(data) + 1)
        end = min(len(data), begin + chosen.choice((0, 1, 3, 10, 40)))
        other = chosen.randrange(len(data) + 1)
        piece = chosen.choice(
            (chosen.choice(WORDS), b"", data[other : other + 30], data[begin:end] * 2, chosen.randbytes(2))
        )
        if chosen.random() < 0.4:  # replaces a whole value: the file often stays valid TOML
            begin = data.find(b"= ", begin) + 2
            ends = [at for at in (data.find(mark, begin) for mark in (b",", b" }", b"\n")) if at > 0]
            end = min(ends, default=begin)
        data = data[:begin] + piece + data[end:]
    return data


@pytest.mark.slow
@settings(max_examples=examples(300))
@given(st.sampled_from(SEEDS), st.integers(0, 2**32))
def test_damaged_family_file_raises_only_readable_errors(seed: bytes, number: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        read("family", mutated(seed, random.Random(number)), Path(folder))


def wide(count: int) -> bytes:
    head = b'[family]\ntitle = "T"\nmanual = "M"\ncounts_from = 0\n[setting]\n'
    return head + b"".join(b"a%d = { at = %d }\n" % (at, at) for at in range(count))


LARGE = {
    "many": lambda: wide(1990),
    "deep": lambda: b"a = " + b"[" * 100_000,
    "dotted": lambda: b"a." * 100_000 + b"b = 1",
    "large": lambda: b"#" * 5_000_000,
    "too many": lambda: wide(20_000),
    "long csv": lambda: b'[family]\nregisters = ["fuzzed.csv"]\n\n\0\nname,at\n' + b"a,1\n" * 100_000,
}


@pytest.mark.long
@pytest.mark.parametrize("name", [*list(LARGE)[:4], *usually(*list(LARGE)[4:])])
def test_large_family_file_loads_in_less_than_twenty_seconds(tmp_path: Path, name: str) -> None:
    """A loader that compares every register with every other register would take minutes."""
    large = LARGE[name]()
    begun = time.process_time()
    read("family", large, tmp_path)
    assert time.process_time() - begun < ENOUGH
