"""Names of drives: Unicode normal forms, which differ between keyboards; reserved names."""

from __future__ import annotations

import pytest
from tables import table

from multidrop.plant import RESERVED_NAMES, check_drive_name, drive_meant

# Letters with two encodings, from the code charts: U+00FC = U+0075 U+0308; U+0439 = U+0438 U+0306.
COMPOSED, APART = "L\u00fcfter", "Lu\u0308fter"
SHORT, LONG = "\u0439", "\u0438\u0306"


@table(
    ("given", "names", "meant"),
    [
        (APART, [COMPOSED, "pump"], COMPOSED),
        (COMPOSED, ["pump", APART], APART),
        (LONG, [SHORT], SHORT),
        (APART, [COMPOSED, APART], APART),  # an exact match takes precedence
        ("pump", ["pump", "pump-1"], "pump"),
        ("Pump", ["pump"], "Pump"),  # case is significant
        ("\u212b", ["A\u030a", "\u00c5"], "\u212b"),  # ambiguous: both names have this normal form
        ("Lufter", [COMPOSED], "Lufter"),
        ("\ufb01", ["fi"], "\ufb01"),  # a ligature is not its two letters
        ("\ud800", [COMPOSED], "\ud800"),
        ("", [], ""),
    ],
)
def test_a_name_is_found_by_its_unicode_normal_form(given: str, names: list[str], meant: str) -> None:
    assert drive_meant(given, names) == meant


@table("name", [*RESERVED_NAMES, "--all", "-"])
def test_reserved_names_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match="give it another name"):
        check_drive_name(name)


@table("name", ["stop-1", "Stop", "gateways", "...", "a-", "__proto"])
def test_names_similar_to_reserved_ones_are_allowed(name: str) -> None:
    assert check_drive_name(name)
