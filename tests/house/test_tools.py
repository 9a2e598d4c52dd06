"""Check the developer tools and the tests: help, names in CI scripts, corpora, mutants, processes, tables."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import harness
import pytest
from commands import BoundProcess
from harness import HERE, command
from lines import PATIENCE
from mutation.edits import mutants
from mutation.trials import core_files
from peers import CC, SANITIZERS, STRICT, require_module
from readers import READERS, read
from tables import table

ROOT = Path(__file__).parents[2]
TESTS = ROOT / "tests"
TOOLS = ROOT / "tools"


@pytest.mark.long
@table("tool", ["bare", "booted", "containers", "foreign", "kernel/build", "musl", "wheels", "wine"])
def test_the_help_of_a_tool_is_the_comment_at_its_start(tool: str) -> None:
    ran = subprocess.run([TOOLS / tool, "--help"], capture_output=True, text=True, check=True, timeout=60)
    assert f"tools/{tool}" in ran.stdout.split()
    assert ran.stdout.isascii()
    assert ran.stderr == ""


BENCHMARKS = [
    f"{path.parent.name}.{path.stem}"
    for path in (ROOT / "bench" / "questions").glob("*/*.py")
    if "def main(" in path.read_text()
]
PRINT_HELP = """
import importlib, sys
from contextlib import suppress
for name in sys.argv[1:]:
    sys.argv = [name, "--help"]
    with suppress(SystemExit):
        importlib.import_module(f"bench.questions.{name}").main()
