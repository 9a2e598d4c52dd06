"""`multidrop schema plant`: it accepts the plant files of the documentation, and refuses invalid ones."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from multidrop.plant.loader import plant_schema

jsonschema = pytest.importorskip("jsonschema")
ROOT = Path(__file__).parents[2]
LINE = '[[line]]\nname = "L"\nport = "/dev/a"\n'
DRIVE = '[[line.drive]]\nname = "D"\nmodel = "innovert-ibd"\naddress = 1\n'
INVALID = (
    "",
    "line = [3]",
    LINE,
    LINE + 'silence = "0 us"\n' + DRIVE,
    LINE + "silence = 0.0005\n" + DRIVE,
    LINE + 'echo = "loud"\n' + DRIVE,
    LINE + "baudrate = 7\n" + DRIVE,
    LINE + 'format = "8X1"\n' + DRIVE,
    LINE + 'prot = "x"\n' + DRIVE,
    LINE + DRIVE.replace("= 1", "= true"),
    LINE + DRIVE.replace("= 1", "= 300"),
    LINE + DRIVE.replace('"D"', '"stop"'),
    LINE + DRIVE.replace("ibd", "ibt"),
    LINE + DRIVE + "poll = []",
    LINE + DRIVE + 'poll = ["output_curent"]',
    LINE + DRIVE + 'poll = [{ register = "output_current", evry = "1 s" }]',
    LINE + DRIVE + 'every = "50"',
    LINE + DRIVE + "stop_time = 3",
)


def test_schema_accepts_valid_plant_files_and_refuses_invalid_ones() -> None:
    schema = jsonschema.Draft7Validator(plant_schema())
    pages = "\n".join(page.read_text("utf-8") for page in (ROOT / "docs").rglob("*.md"))
    valid = [text for text in re.findall(r"```toml\n(.*?)```", pages, re.DOTALL) if "[[line]]" in text]
    assert len(valid) > 15
    assert [text for text in valid if not schema.is_valid(tomllib.loads(text))] == []
    assert schema.is_valid(tomllib.loads(LINE + DRIVE))
    assert [text for text in INVALID if schema.is_valid(tomllib.loads(text))] == []
