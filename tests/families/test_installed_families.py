"""Families of other packages, by entry points of the group `multidrop.families`."""

from __future__ import annotations

import importlib.metadata
from importlib.metadata import EntryPoint, EntryPoints

import pytest

from multidrop.cli import main
from multidrop.families import YD1000
from multidrop.families.registry import GROUP, find_model


def installed(monkeypatch: pytest.MonkeyPatch, **values: str) -> None:
    """Pretend that these entry points are installed, as name="module:attribute"; "name__" repeats a name."""
    points = [EntryPoint(name.rstrip("_"), value, GROUP) for name, value in values.items()]
    monkeypatch.setattr(
        importlib.metadata, "entry_points", lambda **wanted: EntryPoints(points).select(**wanted)
    )


def test_a_family_of_a_package_is_found_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    installed(monkeypatch, toy="toy:Toy", broken="no_such_module:Drive")
    assert find_model("toy").__name__ == "Toy"


def test_a_built_in_family_goes_before_an_installed_one(monkeypatch: pytest.MonkeyPatch) -> None:
    installed(monkeypatch, yd1000="toy:Toy")
    assert find_model("yd1000") is YD1000


def test_models_lists_installed_families_and_warns_of_broken_ones(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    installed(monkeypatch, toy="toy:Toy", broken="no_such_module:Drive", yd1000="toy:Toy")
    assert main(["models"]) == 0
    out, err = capsys.readouterr()
    assert [line.partition(" ")[0] for line in out.splitlines()].count("toy") == 1
    assert err.count("\n") == 1
    assert "model 'broken' of package" in err


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        (
            {"acme": "toy:Toy", "acme__": "toy:Quick"},
            r"model 'acme' is in several packages, toy:Toy and toy:Quick: uninstall all but one",
        ),
        (
            {"acme": "no_such_module:Drive"},
            r"model 'acme' of package .* cannot be loaded: ModuleNotFoundError: No module named",
        ),
        ({"acme": "toy:missing"}, r"model 'acme' of package .* cannot be loaded: AttributeError"),
        ({"acme": "toy:__doc__"}, r"model 'acme' of package .* is not a subclass of multidrop.Drive"),
        (
            {"acme": "toy:Toy"},
            r"model 'acme' of package .* has model = 'toy': name its entry point so",
        ),
        ({"acmes": "toy:Toy"}, r"there is no model 'acme'; did you mean acmes"),
    ],
)
def test_a_package_that_cannot_be_used_is_one_sentence(
    monkeypatch: pytest.MonkeyPatch, values: dict[str, str], sentence: str
) -> None:
    installed(monkeypatch, **values)
    with pytest.raises(ValueError, match=sentence):
        find_model("acme")
