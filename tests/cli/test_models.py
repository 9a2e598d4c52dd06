"""Families by name, or from the user's files. Every failure is a ValueError with one sentence."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from commands import Run
from tables import table

from multidrop.drive import Drive
from multidrop.families import MODELS
from multidrop.families.registry import find_model

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


def test_a_model_file_is_loaded_once_so_its_drives_share_a_class(fan: Path) -> None:
    assert find_model("fan.py:Fan", fan.parent) is find_model(f"{fan}:Fan")


def test_a_class_missing_in_a_model_file_is_reported(fan: Path) -> None:
    here = fan.parent
    assert refused("fun.py:Fan", here) == f"there is no file {here}/fun.py to take a model from"
    assert refused("fan.py", here) == "fan.py names no class; write fan.py:Fan"
    assert refused("fan.py:Pan", here) == "fan.py has no class 'Pan'; write fan.py:Fan"
    for name in ("Empty", "LIMIT", "Drive"):
        expected = f"fan.py:{name} is not a subclass of multidrop.Drive with registers; write fan.py:Fan"
        assert refused(f"fan.py:{name}", here) == expected


def test_a_model_file_that_is_a_link_to_another_type_is_reported(tmp_path: Path) -> None:
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
def test_error_in_a_model_file_is_one_sentence_that_names_the_line(
    tmp_path: Path, source: str, ending: str
) -> None:
    (tmp_path / "broken.py").write_text(source)
    sentence = refused("broken.py:Fan", tmp_path)
    assert sentence.startswith(str(tmp_path / "broken.py"))
    assert sentence.endswith(ending)


def test_a_model_file_that_failed_is_read_again(tmp_path: Path) -> None:
    path = tmp_path / "later.py"
    path.write_text("1 / 0\n")
    assert "ZeroDivisionError" in refused("later.py:Fan", tmp_path)
    path.write_text(FAN + "# now without the mistake\n")
    assert find_model("later.py:Fan", tmp_path).model == "fan"


# ---- modules beside a model file ----

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


def test_a_module_beside_a_model_file_is_run_once(tmp_path: Path) -> None:
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


def test_modules_that_the_program_imported_are_reused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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


# ---- multidrop completion ----


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
