"""`multidrop schema`: it accepts valid plant and family files of docs and tests, and refuses invalid ones.

The invalid files are those of the loaders' own tests, and those below. The schema accepts 6 of the 136
invalid plant files, and 8 of the 163 invalid family files. Each accepted file breaks a rule of NOT_STATED.
"""

from __future__ import annotations

import importlib.util
import re
import subprocess
import tomllib
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from commands import MULTIDROP
from gateways import written
from peers import require_program
from tables import table

from multidrop import PlantError
from multidrop.cli.completion import schema_of
from multidrop.families.files import FamilyError
from multidrop.families.files.loader import load_family
from multidrop.gateway.settings import read_settings
from multidrop.plant import RESERVED_NAMES
from multidrop.plant.loader import load_plant

jsonschema = pytest.importorskip("jsonschema")
ROOT = Path(__file__).parents[2]
LEAST = 0.95  # required share of refused files, among all invalid files

NOT_STATED = {  # rules that JSON Schema cannot state, with patterns of the sentences that report them
    "names and ports at several places differ": r"already (has this name|used)|has the same name",
    "numbers at several places differ": r"are both|at the same address",
    "names differ not only in capitals": r"differ in capitals",
    "units of an expression agree": r"cannot be (combined|converted)",
    "a file exists": r"there is no (such )?file",
    "a register suits the commands of the extended family": r"it is 0 only at rest",
    "the bits of a range ascend": r"give the lowest bit first",
}


def module(path: str) -> Any:
    """Import a test module so that pytest does not collect its tests again."""
    spec = importlib.util.spec_from_file_location("judged", ROOT / "tests" / path)
    assert spec is not None
    assert spec.loader is not None
    found = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(found)
    return found


PLANTS, FAMILIES = module("plant/test_plant.py"), module("families/files/test_loader.py")
# families as users declare them; the plant files of the tests refer to them
OWN = ("family.py:Toy", "family.py:Fixed", "family.py:Mute")


@cache
def schema(kind: str) -> Any:
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "family.py").write_text(PLANTS.FAMILY)
        made = schema_of(kind, OWN if kind == "plant" else (), folder)
    jsonschema.Draft7Validator.check_schema(made)
    return jsonschema.Draft7Validator(made)


def accepts(kind: str, text: str) -> bool:
    return bool(schema(kind).is_valid(tomllib.loads(text)))


def documented(section: str) -> list[str]:
    """Return the TOML examples of the documentation that contain this section."""
    pages = "\n".join(page.read_text("utf-8") for page in (ROOT / "docs").rglob("*.md"))
    return [text for text in re.findall(r"```toml\n(.*?)```", pages, re.DOTALL) if section in text]


def is_toml(text: str) -> bool:
    try:
        tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return False
    return True


