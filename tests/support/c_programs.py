"""C programs, built with the core's files under the sanitizers, and run."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
STRICT = ["-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror"]
SANITIZERS = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
CC = os.environ.get("CC", "cc")
SKIPPED = 77  # the exit status of a test program that cannot test anything here, and says why


def build_and_run(
    program: Path, *core: str, arguments: Sequence[str] = (), sanitizers: Sequence[str] = SANITIZERS
) -> None:
    """The test program of that name, with these parts of the core."""
    if shutil.which(CC) is None:
        pytest.skip(f"no C compiler ({CC})")
    build = [
        CC,
        "-std=c11",
        "-D_DEFAULT_SOURCE",
        "-g",
        "-O0",  # compiled in half the time; .ci/run has it otherwise too
        *STRICT,
        *sanitizers,
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
