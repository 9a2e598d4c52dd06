"""The C core's own test programs, built by the system's compiler with its sanitizers, and run."""

import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
STRICT = ["-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror"]
SANITIZERS = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
CC = os.environ.get("CC", "cc")
SKIPPED = 77  # the exit status of a test program that cannot test anything here, and says why


def build_and_run(program: Path, *core: str, arguments: Sequence[str] = ()) -> None:
    """The test program of that name, with these parts of the core."""
    if shutil.which(CC) is None:
        pytest.skip(f"no C compiler ({CC})")
    build = [
        CC,
        "-std=c11",
        "-D_DEFAULT_SOURCE",
        "-g",
        "-O1",
        *STRICT,
        *SANITIZERS,
        "-Icsrc",
        f"tests/c/{program.name}.c",
        *(f"csrc/{name}.c" for name in core),
        "-lm",
    ]
    built = subprocess.run([*build, "-o", program], cwd=ROOT, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    run = subprocess.run([program, *arguments], cwd=ROOT, capture_output=True, text=True, check=False)
    if run.returncode == SKIPPED:
        pytest.skip(run.stdout.strip())
    assert run.returncode == 0, run.stdout + run.stderr


def test_core(tmp_path: Path) -> None:
    line = ("line", "reply", "echo", "late", "delay", "counters")
    core = ("checksum", "frame", "reason", "tap", *line, "columns")
    build_and_run(tmp_path / "test_core", *core, arguments=["tests/data/frames.csv"])


def test_the_time_of_day_is_asked_for_again_and_again(tmp_path: Path) -> None:
    build_and_run(tmp_path / "test_row_queue", "row_queue", "columns", "frame", "checksum", "reason")


@pytest.mark.skipif(sys.platform != "linux", reason="others wait by poll")
@pytest.mark.parametrize("program", ["test_waiter", "test_waiter_refused"])
def test_no_wait_is_rounded(tmp_path: Path, program: str) -> None:
    build_and_run(tmp_path / program, "waiter_epoll")