"""


@pytest.mark.long
def test_each_benchmark_can_be_imported_and_prints_its_help() -> None:
    for library in ("duckdb", "numpy"):
        require_module(library)
    command = [sys.executable, "-c", PRINT_HELP, *BENCHMARKS]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE)
    assert (ran.returncode, ran.stderr) == (0, "")
    assert [name for name in BENCHMARKS if f"usage: {name} " not in ran.stdout] == []


# ---- .ci/run and .ci/nightly ----


CI = "".join((ROOT / ".ci" / name).read_text("utf-8") for name in ("run", "nightly"))


@pytest.mark.long
def test_every_path_in_the_ci_scripts_exists() -> None:
    """After a rename, each pattern and each name in braces must still match a file."""
    code = re.sub(r"(?m)^ *#.*", "", CI)
    patterns = re.findall(r"(?<![\w/$])(?:bench|csrc|docs|tests)/[\w*.,{}/-]+", code)
    echo = subprocess.run(
        ["bash", "-c", f"printf '%s\\n' {' '.join(patterns)}"], cwd=ROOT, capture_output=True, text=True
    )
    scripts = (f"bench/questions/{name.replace('.', '/')}.py" for name in benchmarks())
    paths = {*echo.stdout.splitlines(), *scripts}
    assert len(paths) > 100
    assert [path for path in sorted(paths) if not (ROOT / path).exists()] == []


def benchmarks() -> list[str]:
    here_document = CI.partition("<< END\n")[2].partition("\nEND")[0]
    return [line.split()[0] for line in here_document.splitlines()]


@pytest.mark.long
def test_every_test_name_in_the_ci_scripts_exists() -> None:
    tests = {
        name
        for path in TESTS.glob("**/test_*.py")
        for name in re.findall(r"def (test_\w+)", path.read_text())
    }
    named = set(re.findall(r"(?:::|=)(test_\w+)", CI))
    assert named
    assert named - tests == set()
    chosen = re.findall(r"""(?:-k |measured=|no_room=)["']([^"']+)""", CI)
    words = {word for part in chosen for word in re.findall(r"(?<!\$)\b\w+\b", part)} - {"and", "or", "not"}
    assert len(words) >= 6
    assert [word for word in words if not any(word in test for test in tests)] == []


# ---- fuzzing ----


HARNESSES = sorted(path.stem.removeprefix("fuzz_") for path in HERE.glob("fuzz_*.c"))


@pytest.mark.long
def test_every_parser_has_a_small_fuzz_corpus() -> None:
    assert len(HARNESSES) == 6
    owners = {line.split(" ")[0] for line in harness.CORPUS.read_text("ascii").splitlines()}
    assert owners == {*HARNESSES, *READERS}
    inputs = [data for name in (*HARNESSES, *READERS) for data in harness.load(name).values()]
    assert len(inputs) > 500
    assert sum(map(len, inputs)) < 300_000


@pytest.mark.long
def test_a_fuzz_corpus_is_unpacked_and_saved_unchanged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    harness.unpack("frame", tmp_path / "inputs")
    inputs = {path.name: path.read_bytes() for path in (tmp_path / "inputs").iterdir()}
    text = harness.CORPUS.read_bytes()
    copy = tmp_path / "corpus.txt"
    copy.write_bytes(text)
    monkeypatch.setattr(harness, "CORPUS", copy)
    harness.save("frame", {})
    assert harness.load("frame") == {}
    harness.save("frame", inputs)
    assert copy.read_bytes() == text
    assert harness.load("no such parser") == {}


@pytest.mark.long
@pytest.mark.parametrize("name", HARNESSES)
def test_the_c_core_survives_the_inputs_of_its_fuzz_corpus(tmp_path: Path, name: str) -> None:
    if shutil.which(CC) is None:
        pytest.skip(f"no C compiler ({CC})")
    build = command(name, tmp_path / name, "replay.c", CC, *STRICT, *SANITIZERS)
    built = subprocess.run(build, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    replay = [tmp_path / name, harness.CORPUS, name]
    run = subprocess.run(replay, capture_output=True, text=True, check=False, timeout=60)
    assert run.returncode == 0, run.stderr[-3000:]
    assert run.stderr.split() == list(harness.load(name))


@pytest.mark.long
@pytest.mark.parametrize("name", READERS)
def test_each_reader_survives_the_inputs_of_its_fuzz_corpus(tmp_path: Path, name: str) -> None:
    for data in harness.load(name).values():
        read(name, data, tmp_path)


# ---- mutation ----


EXPLAINED = tomllib.loads((ROOT / "tools" / "mutation" / "explained.toml").read_text("utf-8"))["mutant"]

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
    ";",  # a mutant in which one statement was deleted
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


@pytest.mark.long
@pytest.mark.parametrize(("path", "source", "made"), [("a.c", C, OF_C), ("a.py", PYTHON, OF_PYTHON)])
def test_the_mutation_tool_makes_the_expected_mutants_of_a_source(
    path: str, source: str, made: set[str]
) -> None:
    found = mutants(path, source)
    assert {each.after for each in found} == made
    assert len({each.text for each in found}) == len(found)
    assert {each.function for each in found} == {"clamp" if path == "a.c" else "most"}


@pytest.mark.long
def test_a_mutant_negates_a_whole_condition_of_several_lines() -> None:
    (negated,) = (
        mutant.after for mutant in mutants("a.c", "    if (a\n        || b)\n") if "!(" in mutant.after
    )
    assert negated == "if (!(a || b))"


@pytest.mark.long
@pytest.mark.slow
def test_the_mutants_listed_in_explained_toml_exist() -> None:
    files = {each["file"] for each in EXPLAINED}
    names = {mutant.name for path in files for mutant in mutants(path, (ROOT / path).read_text("utf-8"))}
    for row in EXPLAINED:
        assert row["why"]
        assert (row["file"], row["function"], row["line"], row["becomes"], row.get("nth", 1)) in names


@pytest.mark.long
def test_the_c_files_of_the_mutation_tests_exist() -> None:
    assert all((ROOT / "csrc" / name).exists() for name in core_files(ROOT))
    assert {"frame.c", "posix/waiter.c", "posix/serial.c"} <= {*core_files(ROOT)}


# ---- processes of tests ----


SLEEPS = [sys.executable, "-c", "import time; time.sleep(3600)"]


@pytest.mark.long
def test_a_process_is_killed_if_its_with_block_fails() -> None:
    with pytest.raises(ZeroDivisionError), BoundProcess(SLEEPS) as process:
        raise ZeroDivisionError
    assert process.returncode


@pytest.mark.long
def test_no_test_starts_a_process_with_bare_popen() -> None:
    unbound = "with subprocess." + "Popen("
    assert [str(path) for path in TESTS.rglob("*.py") if unbound in path.read_text("utf-8")] == []


# ---- check that a table test tries every row and names the rows that fail ----


def notes(caught: pytest.ExceptionInfo[BaseExceptionGroup[BaseException]]) -> list[list[str]]:
    return [failure.__notes__ for failure in caught.value.exceptions]


def test_every_failing_row_of_a_test_table_is_reported() -> None:
    tried = []

    @table("number", range(5))
    def is_even(number: int) -> None:
        tried.append(number)
        assert number % 2 == 0

    with pytest.raises(BaseExceptionGroup, match="2 of 5 rows failed") as caught:
        is_even()
    assert tried == [0, 1, 2, 3, 4]
    assert notes(caught) == [["in the row (1,)"], ["in the row (3,)"]]


def test_a_skipped_row_of_a_test_table_fails() -> None:
    """A row also fails if it does not raise the error that the test expects."""

    @table(("one", "other"), [(1, 2), (2, 2), (3, 3)], ids=["a", "b", "c"])
    def differ(one: int, other: int) -> None:
        if one == 3:
            pytest.skip("three")
        with pytest.raises(ZeroDivisionError):
            _ = 1 / (one - other + 1)

    with pytest.raises(BaseExceptionGroup, match="2 of 3 rows failed") as caught:
        differ()
    assert notes(caught) == [["in the row 'b'"], ["in the row 'c'"]]


@table("left", [0, 1])
@table("right", [0, 1])
@pytest.mark.parametrize("sum_", [0, 1, 2])
def test_the_table_decorator_can_be_nested_and_used_with_fixtures(
    left: int, right: int, sum_: int, tmp_path: object
) -> None:
    assert (left + right == sum_) is (sum_ - left == right)


@table("rows", [[], [(1, 2)]], ids=["none", "too wide"])
def test_an_empty_or_ill_formed_test_table_is_rejected(rows: list[tuple[int, int]]) -> None:
    with pytest.raises(AssertionError):
        table(["only"], rows)


# ---- find tests that define an inner function but never call it: these pass without testing anything ----


FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


def never_named(tree: ast.AST) -> list[str]:
    """Return the inner functions that their outer function never names, with line numbers."""
    found = []
    for outer in ast.walk(tree):
        if isinstance(outer, FUNCTIONS):
            named = {node.id for node in ast.walk(outer) if isinstance(node, ast.Name)}
            inner = [node for node in outer.body if isinstance(node, FUNCTIONS)]
            lost = [one for one in inner if one.name not in named and not one.decorator_list]
            found += [f"{one.name} in {outer.name}, line {one.lineno}" for one in lost]
    return found


@pytest.mark.long
def test_every_inner_function_in_tests_is_used() -> None:
    found = {}
    for path in sorted(TESTS.rglob("*.py")):
        if lost := never_named(ast.parse(path.read_text("utf-8"))):
            found[str(path.relative_to(TESTS))] = lost
    assert found == {}


def test_an_unused_inner_function_is_detected() -> None:
    told = "def test_it():\n    async def main(): assert False\n"
    assert never_named(ast.parse(told)) == ["main in test_it, line 2"]
    assert never_named(ast.parse(told + "    run(main())\n")) == []
