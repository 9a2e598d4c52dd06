"""Check the rules for the project's wording: names, docstrings and line lengths."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest
from sources import ROOMS, ROOT, comments, files, loop_variables, place
from tables import table

import multidrop

pytestmark = pytest.mark.long

MOST_CHARACTERS = 110
CLASS = re.compile(r"^ *class (\w+)", re.MULTILINE)
TEXT = (".py", ".c", ".h", ".md", ".toml")
PAGES = [path for path in ROOT.glob("*") if path.suffix in TEXT]


def test_no_two_classes_have_the_same_name() -> None:
    places: dict[str, list[Path]] = defaultdict(list)
    for path in files("src"):
        for name in CLASS.findall(path.read_text("utf-8")):
            places[name].append(path.relative_to(ROOT))
    assert len(places) > 500
    assert {name: found for name, found in places.items() if len(found) > 1} == {}


# Patterns of constructions that readers stumble over. Each key says what to write instead.
CONSTRUCTIONS = {
    "a noun": r"\bwhat (?:is|was|are|were|has|had|it|they|comes|came|leaves|may|must|can|cannot|else)\b",
    "if or when": r", where |\bwhere (?:it|there|none|that|a|the|no|nothing|they|one|its|all|several)\b",
    "the one who acts": r"\b(?:nobody|somebody|nothing)\b",
    "its, or the noun": r"\b(?:of it|of them|of which|of these|of those|of whom)\b",
    "start": r"\b(?:begin|begins|began|begun|beginning)\b",
    "is not a": r"\b(?:is|are|was|were|be|as) no (?!longer\b|more\b)[a-z]+",
    "report or say": r"\b(?:tell|tells|told|telling)\b",
    "no longer": r"\b(?:any more|no more)\b",
    "again, during, recently": r"\b(?:anew|amid|lately|meanwhile|in vain|beforehand)\b",
    "be, or be at rest": r"\b(?:stand|stands|stood) (?!-|by\b)",
    "check": r"\b(?:a look|looks|looked at|to look at)\b",
    "the program": r"\b(?:whoever|who asks|who is|who has|he|him|his)\b",
    "because": r", for (?:it|they|there|that|this|the|a|no|which)\b",
}
STUMBLES = re.compile("|".join(CONSTRUCTIONS.values()), re.IGNORECASE)
MOST_STUMBLES = 6.0  # limit of hits per 1,000 words of the text of one folder
PROSE_ROOMS = sorted(
    {path.name for path in (ROOT / "src" / "multidrop").iterdir() if path.is_dir() and path.name[0] != "_"}
)


def python_text(path: Path) -> Iterator[str]:
    """Yield the docstrings and comments of a Python file; regular expressions take a tenth of ast's time."""
    source = path.read_text("utf-8")
    yield from re.findall(r'^ *"""(.*?)"""', source, re.MULTILINE | re.DOTALL)
    yield from re.findall(r"(?:^ *|  )#.*", source, re.MULTILINE)


def text_of(path: Path) -> str:
    if path.suffix == ".py":
        return "\n".join(python_text(path))
    if path.suffix == ".md":
        return re.sub(
            r"`[^`]*`", "", re.sub(r"^ *```.*?^ *```$", "", path.read_text("utf-8"), flags=re.M | re.S)
        )
    return "\n".join(text for _, text in comments(path))


def stumbles(paths: list[Path]) -> float:
    """Return the hits of CONSTRUCTIONS per 1,000 words of the files' text."""
    texts = [text_of(path) for path in paths]
    words = sum(len(re.findall(r"[A-Za-z']+", text)) for text in texts)
    return 1000 * sum(len(STUMBLES.findall(text)) for text in texts) / max(words, 1)


def room_files(room: str) -> list[Path]:
    if room in PROSE_ROOMS:
        return files(f"src/multidrop/{room}")
    return files(room, suffixes=(".py", ".c", ".h", ".md"))


@pytest.mark.parametrize("room", [*PROSE_ROOMS, *(room for room in ROOMS if room != "src")])
def test_each_package_stays_below_the_limit_of_unclear_phrases(room: str) -> None:
    assert stumbles(room_files(room)) <= MOST_STUMBLES


def test_unclear_phrases_are_counted_per_1000_words(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("Nothing is told of it, where nobody looks at `what is` there.\n")
    assert stumbles([page]) == pytest.approx(1000 * 6 / 10)


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
    """Return True if the line may be long: a row of a table, a text of the gateway's page, or code of a C
    program outside the core.
    """
    if path.suffix == ".md" or path.name == "texts.toml":
        return line.startswith(("|", "ru = ", "zh = ", '["'))
    return path.suffix in (".c", ".h") and "csrc" not in path.parts and not re.search(r"/\*|^ \*", line)


def test_no_loop_variable_has_the_name_it() -> None:
    found = [
        place(path, line) for path in files("src") for line, name in loop_variables(path) if name == "it"
    ]
    assert found == []


def test_every_public_name_is_in_the_reference() -> None:
    reference = (ROOT / "docs" / "reference" / "api.md").read_text("utf-8")
    missing = [name for name in multidrop.__all__ if not re.search(rf"\b{name}\b", reference)]
    assert missing == []
