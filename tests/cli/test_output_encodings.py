"""Output in an encoding that lacks some letters, such as that of a pipe on Windows."""

from __future__ import annotations

import sys
from io import BytesIO, TextIOWrapper
from pathlib import Path

import pytest

from multidrop.cli import main

PLANT = """
[[line]]
name = "зал"
port = "/dev/ttyUSB0"
[[line.drive]]
name = "насос"
model = "innovert-ibd"
address = 1
"""


@pytest.mark.parametrize("words", [["plan"], ["plan", "--json"]])
def test_letters_that_the_encoding_lacks_are_printed_as_escapes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str]
) -> None:
    plant, out = tmp_path / "plant.toml", BytesIO()
    plant.write_text(PLANT, "utf-8")
    monkeypatch.setattr(sys, "stdout", TextIOWrapper(out, "cp1252"))
    assert main([*words, str(plant)]) == 0
    said = out.getvalue().decode("cp1252")
    assert r"\u0437\u0430\u043b" in said
    assert "зал" not in said
