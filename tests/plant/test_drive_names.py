"""Names of drives: Unicode normal forms, which differ between keyboards; reserved names."""

from __future__ import annotations

import pytest

from multidrop.plant import RESERVED_NAMES, check_drive_name, drive_meant

# One letter and its two spellings each, by the code charts: U+00FC = U+0075 U+0308; U+0439 = U+0438 U+0306.
COMPOSED, APART = "L\u00fcfter", "Lu\u0308fter"
SHORT, LONG = "\u0439", "\u0438\u0306"


@pytest.mark.parametrize(
    ("given", "names", "meant"),
    [
        (APART, [COMPOSED, "pump"], COMPOSED),
        (COMPOSED, ["pump", APART], APART),
        (LONG, [SHORT], SHORT),
        (APART, [COMPOSED, APART], APART),  # an exact one goes first
        ("pump", ["pump", "pump-1"], "pump"),
        ("Pump", ["pump"], "Pump"),  # case is not spelling
        ("\u212b", ["A\u030a", "\u00c5"], "\u212b"),  # three angstroms: ambiguous between two drives
        ("Lufter", [COMPOSED], "Lufter"),
        ("\ufb01", ["fi"], "\ufb01"),  # a ligature is another text than its two letters
        ("\ud800", [COMPOSED], "\ud800"),
        ("", [], ""),
    ],
)
def test_a_name_is_found_by_its_normal_form(given: str, names: list[str], meant: str) -> None:
    assert drive_meant(given, names) == meant


@pytest.mark.parametrize("name", [*RESERVED_NAMES, "--all", "-"])
def test_a_name_that_is_ours_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match="give it another name"):
        check_drive_name(name)


@pytest.mark.parametrize("name", ["stop-1", "Stop", "gateways", "...", "a-", "__proto"])
def test_a_name_like_one_of_ours_is_taken(name: str) -> None:
    assert check_drive_name(name)
