"""Families by name and from files of the user's own; every failure is one ValueError sentence."""

from __future__ import annotations

from pathlib import Path

import pytest

from multidrop.drive import Drive
from multidrop.drives import MODELS
from multidrop.drives.registry import find_model

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
    """The sentence with which it is refused."""
    try:
        find_model(text, relative_to)
    except ValueError as refusal:
        return str(refusal)
    return pytest.fail(f"{text} is taken for a model")


def test_a_built_in_model_is_found_by_its_name() -> None:
    for name, model in MODELS.items():
        assert find_model(name) is model
        assert model.model == name


def test_a_misspelt_model_gets_the_nearest_names() -> None:
    assert "there is no model 'Inovert-IBD'; did you mean innovert-ibd?" in refused("Inovert-IBD")


def test_an_unknown_model_gets_all_names() -> None:
    sentence = refused("zzz")
    assert all(name in sentence for name in MODELS)


def test_a_class_is_loaded_from_a_file_beside_the_plant_file(fan: Path) -> None:
    model = find_model("fan.py:Fan", fan.parent)
    assert issubclass(model, Drive)
    assert list(model.registers) == ["speed"]
    assert model(7).name == "fan@7"


def test_a_file_is_loaded_once_so_that_its_drives_share_a_class(fan: Path) -> None:
    assert find_model("fan.py:Fan", fan.parent) is find_model(f"{fan}:Fan")


def test_what_a_file_lacks_is_said(fan: Path) -> None:
    here = fan.parent
    assert refused("fun.py:Fan", here) == f"there is no file {here}/fun.py to take a model from"
    assert refused("fan.py", here) == "fan.py names no class; write fan.py:Fan"
    assert refused("fan.py:Pan", here) == "fan.py has no class 'Pan'; write fan.py:Fan"
    for name in ("Empty", "LIMIT", "Drive"):
        expected = f"fan.py:{name} is not a subclass of multidrop.Drive with registers; write fan.py:Fan"
        assert refused(f"fan.py:{name}", here) == expected


def test_a_link_to_what_is_no_python_file_is_said(tmp_path: Path) -> None:
    (tmp_path / "fan.txt").write_text(FAN)
    (tmp_path / "fan.py").symlink_to("fan.txt")
    assert refused("fan.py:Fan", tmp_path) == f"{tmp_path}/fan.txt cannot be loaded as Python"


@pytest.mark.parametrize(
    ("source", "ending"),
    [
        ("class Fan(:\n", "SyntaxError: invalid syntax (broken.py, line 1)"),
        ("\n1 / 0\n", "broken.py, line 2: ZeroDivisionError: division by zero"),
        ("import nowhere_at_all\n", "line 1: ModuleNotFoundError: No module named 'nowhere_at_all'"),
        ("raise SystemExit(3)\n", "line 1: SystemExit: 3"),
        (
            FAN.replace("reading(1", "reading(70000"),
            "line 4: DeclarationError: Fan.speed: address 11170H is outside 0 to FFFFH",
        ),
    ],
)
def test_a_file_that_fails_is_a_sentence_with_its_line(tmp_path: Path, source: str, ending: str) -> None:
    (tmp_path / "broken.py").write_text(source)
    sentence = refused("broken.py:Fan", tmp_path)
    assert sentence.startswith(str(tmp_path / "broken.py"))
    assert sentence.endswith(ending)


def test_a_file_that_failed_is_read_anew(tmp_path: Path) -> None:
    path = tmp_path / "later.py"
    path.write_text("1 / 0\n")
    assert "ZeroDivisionError" in refused("later.py:Fan", tmp_path)
    path.write_text(FAN + "# now without the mistake\n")
    assert find_model("later.py:Fan", tmp_path).model == "fan"
