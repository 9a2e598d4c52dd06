"""Families of other packages, by entry points of the group `multidrop.families`."""

from __future__ import annotations

from importlib.metadata import EntryPoint, EntryPoints

import pytest

from multidrop.families import YD1000, registry
from multidrop.families.registry import GROUP, find_model


def installed(monkeypatch: pytest.MonkeyPatch, **values: str) -> None:
    """Have these entry points installed: by name, "module:attribute"; a name may end in "__" to be twice."""
    points = [EntryPoint(name.rstrip("_"), value, GROUP) for name, value in values.items()]
    monkeypatch.setattr(registry, "entry_points", lambda **wanted: EntryPoints(points).select(**wanted))


def test_a_family_of_a_package_is_found_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    installed(monkeypatch, acme="toy:Toy", broken="no_such_module:Drive")
    assert find_model("acme").__name__ == "Toy"


def test_a_built_in_family_goes_before_an_installed_one(monkeypatch: pytest.MonkeyPatch) -> None:
    installed(monkeypatch, yd1000="toy:Toy")
    assert find_model("yd1000") is YD1000


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
        ({"acmes": "toy:Toy"}, r"there is no model 'acme'; did you mean acmes"),
    ],
)
def test_a_package_that_cannot_be_used_is_one_sentence(
    monkeypatch: pytest.MonkeyPatch, values: dict[str, str], sentence: str
) -> None:
    installed(monkeypatch, **values)
    with pytest.raises(ValueError, match=sentence):
        find_model("acme")
