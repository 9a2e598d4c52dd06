"""Check that mutants are the intended mistakes, and that each explained mutant still exists."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
from mutation.edits import mutants
from mutation.trials import core_names

ROOT = Path(__file__).parents[2]
EXPLAINED = tomllib.loads((ROOT / "tests" / "mutation" / "explained.toml").read_text("utf-8"))["mutant"]

C = """\
static int clamp(int *at, int most) /* not < mutated */
{
    if (*at < most)
        return -1;
    *at += 0x0F;
    return most ? 1 : *at;
}
"""
OF_C = {
    "if (*at <= most)",
    "if (*at >= most)",
    "if (!(*at < most))",
    ";",  # return -1; *at += 0x0F; return most ? 1 : *at;
    "return 1;",
    "return 0;",
    "return -0;",
    "return -2;",
    "return -1;",
    "*at -= 0x0F;",
    "*at += 16;",
    "*at += 14;",
    "return !(most) ? 1 : *at;",
    "return most ? 2 : *at;",
    "return most ? 0 : *at;",
}

PYTHON = '''\
def most(found: list[int] | None, limit: int = 9) -> int:
    """Not - mutated."""
    if not found:
        return 0
    at = min(found) + limit  # nor < this
    return at
'''
OF_PYTHON = {
    "def most(found: list[int] | None, limit: int = 10) -> int:",
    "def most(found: list[int] | None, limit: int = 8) -> int:",
    "if found:",
    "if (not (not found)):",
    "return 1",
    "return -1",
    "pass",
    "pass # nor < this",
    "at = max(found) + limit # nor < this",
    "at = min(found) - limit # nor < this",
    "return None",
}


@pytest.mark.parametrize(("path", "source", "made"), [("a.c", C, OF_C), ("a.py", PYTHON, OF_PYTHON)])
def test_mutants_of_a_source(path: str, source: str, made: set[str]) -> None:
    found = mutants(path, source)
    assert {each.after for each in found} == made
    assert len({each.text for each in found}) == len(found)
    assert {each.function for each in found} == {"clamp" if path == "a.c" else "most"}


def test_a_condition_of_several_lines_is_negated_as_a_whole() -> None:
    (negated,) = (
        mutant.after for mutant in mutants("a.c", "    if (a\n        || b)\n") if "!(" in mutant.after
    )
    assert negated == "if (!(a || b))"


@pytest.mark.slow
def test_explained_mutants_exist() -> None:
    files = {each["file"] for each in EXPLAINED}
    names = {mutant.name for path in files for mutant in mutants(path, (ROOT / path).read_text("utf-8"))}
    for row in EXPLAINED:
        assert row["why"]
        assert (row["file"], row["function"], row["line"], row["becomes"], row.get("nth", 1)) in names


def test_mutation_trials_compile_existing_files() -> None:
    assert all((ROOT / "csrc" / f"{name}.c").exists() for name in core_names(ROOT))
    assert {"frame", "waiter_epoll", "wakeup"} <= {*core_names(ROOT)}