def mistakes(kind: str, text: str) -> str:
    """Return the sentences with which the loader refuses a file; "" for a valid file."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "family.py").write_text(PLANTS.FAMILY)
        (folder / "file.toml").write_text(text, "utf-8")
        try:
            load_plant(folder / "file.toml") if kind == "plant" else load_family(folder / "file.toml")
        except (PlantError, FamilyError) as wrong:
            return "\n".join(wrong.mistakes)
    return ""


def check_refusals(kind: str, invalid: Sequence[str]) -> None:
    """Check that the schema refuses all invalid files, except files with a mistake of NOT_STATED."""
    accepted = {text: mistakes(kind, text) for text in invalid if accepts(kind, text)}
    unstated = re.compile("|".join(NOT_STATED.values()))
    assert {text: told for text, told in accepted.items() if not unstated.search(told)} == {}
    assert len(invalid) > 70
    assert len(accepted) <= (1 - LEAST) * len(invalid), accepted


SERVE = """\
[serve]
listen = "0.0.0.0:8443"
names = ["plant.example"]
certificate = "own.pem"
key = "own.key"
tokens = "tokens"
[serve.may]
look = "token"
verbs = ["pump-*.start"]
family.toy = { write = ["acceleration_time"] }
[[serve.limit]]
drive = "pump-1"
register = "output_current"
above = 30
for = "5 s"
[serve.mqtt]
broker = "mqtts://broker:8883"
prefix = "site/multidrop"
sparkplug = "Plant"
[serve.modbus]
listen = "127.0.0.1:1502"
units = { pump-1 = 7 }
clients = ["10.0.0.0/24", "::1"]
[serve.notify]
on = ["fault"]
[serve.history]
keep = "30 days"
[serve.trigger]
pre = "100 ms"
conditions = { trip = "pump-1.output_current > 30", any-fault = "fault" }
[serve.fleet]
nats = ["nats://a:4222"]
"""
BAD_SERVE = """\
listen = "everywhere"
listen = "127.0.0.1:70000"
listen = "0.0.0.0:80"
listen = 80
names = ["http://plant.example/"]
names = "plant.example"
nmaes = ["plant.example"]
certificate = "cert.pem"
behind_proxy = "yes"
may.look = "everybody"
may.look = "token"
may.write = ["setpoint"]
may.write = ["*"]
may.write = "pump-1.setpoint"
may.verbs = ["pump-1.fly"]
may.verbs = ["*.stop"]
may.family.invt-che = { look = ["token"] }
may.family.invt-che = ["start"]
may.family.invt-che = { verbs = ["pump-1.start"] }
limit = [{ drive = "pump-1", register = "output_current" }]
limit = [{ drive = "pump-1", register = "output_current", above = 1, below = 0 }]
limit = [{ drive = "pump-1", register = "output_current", above = 1, for = "5" }]
limit = [{ drive = "pump-1", register = "output_current", above = 1, hysteresis = -1 }]
limit = [{ drive = "pump-1", above = "1", register = "output_current" }]
mqtt.broker = "http://broker"
mqtt.broker = "mqtt://anna:secret@broker"
mqtt.prefix = "a/#"
mqtt.prefix = "$SYS"
mqtt.prefix = "homeassistant/x"
mqtt.every = "fast"
mqtt.sparkplug = "STATE"
mqtt.node = "a/b"
mqtt.qos = 1
mqqt = {}
modbus.listen = "1502"
modbus.passing = "some"
modbus.may = "all"
modbus.units = { pump-1 = 0 }
modbus.ports = { hall = 70000 }
modbus.clients = ["everyone"]
modbus.common = 70000
notify.on = ["rain"]
notify.most = 0
history.keep = "long"
history.most = "20"
history.rotate = 10
influx.most = "20"
upload.most = "much"
postgres.most = "0.5 EB"
mqtt.most = "1"
opcua.listen = "4840"
tool.pty = { hall = 3 }
trigger.pre = "5"
trigger.conditions = {}
trigger.conditions = { trip = 3 }
trigger.conditions = { trip = "" }
fleet.nats = []
fleet.nats = ["10.0.0.1"]
fleet.nats = "nats://a:4222"
"""
BAD_FLEET = """\
may.verbs = ["pump-1.fly"]
may.wirte = ["pump-1.setpoint"]
may.family.yd1000 = { verbs = ["start"] }
may = []
nats = []
"""


def valid_plants() -> list[str]:
    examples = [*documented("[[line]]"), *documented("[serve.fleet]")]
    return [*examples, PLANTS.GOOD, PLANTS.SILENT, PLANTS.HEAD + PLANTS.TOY, PLANTS.GOOD + SERVE]


def invalid_plants() -> list[str]:
    """Return the invalid plant files of the loader's tests."""
    good = PLANTS.HEAD + PLANTS.TOY
    rows = PLANTS.test_each_plant_file_mistake_gives_one_sentence.rows
    ports = (*PLANTS.UNDOCUMENTED, "tcp://bob:S3C@ET@10.0.0.7")
    texts = [
        *(text for text, _ in rows),
        *(good.replace('port = "/dev/a"', f'port = "{port}"') for port in ports),
        *(good.replace('"D"', f'"{name}"') for name in (*RESERVED_NAMES, "--all", "-")),
        *(good + f"poll = {polls}" for polls in ('["*", "*"]', '["*", { register = "*" }]')),
        *(PLANTS.FILE.replace(right, wrong) for right, wrong, *_ in PLANTS.WRONG_CHANNELS),
        *(f"{good}[serve]\n{line}\n" for line in BAD_SERVE.splitlines()),
        *(f"{good}[fleet]\n{line}\n" for line in BAD_FLEET.splitlines()),
    ]
    return [text for text in texts if is_toml(text)]


@pytest.mark.long
def test_the_schema_accepts_the_valid_plant_files() -> None:
    valid = valid_plants()
    assert len(valid) > 20
    assert [text for text in valid if not accepts("plant", text)] == []


