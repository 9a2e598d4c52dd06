"""The house's rules of words: what a name, a docstring and a line may be."""

from __future__ import annotations

import re
from collections import defaultdict
from pathlib import Path

import pytest
from sources import ROOMS, ROOT, comments, files, loop_variables, place
from tables import table

import multidrop

pytestmark = pytest.mark.long

MOST_CHARACTERS = 110
QUESTIONS = re.compile(r"(What|Whether|Of|As|How|Who|If|Where|When)\b")
CLASS = re.compile(r"^ *class (\w+)", re.MULTILINE)
DOCSTRING = re.compile(r'^ *r?"""(.*)', re.MULTILINE)
TEXT = (".py", ".c", ".h", ".md", ".toml")
PAGES = [path for path in ROOT.glob("*") if path.suffix in TEXT]


def test_no_class_name_stands_for_two_things() -> None:
    places: dict[str, list[Path]] = defaultdict(list)
    for path in files("src"):
        for name in CLASS.findall(path.read_text("utf-8")):
            places[name].append(path.relative_to(ROOT))
    assert len(places) > 500
    assert {name: found for name, found in places.items() if len(found) > 1} == {}


@pytest.mark.parametrize("room", ["src", "tests", "bench"])
def test_no_docstring_begins_with_a_question(room: str) -> None:
    """Nor any other text in three quotes that has its line to itself."""
    found = [
        f"{path.relative_to(ROOT)}: {begin[1]}"
        for path in files(room)
        for begin in DOCSTRING.finditer(path.read_text("utf-8"))
        if QUESTIONS.match(begin[1])
    ]
    assert found == []


def test_no_comment_of_a_header_begins_with_a_question() -> None:
    found = [
        f"{place(path, line)}: {text.splitlines()[0]}"
        for path in files("csrc", suffixes=(".h",))
        for line, text in comments(path)
        if QUESTIONS.match(text)
    ]
    assert found == []


@table("room", [*ROOMS, "."])
def test_no_line_is_too_long(room: str) -> None:
    """A row of a Markdown table may be longer, because Markdown cannot break it."""
    found = [
        f"{place(path, number)}: {len(line)} characters"
        for path in (PAGES if room == "." else files(room, suffixes=TEXT))
        for number, line in enumerate(path.read_text("utf-8").splitlines(), 1)
        if len(line) > MOST_CHARACTERS and not is_long_by_nature(path, line)
    ]
    assert found == []


def is_long_by_nature(path: Path, line: str) -> bool:
    """Return True for rows of tables, and for code of C programs that are not the core's."""
    if path.suffix == ".md":
        return line.startswith("|")
    return path.suffix in (".c", ".h") and path.parts[-2] != "csrc" and not re.search(r"/\*|^ \*", line)


def test_no_loop_variable_is_called_it() -> None:
    found = [
        place(path, line) for path in files("src") for line, name in loop_variables(path) if name == "it"
    ]
    assert found == []


def test_every_public_name_is_in_the_reference() -> None:
    reference = (ROOT / "docs" / "reference" / "api.md").read_text("utf-8")
    missing = [name for name in multidrop.__all__ if not re.search(rf"\b{name}\b", reference)]
    assert missing == []
