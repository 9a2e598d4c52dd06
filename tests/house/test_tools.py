"""Check the developer tools: command-line mistakes, names in .ci/run, corpora, mutants, tests' processes."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import corpora
import pytest
from c_programs import CC, SANITIZERS, STRICT
from harness import HERE, command
from kills import BoundProcess
from mutation.edits import mutants
from mutation.trials import core_names
from readers import READERS, read
from tables import table

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[2]
TESTS = ROOT / "tests"
TOOLS = ROOT / "tools"
LINUX = "multidrop-0.1.0-cp311-abi3-manylinux2014_x86_64.manylinux_2_17_x86_64.whl"
WINDOWS = "multidrop-0.1.0-cp311-abi3-win_amd64.whl"

# Arguments to the message that they print, in a folder with two wheels, a file and an empty folder.
MISTAKES = {
    "bare": "bare: it takes RELEASE WHEEL, and was given nothing",
    f"bare stable {LINUX} {LINUX}": f"bare: it takes RELEASE WHEEL, and was given: stable {LINUX} {LINUX}",
    "bare stable none.whl": "bare: there is no wheel none.whl: make one with `tools/wheels`",
    "bare stable file": "bare: file is not a wheel: its name must end with .whl",
    f"bare stable {WINDOWS}": f"bare: {WINDOWS} is the wrong wheel: use *manylinux*_x86_64.whl",
    "booted": "booted: it takes RELEASE WHEEL, and was given nothing",
    "booted stable none.whl": "booted: there is no wheel none.whl: make one with `tools/wheels`",
    f"booted stable {WINDOWS}": f"booted: {WINDOWS} is the wrong wheel: use *manylinux*_x86_64.whl",
    "foreign": "foreign: it takes MACHINE WHEEL [WORD]..., and was given nothing",
    f"foreign sparc {LINUX}": "foreign: unknown machine sparc: name arm64 or armhf",
    "foreign arm64 none.whl": "foreign: there is no wheel none.whl: make one with `tools/wheels`",
    f"foreign arm64 {LINUX}": f"foreign: {LINUX} is the wrong wheel: use *manylinux*_aarch64.whl",
    "foreign armhf empty": "foreign: empty is not a wheel: its name must end with .whl",
    "kernel/build": "build: it takes FOLDER, and was given nothing",
    "musl": "musl: it takes make FOLDER WHEEL [PACKAGE]..., or FOLDER WORD..., and was given nothing",
    "musl make new": "musl: make takes FOLDER WHEEL [PACKAGE]..., and was given: new",
    "musl make empty none.whl": "musl: empty exists already: name a new folder",
    "musl make new none.whl": "musl: there is no wheel none.whl: make one with `tools/wheels`",
    f"musl make new {LINUX}": f"musl: {LINUX} is the wrong wheel: use *musllinux*_x86_64.whl",
    "musl none -V": "musl: none is not a folder made by `tools/musl make`",
    "musl empty -V": "musl: empty is not a folder made by `tools/musl make`",
    "wine": "wine: it takes make FOLDER WHEEL [PACKAGE]..., test FOLDER, or FOLDER WORD..., and was given",
    "wine make new": "wine: make takes FOLDER WHEEL [PACKAGE]..., and was given: new",
    "wine make empty none.whl": "wine: empty exists already: name a new folder",
    "wine make new none.whl": "wine: there is no wheel none.whl: make one with `tools/wheels`",
    f"wine make new {LINUX}": f"wine: {LINUX} is the wrong wheel: use *win_amd64.whl",
    "wine test": "wine: test takes FOLDER, and was given nothing",
    "wine test empty": "wine: empty is not a folder made by `tools/wine make`",
    "wine test none": "wine: none is not a folder made by `tools/wine make`",
    "wine build new": "wine: build is not a folder made by `tools/wine make`",
    "wine file -V": "wine: file is not a folder made by `tools/wine make`",
    "wheels dist": "wheels: error: unrecognized arguments: dist",
    "wheels --only sparc": "wheels: error: argument --only: invalid choice: 'sparc'",
    "wheels --out file": "wheels: error: file is not a folder: name an empty or a new one with --out",
    "wheels --out .": "wheels: error: . contains sdists or wheels already: name an empty folder with --out",
    "wheels --out new --python pithon": "wheels: error: there is no interpreter pithon to try a wheel with",
    "wheels --out new --only windows --python python3": "wheels: error: --python tries the wheel of x86_64",
}


@pytest.mark.parametrize("words", MISTAKES)
def test_mistake_prints_one_sentence_and_starts_nothing(tmp_path: Path, words: str) -> None:
    for name in (LINUX, WINDOWS, "file"):
        (tmp_path / name).touch()
    (tmp_path / "empty").mkdir()
    there = sorted(tmp_path.rglob("*"))
    tool, *others = words.split()
    program = [sys.executable] if tool == "wheels" else []
    ran = subprocess.run(
        [*program, TOOLS / tool, *others],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert ran.returncode == 2, ran.stderr
    assert ran.stdout == ""
    *usage, sentence = ran.stderr.splitlines()
    assert sentence.startswith(MISTAKES[words])
    assert not usage or (tool == "wheels" and usage[0].startswith("usage: "))
    assert sorted(tmp_path.rglob("*")) == there


@table("tool", ["bare", "booted", "foreign", "kernel/build", "musl", "wheels", "wine"])
def test_help_is_the_header_of_the_tool(tool: str) -> None:
    ran = subprocess.run([TOOLS / tool, "--help"], capture_output=True, text=True, check=True, timeout=60)
    assert f"tools/{tool} " in ran.stdout
    assert ran.stdout.isascii()
    assert ran.stderr == ""


# ---- .ci/run ----


CI = (ROOT / ".ci" / "run").read_text("utf-8")


def test_paths_in_ci_run_exist() -> None:
    """A pattern without a file, and a name that a brace expands to, must not be left behind by a rename."""
    code = re.sub(r"(?m)^ *#.*", "", CI)
    patterns = re.findall(r"(?<![\w/$])(?:bench|csrc|docs|tests)/[\w*.,{}/-]+", code)
    echo = subprocess.run(
        ["bash", "-c", f"printf '%s\\n' {' '.join(patterns)}"], cwd=ROOT, capture_output=True, text=True
    )
    paths = {*echo.stdout.splitlines(), *(f"bench/questions/{name}.py" for name in benchmarks())}
    assert len(paths) > 100
    assert [path for path in sorted(paths) if not (ROOT / path).exists()] == []


def benchmarks() -> list[str]:
    here_document = CI.partition("<< END\n")[2].partition("\nEND")[0]
    return [line.split()[0] for line in here_document.splitlines()]


def test_test_names_in_ci_run_exist() -> None:
    tests = {
        name
        for path in TESTS.glob("**/test_*.py")
        for name in re.findall(r"def (test_\w+)", path.read_text())
    }
    named = set(re.findall(r"(?:::|=)(test_\w+)", CI))
    assert len(named) >= 3
    assert named - tests == set()
    chosen = re.findall(r"""(?:-k |measured=|no_room=)["']([^"']+)""", CI)
    words = {word for part in chosen for word in re.findall(r"(?<!\$)\b\w+\b", part)} - {"and", "or", "not"}
    assert len(words) >= 6
    assert [word for word in words if not any(word in test for test in tests)] == []


# ---- fuzzing ----


HARNESSES = sorted(path.stem.removeprefix("fuzz_") for path in HERE.glob("fuzz_*.c"))


def test_every_parser_has_a_small_corpus() -> None:
    assert len(HARNESSES) == 6
    assert {path.stem for path in corpora.FOLDER.iterdir()} == {*HARNESSES, *READERS}
    inputs = [data for name in (*HARNESSES, *READERS) for data in corpora.load(name).values()]
    assert len(inputs) > 500
    assert sum(map(len, inputs)) < 300_000


def test_a_corpus_is_unpacked_and_saved_unchanged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    corpora.unpack("frame", tmp_path / "inputs")
    inputs = {path.name: path.read_bytes() for path in (tmp_path / "inputs").iterdir()}
    text = (corpora.FOLDER / "frame.txt").read_bytes()
    monkeypatch.setattr(corpora, "FOLDER", tmp_path)
    corpora.save("frame", inputs)
    assert (tmp_path / "frame.txt").read_bytes() == text
    assert corpora.load("no such parser") == {}


@pytest.mark.long
@pytest.mark.parametrize("name", HARNESSES)
def test_the_core_survives_its_corpus(tmp_path: Path, name: str) -> None:
    if shutil.which(CC) is None:
        pytest.skip(f"no C compiler ({CC})")
    build = command(name, tmp_path / name, "replay.c", CC, *STRICT, *SANITIZERS)
    built = subprocess.run(build, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    replay = [tmp_path / name, corpora.FOLDER / f"{name}.txt"]
    run = subprocess.run(replay, capture_output=True, text=True, check=False, timeout=60)
    assert run.returncode == 0, run.stderr[-3000:]
    assert run.stderr.split() == list(corpora.load(name))


@pytest.mark.parametrize("name", READERS)
def test_a_reader_survives_its_corpus(tmp_path: Path, name: str) -> None:
    for data in corpora.load(name).values():
        read(name, data, tmp_path)


# ---- mutation ----


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


# ---- processes of tests ----


SLEEPS = [sys.executable, "-c", "import time; time.sleep(3600)"]


def test_failing_block_kills_its_process() -> None:
    with pytest.raises(ZeroDivisionError), BoundProcess(SLEEPS) as process:
        raise ZeroDivisionError
    assert process.returncode


def test_no_test_starts_an_unbound_process() -> None:
    unbound = "with subprocess." + "Popen("
    assert [str(path) for path in TESTS.rglob("*.py") if unbound in path.read_text("utf-8")] == []