def test_the_schema_refuses_the_invalid_plant_files() -> None:
    check_refusals("plant", invalid_plants())


def test_the_schema_refuses_mistakes_in_the_serve_table(tmp_path: Path) -> None:
    lines = BAD_SERVE.splitlines()
    for line in lines:
        with pytest.raises(PlantError):
            read_settings(written(tmp_path, f"[serve]\n{line}\n"), {})
    plant = PLANTS.HEAD + PLANTS.TOY
    assert [line for line in lines if accepts("plant", f"{plant}[serve]\n{line}\n")] == []


def test_the_schema_refuses_mistakes_in_the_fleet_table() -> None:
    plant = PLANTS.HEAD + PLANTS.TOY
    assert accepts("plant", f'{plant}[fleet]\nmay.write = ["pump-*.setpoint"]\n')
    assert [line for line in BAD_FLEET.splitlines() if accepts("plant", f"{plant}[fleet]\n{line}\n")] == []


def invalid_families() -> list[str]:
    """Return the invalid family files of the loader's tests."""
    head, reading = FAMILIES.HEAD, "[reading]\na = { at = 1 }\n"
    texts = [text for text, _ in FAMILIES.test_mistake_in_a_family_file_is_reported_with_its_line.rows]
    texts += [
        f"{head}[text]\n{entry}\n" for entry, _ in FAMILIES.test_mistakes_in_text_registers_are_reported.rows
    ]
    for rule, _ in FAMILIES.test_mistakes_in_the_parameters_section_are_reported.rows:
        texts.append(f"{head}{reading}[parameters]\n{rule}\n")
    for section, _ in FAMILIES.test_mistakes_in_identify_and_verb_sections_are_reported.rows:
        is_table = section.startswith("[")
        texts.append(FAMILIES.DEVICE + section if is_table else f"{section}\n{FAMILIES.DEVICE}")
    for (
        base,
        declared,
        _,
    ) in FAMILIES.test_family_file_that_extends_a_family_cannot_replace_its_safeguards.rows:
        texts.append(f'{head}extends = "{base}"\n{declared}\n')
    lines = FAMILIES.TWENTY.splitlines()
    for number, line in enumerate(lines):
        if " = " in line and number > 2:  # try each of the twenty mistakes in a file of its own
            section = next(one for one in lines[number::-1] if one.startswith("["))
            table = "" if section == "[family]" else f"{section}\n"
            texts.append(f"{head}{table}{line}\n{reading if section != '[reading]' else ''}")
    return [*bad_families(), *(text for text in texts if is_toml(text) and mistakes("family", text))]


BAD_REGISTERS = """\
reading a = { at = 1, number_format = "F32", values = { off = 0 } }
reading a = { at = 1, number_format = "F32", part = "0-3" }
reading a = { at = 1, number_format = "I16", values = { off = 40000 } }
reading a = { at = 1, number_format = "U16", values = { off = -1 } }
reading a = { at = 1, values = { off = 70000 } }
reading a = { at = 1, bits = { on = 16 } }
reading a = { at = 1, number_format = "U16", invalid = "NaN" }
reading a = { at = 1, number_format = "U16", invalid = 70000 }
reading a = { at = 1, number_format = "U16", part = 16 }
reading a = { at = 1, number_format = "U32", order = "BA" }
reading a = { at = 1, number_format = "U32_EITHER", order = "CDAB" }
reading a = { at = 1, invalid = [1, 2, 3, 4, 5] }
reading a = { at = 65536 }
reading a = { at = "10000H" }
reading a = { at = 1, span = [100, -100] }
reading a = { at = 1, offset = inf }
setting a = { at = 1, number_format = "I8" }
setting a = { at = 1, part = "0-3" }
setting a = { at = 1, harmless = [65536] }
setting a = { at = "10001" }
setting a = { at = 1, table = "input" }
setting a = { at = 1, ram_address = 40002 }
text a = { at = "10001", length = 2 }
option a = { span = [5, 1], meaning = "m" }
"""
BAD_FACTS = """\
addresses = [200, 20]
gaps = { holding = [100, 10] }
profile = "delta"
extends = "yd1000"
"""
ROLES = """\
reference = { at = 2, unit = "rpm" }
reference = { at = 2, unit = "Hz", step = "unknown" }
reference = { at = 2, unit = "Hz", span = [-50, 50] }
reference = { at = 2, unit = "Hz", harmless = [0] }
status = { at = 1 }
stop_word = { at = 2 }
sleeve = { at = 2, harmless = [0] }
"""


