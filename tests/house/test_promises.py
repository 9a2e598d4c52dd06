"""Check tests/README.md: each promise has a row, and the files, tests and commands that it names exist."""

from __future__ import annotations

import re
from pathlib import Path

from tables import table

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


def test_every_promise_has_its_row() -> None:
    assert tuple(rows()) == PROMISES
    for _, decided, measured in rows().values():
        assert re.search(r"`tests/\w+/test_\w+\.py`", decided)
        assert re.search(r"bench/?\w*", measured)


def named(pattern: str) -> list[str]:
    return sorted({name for code in CODE for name in re.findall(rf"(?<![\w./]){pattern}", code)})


def test_named_files_exist() -> None:
    paths = named(FILE)
    assert len(paths) > 90
    assert [path for path in paths if not (ROOT / path).exists()] == []


@table("name", named(r"test_\w+(?![\w.])"))
def test_named_tests_exist(name: str) -> None:
    """The test must be in the file that is named last before it."""
    for before in re.findall(rf"^(.*)`{name}`", PAGE, re.MULTILINE):
        file = re.findall(r"tests/[\w/]+/test_\w+\.py", before)[-1]
        assert f"def {name}(" in (ROOT / file).read_text("utf-8")


def script(command: str) -> Path | None:
    """Return the file of this project that a command runs, or None."""
    if module := re.search(r"-m (bench[\w.]+)", command):
        return ROOT / f"{module[1].replace('.', '/')}.py"
    files = [ROOT / file for file in re.findall(FILE, command)]
    return files[0] if files and files[0].suffix == ".py" else None


def test_named_commands_and_options_exist() -> None:
    common = (ROOT / "tests" / "conftest.py").read_text("utf-8")
    commands = {command: file for command in CODE if (file := script(command))}
    assert len(commands) > 90
    for command, file in commands.items():
        sources = file.read_text("utf-8") + common
        for option in re.findall(r"--[\w-]+", command):
            assert f'"{option}"' in sources, command
