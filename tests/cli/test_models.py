"""Families by name or from the user's files, and their sheets, which `multidrop models` prints."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from commands import TOY, Run
from tables import table

from multidrop.drive import Drive
from multidrop.families import MODELS
from multidrop.families.registry import SHIPPED, find_model

FAN = """\
from multidrop.drive.family import Drive
from multidrop.drive.register import reading

class Fan(Drive):
    model = "fan"
    speed = reading(1, "rpm")

class Empty(Drive):
    pass

LIMIT = 5
"""


@pytest.fixture
def fan(tmp_path: Path) -> Path:
    path = tmp_path / "fan.py"
    path.write_text(FAN)
    return path


def refused(text: str, relative_to: Path | None = None) -> str:
    """Return the sentence of the error that this model raises."""
    try:
        find_model(text, relative_to)
    except ValueError as refusal:
        return str(refusal)
    return pytest.fail(f"{text} is taken for a model")


def test_a_built_in_family_is_found_by_its_name() -> None:
    for name, model in MODELS.items():
        assert find_model(name) is model
        assert model.model == name


def test_a_misspelt_model_is_refused_with_the_nearest_names() -> None:
    assert "there is no model 'Inovert-IBD'; did you mean innovert-ibd or " in refused("Inovert-IBD")


def test_an_unknown_model_is_refused_with_all_names() -> None:
    sentence = refused("zzz")
    assert all(name in sentence for name in MODELS)


def test_a_class_is_loaded_from_a_file_beside_the_plant_file(fan: Path) -> None:
    model = find_model("fan.py:Fan", fan.parent)
    assert issubclass(model, Drive)
    assert list(model.registers) == ["speed"]
    assert model(7).name == "fan@7"


def test_two_paths_of_one_model_file_load_the_same_class(fan: Path) -> None:
    assert find_model("fan.py:Fan", fan.parent) is find_model(f"{fan}:Fan")


def test_a_class_missing_in_a_model_file_is_reported(fan: Path) -> None:
    here = fan.parent
    assert refused("fun.py:Fan", here) == f"the model file {here}/fun.py does not exist"
    assert refused("fan.py", here) == "fan.py needs the name of a class after a colon; write fan.py:Fan"
    assert refused("fan.py:Pan", here) == "fan.py has no class 'Pan'; write fan.py:Fan"
    for name in ("Empty", "LIMIT", "Drive"):
        expected = f"fan.py:{name} is not a subclass of multidrop.Drive with registers; write fan.py:Fan"
        assert refused(f"fan.py:{name}", here) == expected


def test_a_model_file_linked_to_a_txt_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "fan.txt").write_text(FAN)
    (tmp_path / "fan.py").symlink_to("fan.txt")
    assert (
        refused("fan.py:Fan", tmp_path)
        == f"{tmp_path}/fan.txt cannot be loaded as Python: its name must end in .py"
    )


@table(
    ("source", "ending"),
    [
        ("class Fan(:\n", "SyntaxError: invalid syntax (broken.py, line 1)"),
        ("\n1 / 0\n", "broken.py, line 2: ZeroDivisionError: division by zero"),
        ("import nowhere_at_all\n", "line 1: ModuleNotFoundError: No module named 'nowhere_at_all'"),
        ("raise SystemExit(3)\n", "line 1: SystemExit: 3"),
        (
            FAN.replace("reading(1", "reading(70000"),
            "line 4: DeclarationError: Fan.speed: address = 70000 is not an address from 0 to FFFFH",
        ),
    ],
)
def test_a_model_file_error_is_one_sentence_with_the_line_number(
    tmp_path: Path, source: str, ending: str
) -> None:
    (tmp_path / "broken.py").write_text(source)
    sentence = refused("broken.py:Fan", tmp_path)
    assert sentence.startswith(str(tmp_path / "broken.py"))
    assert sentence.endswith(ending)


def test_a_model_file_is_loaded_again_after_an_error(tmp_path: Path) -> None:
    path = tmp_path / "later.py"
    path.write_text("1 / 0\n")
    assert "ZeroDivisionError" in refused("later.py:Fan", tmp_path)
    path.write_text(FAN + "# now without the mistake\n")
    assert find_model("later.py:Fan", tmp_path).model == "fan"


USES_SCALES = """\
from multidrop import Drive, reading
from scales import STEP
import scales as table

class Fan(Drive):
    speed = reading(1, "rpm", step=STEP)

    def step_later(self):
        import scales
        return scales