def bad_families() -> list[str]:
    """Return family files with one mistake each, of the kinds that the loader's tests do not have."""
    head, reading = FAMILIES.HEAD, "[reading]\nz = { at = 1 }\n"
    texts = []
    for line in BAD_REGISTERS.splitlines():
        section, _, entry = line.partition(" ")
        texts.append(f"{head}[{section}]\n{entry}\n{reading if section != 'reading' else ''}")
    texts += [f'{head}{fact}\n[setting]\na = {{ at = "1000H" }}\n' for fact in BAD_FACTS.splitlines()]
    texts += [f'{head}profile = "yaskawa"\n[setting]\n{role}\n' for role in ROLES.splitlines()]
    texts.append(f"{head}[default]\ntable = 'input'\n[setting]\na = {{ at = 1 }}\n")
    uncounted = head.replace("counts_from = 0\n", "")
    texts += [f"{uncounted}{reading}", f"{uncounted}counts_from = 1\n[reading]\na = {{ at = 0 }}\n"]
    return texts


def valid_families() -> list[str]:
    shipped = sorted((ROOT / "src/multidrop/families/shipped").glob("*.toml"))
    return [*(path.read_text("utf-8") for path in shipped), *documented("[family]"), FAMILIES.METER]


@pytest.mark.long
def test_the_schema_accepts_the_valid_family_files() -> None:
    valid = valid_families()
    assert len(valid) > 20
    assert [text for text in valid if not accepts("family", text)] == []


def test_the_family_loader_refuses_every_broken_family_file() -> None:
    assert [text for text in bad_families() if not mistakes("family", text)] == []


def test_the_schema_refuses_the_invalid_family_files() -> None:
    check_refusals("family", invalid_families())


def test_the_schema_refuses_two_value_names_for_one_number() -> None:
    def register(names: str) -> str:
        return f"{FAMILIES.HEAD}[reading]\na = {{ at = 1, {names} }}\n"

    equal = (
        "off = 0, on = 0",
        "ready = 3, run = 3",
        "jog_forward = 9, jog_reverse = 9",
        "in_1 = 1, in_2 = 1",
    )
    for key, names in product(("values", "bits"), equal):
        assert not accepts("family", register(f"{key} = {{ {names}, fault = 5 }}")), names
    for names in (
        "off = 0, on = 1",
        "a = 1",
        "jog_forward = 9, jog_reverse = 10",
        "off = 0, on = 5, trip = 9",
    ):
        assert accepts("family", register(f"values = {{ {names} }}")), names


@table(
    ("referring", "is_accepted"),
    [
        ("[reading]\nb = { at = 2, scale_register = 'power_of_ten' }", True),
        ("[reading]\nb = { at = 2, scale_register = 'power_of_tens' }", False),  # another length
        # accepted: the length, the first and the last letters are right
        ("[reading]\nb = { at = 2, scale_register = 'powwr_of_ten' }", True),
        ("[setting]\nb = { at = 2, at_least = 'lowest' }", True),
        ("[setting]\nb = { at = 2, at_least = 'lowezt', at_most = 'highest' }", False),
        ("[setting]\nb = { at = 2, at_most = 'hihgest' }", True),
        ("[setting]\nb = { at = 2, at_most = 'ihghest' }", False),
        ("[parameters]\ngroups = [{ code = 'P', at = 0, count = 2 }]\nfirmware = 'device'", True),
        ("[parameters]\ngroups = [{ code = 'P', at = 0, count = 2 }]\nfirmware = 'deviec'", False),
        ("[identify]\nregister = 'device'\nis = [1]", True),
        ("[identify]\nregister = 'dwvice'\nis = [1]", False),
        ("[[identify]]\nregister = 'device'\nis = [1]\n[[identify]]\nregister = 'dveice'\nis = [1]", False),
    ],
)
def test_the_schema_detects_most_misspelt_register_names(referring: str, is_accepted: bool) -> None:
    names = "[reading]\ndevice = { at = 1 }\nlowest = { at = 2 }\npower_of_ten = { at = 3 }\n"
    option = '[option]\nhighest = { span = [0, 50], meaning = "m" }\n'
    text = f"{FAMILIES.HEAD}{option}{names}{referring.removeprefix(FIRST_SECTION)}\n"
    assert accepts("family", text) is is_accepted
    csv = text.replace("\n[option]", "\nregisters = ['more.csv']\n[option]")
    assert accepts("family", csv)  # accepted, because the CSV file may declare the missing registers


