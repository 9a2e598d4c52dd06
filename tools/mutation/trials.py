"""A copy of the source tree in which mutants are tried one by one; the original is never changed."""

from __future__ import annotations

import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).parents[2]
PATIENCE = 20  # s of CPU time, so that other load does not count; the slowest trial takes 8 s
OUTPUT = "output.txt"  # file in a tree with the output of the last command of a trial
CC = os.environ.get("CC", "cc")
FLAGS = ["-std=gnu11", "-w", "-Icsrc"]  # the standard that csrc/CMakeLists.txt selects
SANITIZED = [
    *FLAGS,
    "-O1",
    "-ftrivial-auto-var-init=pattern",
    "-fsanitize=address,undefined",
    "-fno-sanitize-recover=all",
]
MODULE = [*FLAGS, "-O2", "-fPIC", "-DPy_LIMITED_API=0x030b0000"]

# Remove the import hook of an editable installation: it would import the original, not the copy under test.
PYTEST = """
import sys
sys.meta_path = [finder for finder in sys.meta_path if isinstance(finder, type)]
sys.path.insert(0, "src")
import pytest
sys.exit(pytest.main(sys.argv[1:]))
"""

Trial = Callable[[Path, str], str | None]  # takes tree and file; None: the mutant survives


def by_test_core(tree: Path, path: str) -> str | None:
    """Try a mutant with test_core.c, the C core's test program, under sanitizers."""
    if _status(tree, CC, *SANITIZED, "-c", path, "-o", f"checked/{Path(path).stem}.o"):
        return "no program"
    _must(tree, CC, *SANITIZED, *_objects(tree, "checked", "test_core"), "-lm", "-o", "test_core")
    return _end(_status(tree, "./test_core", "tests/data/frames.csv"))


def by_compiler(tree: Path, path: str) -> str | None:
    """Return "same code" for an equivalent mutant: the compiler emits the same code as for the original."""
    compiled = f"{Path(path).stem}.o"
    _must(tree, CC, *MODULE, "-c", path, "-o", f"module/{compiled}")
    same = (tree / "module" / compiled).read_bytes() == (tree / "original" / compiled).read_bytes()
    return "same code" if same else None


def by_test_frame(tree: Path, path: str) -> str | None:
    """Try a mutant with the Python tests of frames and of a line; `by_compiler` has compiled it already."""
    _link(tree)
    return _pytest(
        tree, *(f"tests/core/test_{name}.py" for name in ("frame", "capture", "learning", "line", "tcp"))
    )


def by_test_schedule(tree: Path, path: str) -> str | None:
    return _pytest(tree, "tests/planning/test_schedule.py", "tests/polling/test_slow_drives.py")


TRIALS: dict[str, tuple[Trial, ...]] = {
    "csrc/body.c": (by_test_core, by_compiler, by_test_frame),
    "csrc/frame.c": (by_test_core, by_compiler, by_test_frame),
    "src/multidrop/planning/schedule.py": (by_test_schedule,),
}


def core_files(tree: Path) -> list[str]:
    """Return the paths in csrc/ of the C core's source files on Linux."""
    text = (tree / "csrc" / "CMakeLists.txt").read_text()
    (sources,) = re.findall(r"set\(SOURCES ([^)]+)\)", text)
    _windows, system = re.findall(r"set\(SYSTEM ([^)]+)\)", text)
    return sources.replace("${SYSTEM}", system).split()


def _objects(tree: Path, directory: str, main: str) -> list[str]:
    return [f"{directory}/{Path(name).stem}.o" for name in (main, *core_files(tree))]


def _link(tree: Path) -> None:
    _must(tree, CC, "-shared", *_objects(tree, "module", "_core"), "-o", "src/multidrop/_core.abi3.so")


def _pytest(tree: Path, *tests: str) -> str | None:
    options = ("-q", "-x", "-n", "0", "-p", "no:cacheprovider", "--hypothesis-seed=0")
    return _end(_status(tree, sys.executable, "-c", PYTEST, *options, *tests))


def _end(status: int) -> str | None:
    return {0: None, -signal.SIGXCPU: "without end"}.get(status, "killed")


def _status(tree: Path, *command: str) -> int:
    """Return the exit status of a command, which is killed after PATIENCE seconds of CPU time.

    The command's output is written to the file OUTPUT in the tree."""
    with (tree / OUTPUT).open("wb") as output:
        return subprocess.run(
            command,
            cwd=tree,
            check=False,
            stdout=output,
            stderr=subprocess.STDOUT,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (PATIENCE, PATIENCE + 1)),
        ).returncode


def _must(tree: Path, *command: str) -> None:
    subprocess.run(command, cwd=tree, check=True)


@contextmanager
def scratch() -> Iterator[Path]:
    """Yield a copy of the source tree, in which all C files are already compiled."""
    with tempfile.TemporaryDirectory() as directory:
        tree = Path(directory)
        for name in ("csrc", "src", "tests"):
            shutil.copytree(ROOT / name, tree / name, ignore=shutil.ignore_patterns("__pycache__", "*.so"))
        shutil.copy(ROOT / "pyproject.toml", tree)
        for name in ("checked", "module"):
            (tree / name).mkdir()
        _must(tree, sys.executable, "csrc/cdef.py", "module/_core.c")
        headers = f"-I{sysconfig.get_path('include')}"
        sources = {Path(name).stem: f"csrc/{name}" for name in core_files(tree)}
        for name, source in {"test_core": "tests/c/test_core.c", **sources}.items():
            _must(tree, CC, *SANITIZED, "-c", source, "-o", f"checked/{name}.o")
        for name, source in {"_core": "module/_core.c", **sources}.items():
            _must(tree, CC, *MODULE, headers, "-c", source, "-o", f"module/{name}.o")
        shutil.copytree(tree / "module", tree / "original")
        _link(tree)
        yield tree


def attempt(tree: Path, path: str, text: str) -> str | None:
    """Run the trials of a file whose content is replaced by `text`; restore the file afterwards.

    Return how the mutant ended, such as "killed", or None if it survives."""
    original = (tree / path).read_text()
    (tree / path).write_text(text)
    try:
        return next((end for trial in TRIALS[path] if (end := trial(tree, path))), None)
    finally:
        (tree / path).write_text(original)
