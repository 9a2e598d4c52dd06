"""Check that the architecture page lists every file, and that its two walkthroughs name existing code."""

from __future__ import annotations

import ast
import re
from fnmatch import fnmatch
from pathlib import Path

import pytest
from sources import PACKAGE, ROOT, parsed

ARCHITECTURE = ROOT / "docs" / "reference" / "architecture.md"
WALKS = sorted((ROOT / "docs" / "reference").glob("walk-*.md"))
STEP = re.compile(r"`(?:(?:src/multidrop/)?([\w/]+\.py):([\w.]+)|(?:csrc/)?(\w+\.c))`")


def steps(walk: Path) -> list[tuple[str, str]]:
    """Return the steps of a walkthrough: each file with its function or class ("" for a C file)."""
    return [(file or c_file, name) for file, name, c_file in STEP.findall(walk.read_text("utf-8"))]


def defined(path: Path) -> set[str]:
    """Return the functions and classes of a module, and the methods of its classes as `Class.method`."""
    names = set()
    for node in parsed(path).body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            names.add(node.name)
        if isinstance(node, ast.ClassDef):
            methods = [each for each in node.body if isinstance(each, ast.FunctionDef | ast.AsyncFunctionDef)]
            names |= {f"{node.name}.{each.name}" for each in methods}
    return names


def missing(walk: Path) -> list[str]:
    """Return the steps whose file, function or class does not exist."""
    return [
        f"{file}:{name}"
        for file, name in steps(walk)
        if not (ROOT / "csrc" / file if file.endswith(".c") else PACKAGE / file).exists()
        or (name and name not in defined(PACKAGE / file))
    ]


def test_every_file_has_its_row() -> None:
    """Check that a row covers every file; a folder covers its contents, and a pattern the matching files."""
    rows = [line.split("|")[1] for line in ARCHITECTURE.read_text("utf-8").splitlines() if line[:1] == "|"]
    named = {name.rstrip("/") for row in rows for name in re.findall(r"`([^`]+)`", row)}
    places = [*PACKAGE.iterdir(), *(ROOT / "csrc").glob("*.c"), ROOT / "csrc" / "windows"]
    rooms = {path.name for path in places if path.name[0] != "_" and path.suffix in ("", ".py", ".c")}
    assert {room for room in rooms if not any(fnmatch(room, name) for name in named)} == set()


@pytest.mark.parametrize("walk", WALKS, ids=[walk.stem for walk in WALKS])
def test_steps_exist(walk: Path) -> None:
    assert len(steps(walk)) > 8
    assert missing(walk) == []


def test_missing_step_is_detected(tmp_path: Path) -> None:
    walk = tmp_path / "walk.md"
    walk.write_text("`poller.py:Poller.take_off`, `nowhere.c`, `poller.py:Poller`, `csrc/line.c`")
    assert missing(walk) == ["poller.py:Poller.take_off", "nowhere.c:"]