FIRST_SECTION = "[reading]\n"  # the header that starts the text in `names`; it must not occur twice


def test_a_schema_for_given_csv_files_refuses_other_csv_files(tmp_path: Path) -> None:
    def accepted(made: Any, name: str) -> bool:
        text = f'{FAMILIES.HEAD}registers = ["{name}"]\n'
        return bool(jsonschema.Draft7Validator(made).is_valid(tomllib.loads(text)))

    (tmp_path / "meter.csv").touch()
    given = schema_of("family", ["meter.csv"], tmp_path)
    assert [accepted(given, name) for name in ("meter.csv", "metre.csv")] == [True, False]
    assert [accepted(schema_of("family"), name) for name in ("meter.csv", "../meter.csv")] == [True, False]
    with pytest.raises(ValueError, match=r"^metre\.csv: there is no such file$"):
        schema_of("family", ["metre.csv"], tmp_path)
    with pytest.raises(ValueError, match="not a CSV file"):
        schema_of("family", ["meter.toml"], tmp_path)


@table(
    ("channel", "is_accepted"),
    [
        ('value = "output_power"', True),
        ('value = "output_current * 2"', False),
        # accepted: the schema does not check a name after a minus sign
        ('value = "2*-output_current"', True),
        ('value = "pump-2.output_current"', True),
        ("value = \"as(output_power, 'output_current')\"", True),
        ('value = "integral(output_power)"\nunit = "kWh"', True),
        ('value = "integral(output_power)"\nunit = "kW"', False),
        ('value = " integral( output_power ) "\nunit = "h"', False),
        ('value = "integral(output_power)"\nunit = "kW*h"', True),
    ],
)
def test_the_schema_checks_most_formulas_of_computed_channels(channel: str, is_accepted: bool) -> None:
    first = '[[line.drive.channel]]\nname = "energy"\nvalue = "integral(output_power)"\nunit = "kWh"\n'
    assert first in PLANTS.FILE
    text = PLANTS.FILE.replace(first, f'[[line.drive.channel]]\nname = "energy"\n{channel}\n')
    assert accepts("plant", text) is is_accepted
    own = text.replace("yaskawa-v1000", "own.toml").replace('"energy"', '"output_current"')
    # the schema knows neither the registers of a user's family file nor their units, so it checks neither
    assert accepts("plant", own)


# ---- taplo, the program with which editors check TOML files ----


@pytest.mark.long
@pytest.mark.parametrize(
    ("kind", "valid", "invalid"),
    [("plant", valid_plants, invalid_plants), ("family", valid_families, invalid_families)],
)
def test_the_toml_checker_taplo_refuses_the_same_files(
    tmp_path: Path, kind: str, valid: Callable[[], list[str]], invalid: Callable[[], list[str]]
) -> None:
    """Check files with taplo, as editors do; taplo supports fewer regular expressions than our checker."""
    taplo = require_program("taplo")
    (tmp_path / "family.py").write_text(PLANTS.FAMILY)
    words = [*MULTIDROP, "schema", kind, *(OWN if kind == "plant" else ())]
    schema = subprocess.run(words, capture_output=True, check=True, cwd=tmp_path).stdout
    (tmp_path / "schema.json").write_bytes(schema)

    def reported(texts: Iterable[str]) -> list[str]:
        """Return the files that taplo reports."""
        paths = {str(tmp_path / f"{number:03}.toml"): text for number, text in enumerate(texts)}
        for path, text in paths.items():
            Path(path).write_text(text, "utf-8")
        url = f"file://{tmp_path}/schema.json"
        words = [taplo, "lint", "--schema", url, *paths]
        told = subprocess.run(words, capture_output=True, text=True, check=False, cwd=tmp_path).stderr
        assert "invalid schema" not in told
        return [text for path, text in paths.items() if path in told]

    assert reported(valid()) == []
    wrong = invalid()
    assert len(reported(wrong)) >= LEAST * len(wrong)
