"""Check tests/README.md: each promise has a row, and the files, tests and commands that it names exist."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "tests" / "README.md").read_text("utf-8")
PROMISES = (
    "the wire is the limit",
    "the host costs almost nothing",
    "Python never disturbs the cadence",
    "many lines",
    "a busy computer",
    "dead drives cost nothing",
    "noise costs one exchange",
    "a late reply is never taken for another's answer",
    "what is recorded is true",
    "memory is flat",
)
CODE = re.findall(r"`([^`\n]+)`", PAGE)
FILE = r"(?:tests|bench|csrc|src|docs|\.ci)/[\w./]*\w/?"


def rows() -> dict[str, list[str]]:
    """Return the cells of the first table, by promise."""
    table = PAGE.partition("## The promises")[2].partition("\n## ")[0]
    cells = [
        [cell.strip() for cell in line.strip("|").split("|")] for line in re.findall(r"^\|.*", table, re.M)
    ]
    return {promise: others for promise, *others in cells[2:]}


def test_every_promise_of_the_readme_has_a_row_with_its_tests() -> None:
    assert tuple(rows()) == PROMISES
    for _, decided, measured in rows().values():
        assert re.search(r"`tests/\w+/test_\w+\.py`", decided)
        assert re.search(r"bench/?\w*", measured)


def named(pattern: str) -> list[str]:
    return sorted({name for code in CODE for name in re.findall(rf"(?<![\w./]){pattern}", code)})


def test_files_named_on_the_promises_page_exist() -> None:
    paths = named(FILE)
    assert len(paths) > 90
    assert [path for path in paths if not (ROOT / path).exists()] == []


def test_tests_named_on_the_promises_page_exist() -> None:
    """Check that each named test is in the file that the page names before it."""
    missing, number, file = [], 0, ""
    for path, name in re.findall(r"(tests/[\w/]+/test_\w+\.py)|`(test_\w+)`", PAGE):
        file = path or file
        if name and f"def {name}(" not in text_of(file):
            missing.append(f"{file}: {name}")
        number += bool(name)
    assert number > 70
    assert missing == []


@cache
def text_of(file: str) -> str:
    return (ROOT / file).read_text("utf-8")


def script(command: str) -> Path | None:
    """Return the file of this project that a command runs, or None."""
    if module := re.search(r"-m (bench[\w.]+)", command):
        return ROOT / f"{module[1].replace('.', '/')}.py"
    files = [ROOT / file for file in re.findall(FILE, command)]
    return files[0] if files and files[0].suffix == ".py" else None


def test_commands_and_options_named_on_the_promises_page_exist() -> None:
    common = (ROOT / "tests" / "conftest.py").read_text("utf-8")
    commands = {command: file for command in CODE if (file := script(command))}
    assert len(commands) > 90
    for command, file in commands.items():
        sources = file.read_text("utf-8") + common
        for option in re.findall(r"--[\w-]+", command):
            assert f'"{option}"' in sources, command