"""


def with_scales(directory: Path, step: float, source: str = USES_SCALES) -> Path:
    directory.mkdir()
    (directory / "fan.py").write_text(source)
    (directory / "scales.py").write_text(f"STEP = {step}\n")
    return directory


def test_a_model_file_imports_only_modules_in_its_own_directory(tmp_path: Path) -> None:
    before, names = list(sys.path), {*sys.modules}
    one, two = (
        find_model("fan.py:Fan", with_scales(tmp_path / f"plant-{step}", step)) for step in (0.1, 0.5)
    )
    assert (one.registers["speed"].step, two.registers["speed"].step) == (0.1, 0.5)
    later = [family.step_later(None) for family in (one, two)]  # type: ignore[attr-defined]
    assert [module.STEP for module in later] == [0.1, 0.5]
    assert sys.path == before
    assert {name for name in {*sys.modules} - names if not name.startswith("multidrop")} == set()


def test_a_module_shared_by_two_model_files_is_run_once(tmp_path: Path) -> None:
    directory = with_scales(tmp_path / "plant", 0.1)
    (directory / "other.py").write_text(USES_SCALES)
    families = [find_model(f"{name}.py:Fan", directory) for name in ("fan", "other")]
    assert len({id(family.step_later(None)) for family in families}) == 1  # type: ignore[attr-defined]


def test_modules_beside_a_model_file_may_import_each_other(tmp_path: Path) -> None:
    directory = with_scales(tmp_path / "plant", 0.1)
    (directory / "scales.py").write_text("import units\nSTEP = units.STEP\n")
    (directory / "units.py").write_text("import scales\nSTEP = 0.25\n")
    assert find_model("fan.py:Fan", directory).registers["speed"].step == 0.25


@pytest.mark.parametrize("name", ["json", "multidrop"])
def test_a_user_file_never_replaces_a_module_of_python_or_multidrop(tmp_path: Path, name: str) -> None:
    source = f"import {name}\nOURS = {name}\n{FAN}"
    (tmp_path / "fan.py").write_text(source)
    (tmp_path / f"{name}.py").write_text("1 / 0\n")
    find_model("fan.py:Fan", tmp_path)
    loaded = [module for module in sys.modules.values() if hasattr(module, "OURS")]
    assert sys.modules[name] in [module.OURS for module in loaded]


def test_already_imported_modules_are_reused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    directory = with_scales(tmp_path / "plant", 0.1)
    monkeypatch.syspath_prepend(str(directory))
    import scales  # type: ignore[import-not-found]

    try:
        family = find_model("fan.py:Fan", directory)
    finally:
        del sys.modules["scales"]
    assert family.registers["speed"].step == 0.1
    assert {id(vars(module)["table"]) for module in sys.modules.values() if "table" in vars(module)} >= {
        id(scales)
    }


def test_an_error_in_a_module_beside_a_model_file_is_reported_with_its_line(tmp_path: Path) -> None:
    directory = with_scales(tmp_path / "plant", 0.1)
    (directory / "scales.py").write_text("\n1 / 0\n")
    sentence = f"{directory}/scales.py, line 2: ZeroDivisionError: division by zero"
    assert refused("fan.py:Fan", directory) == sentence
    (directory / "scales.py").write_text("STEP = 2.0  # now without the mistake\n")
    assert find_model("fan.py:Fan", directory).registers["speed"].step == 2.0


def test_a_module_missing_beside_a_model_file_is_reported(tmp_path: Path) -> None:
    directory = with_scales(tmp_path / "plant", 0.1)
    (directory / "scales.py").unlink()
    ending = "fan.py, line 2: ModuleNotFoundError: No module named 'scales'"
    assert refused("fan.py:Fan", directory).endswith(ending)


TYPED = {
    "multidrop po": {"ports", "poll"},
    "multidrop fleet wa": {"watch"},
    "multidrop params di": {"diff"},
    "multidrop poll --capt": {"--capture"},
    "multidrop poll pla": {"plant.toml"},
}
COMPLETE = """COMP_WORDS=({}); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1)); COMPREPLY=(); _shtab_multidrop
echo "${{COMPREPLY[@]}}"
"""


@pytest.mark.slow
def test_bash_completes_words_with_the_generated_script(run: Run, tmp_path: Path) -> None:
    pytest.importorskip("shtab")
    status, script, _ = run("completion", "bash")
    assert status == 0
    (tmp_path / "plant.toml").touch()
    script += "".join(COMPLETE.format(words) for words in TYPED)
    done = subprocess.run(["bash"], input=script, cwd=tmp_path, capture_output=True, text=True, timeout=60)
    found = [set(line.split()) for line in done.stdout.splitlines()]
    assert dict(zip(TYPED, found, strict=True)) == TYPED


def test_the_models_command_lists_the_families(run: Run) -> None:
    status, out, _ = run("models")
    assert status == 0
    # leave out indented lines, which continue the title above them
    lines = [line for line in out.splitlines()[1:-2] if line[0] != " "]
    assert [line.split()[0] for line in lines] == [*MODELS, *SHIPPED]
    assert max(map(len, out.splitlines())) <= 80
    titles = " ".join(out.split())
    assert [family.title for family in MODELS.values() if family.title not in titles] == []
    _, out, _ = run("models", "--json")
    assert [family["model"] for family in json.loads(out)] == [*MODELS, *SHIPPED]


def test_the_models_command_prints_every_fact_of_a_family(run: Run) -> None:
    _, out, _ = run("models", TOY)
    for line in (
        "addresses       1-31",
        "baud rates      9600, 19200 (the first is the default)",
        "rtu formats     8N1, 8E1, 8O1, 8N2",
        "rtu silence     3.5 characters, above 19200 bit/s 1.75 ms, before and after a",
        "ascii silence   none",
        "verbs           start, stop, set-frequency, state",
        "  02H  illegal address",
        "  rated_frequency  rated frequency of the motor (10 to 400 Hz)",
        "holding registers (read 03H, at most 10; write 06H)",
        "  0003H  mystery            reading  scale not stated",
        "        the manual gives no scale",
        "  000AH  acceleration_time  setting  0.1 s             0.1 to 600",
        "        kept: EEPROM; only while stopped",
        "        kept: not stated; never written: it is the maker's",
        "        0 NONE, 1 OVERCURRENT",
        "- the scale of `mystery`.",
    ):
        assert any(shown.startswith(line) for shown in out.splitlines()), f"{line!r} is not in\n{out}"


def test_the_models_command_prints_every_register_of_a_family_as_json(run: Run) -> None:
    _, out, _ = run("models", TOY, "--json")
    sheet = json.loads(out)
    by_name = {register["name"]: register for register in sheet["registers"]}
    assert len(by_name) == sheet["register_count"] == 9
    assert by_name["acceleration_time"]["span"] == [0.1, 600]
    assert by_name["fault"]["values"] == {"NONE": 0, "OVERCURRENT": 1}
    assert by_name["mystery"]["step"] is None


@table(
    ("name", "facts"),
    [
        (
            "erman-er-g-220",
            [
                "b.010 address (1 from the factory), set while the motor stands",
                "remote b.001 must be 2 and b.002 must be 5 (RS-485)",
                "broadcast the manual does not say whether drives reply to address 0, so none is sent",
                "coils (read 01H, at most 12; write 05H)",
                "only verbs write it, except ON",
                "(0 to 4294967295)",
            ],
        ),
        (
            "invt-che",
            [
                "PC.00 address (1 from the factory), PC.01 baud rate",
                "PC.02 format (0 to 5: 8N1, 8E1, 8O1, 8N2, 8E2, 8O2",
                "remote P0.01 must be 2",
                "only verbs write it, except STOP, COAST, STOP_JOG",
            ],
        ),
        (
            "innovert-ibd",
            [
                "rtu silence 10 ms before and after",
                "ascii silence none",
                "PrH.02 address",
                "remote set Prb.01",
            ],
        ),
        (
            "delixi-modbus",
            ["P04.30 address", "(RS-485), and P00.01 must be 1", "0 ASCII_7N2"],
        ),
        (
            "delixi-native",
            [
                "delixi formats 8N1",
                "delixi silence none",
                "until measured, less than 80 ms by its manual; timeout 150 ms",
                "P00.00 must be 2",
                "0 N81, 1 E81",
            ],
        ),
        (
            "yd1000",
            [
                "24 characters (27.5 ms at 9600 bit/s) until measured; timeout 500 ms",
                "F802 address",
                "at least minimum_frequency; at most maximum_frequency",
                "except COMMAND_VALID|FREQUENCY_VALID, COMMAND_VALID,",
                "never together: RESET and RUN, RESET and JOG",
                "the factory value is not stated",
            ],
        ),
    ],
)
def test_the_models_command_prints_line_settings_and_value_limits(
    run: Run, name: str, facts: list[str]
) -> None:
    """Settings and limits are printed in the words of the manual (ERMAN, section 3; YD1000, 4.3 and 6.1)."""
    _, out, _ = run("models", name)
    shown = " ".join(out.split())
    assert [fact for fact in facts if fact not in shown] == []
    assert "3.5 characters" not in shown or name in ("erman-er-g-220", "invt-che", "delixi-modbus")


def test_the_models_command_prints_value_limits_as_json(run: Run) -> None:
    _, out, _ = run("models", "yd1000", "--json")
    sheet = json.loads(out)
    by_name = {register["name"]: register for register in sheet["registers"]}
    upper = by_name["upper_limit_frequency"]  # values from 0.5 Hz to the highest frequency FH
    assert (upper["span"][0], upper["at_most"]) == (0.5, "maximum_frequency")
    # values from the lower to the upper limit frequency
    speeds = [by_name[f"preset_speed_{number}"] for number in range(1, 8)]
    limits = {("minimum_frequency", "upper_limit_frequency")}
    assert {(speed["at_least"], speed["at_most"]) for speed in speeds} == limits
    assert by_name["control"]["harmless"] == [0xC000, 0x8000, 0xC800]
    assert by_name["control"]["never_together"] == [0x2400, 0x2100]
    assert by_name["acceleration_time"]["harmless"] is None
    assert sheet["response_delay_s"] == pytest.approx(24 * 11 / 9600)
    assert sheet["needed_silence_s"]["rtu"] == pytest.approx(24 * 11 / 9600)
    assert "F802" in sheet["line_parameters"]
    assert "reset_fault" in sheet["remote"]
    _, out, _ = run("models", "delixi-native", "--json")
    sheet = json.loads(out)
    assert (sheet["needed_silence_s"], sheet["answering_time_s"]) == ({"delixi": 0}, 0.08)
    _, out, _ = run("models", "erman-er-g-220", "--json")
    assert "address 0" in json.loads(out)["no_broadcasts"]


@table("name", [*MODELS, *SHIPPED])
def test_the_models_command_prints_each_family_within_80_columns(run: Run, name: str) -> None:
    _, out, _ = run("models", name)
    too_wide = [line for line in out.splitlines() if len(line) > 80]
    assert not too_wide
    assert all(register in out for register in find_model(name).registers)


NOTES = """
Where the document errs or is silent, the safest interpretation applies:

- The example of function 04 has the checksum of function 03's example. Its
  reply has a byte count of 10H for 5 registers: the library requires the byte
  count that fits the request.
- The example of function 06"""


def test_the_models_command_keeps_indented_lines_of_notes(run: Run, tmp_path: Path) -> None:
    notes = "Two words:\n    0 off\n    1 on\n* one\n* two"
    docstring = f'"""Mine.\n\n{notes}"""'.replace("\n", "\n    ")
    (tmp_path / "mine.py").write_text(
        "from multidrop import Drive, reading\n\n\n"
        f"class Mine(Drive):\n    {docstring}\n\n    speed = reading(1)\n"
    )
    assert run("models", f"{tmp_path / 'mine.py'}:Mine")[1].endswith(f"Mine.\n\n{notes}\n")


def test_the_models_command_wraps_notes_as_paragraphs(run: Run) -> None:
    _, out, _ = run("models", "erman-er-g-220")
    assert NOTES in out
    assert "refuse others.\n\nNo ranges, defaults" in out


def test_the_models_command_shows_addresses_that_do_not_wear_eeprom(run: Run, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(
        "from multidrop.families.invt_che import InvtCHE, parameter\n\n\n"
        'class Mine(InvtCHE):\n    """With a parameter."""\n\n'
        '    ramp = parameter(11, "s", step=0.1, span=(0, 3600))\n'
    )
    status, out, _ = run("models", f"{tmp_path / 'mine.py'}:Mine")
    assert status == 0
    assert "        kept: EEPROM; written at 800BH, in RAM" in out


def test_the_models_command_shows_which_writes_may_move_the_motor(run: Run, tmp_path: Path) -> None:
    (tmp_path / "moved.py").write_text(
        "from multidrop import Drive, command, setting\n\n\n"
        'class Moved(Drive):\n    """Moved."""\n\n'
        "    speed = command(1, moves=False)\n    jog_bit = setting(2, moves=True)\n    unsaid = command(3)\n"
    )
    family = f"{tmp_path / 'moved.py'}:Moved"
    _, out, _ = run("models", family)
    _, _, registers = out.partition("holding registers")
    remarks = [line.strip() for line in registers.splitlines() if line.startswith(" " * 8)]
    assert remarks == [
        "a write never starts, stops or resets",
        "kept: not stated; a write may move the motor",
    ]
    _, out, _ = run("models", family, "--json")
    told = {register["name"]: register["moves"] for register in json.loads(out)["registers"]}
    assert told == {"speed": False, "jog_bit": True, "unsaid": None}
