"""The C core's own test program, built by the system's compiler with its sanitizers, and run."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = [
    "tests/c/test_core.c",
    *(f"csrc/{name}.c" for name in ("checksum", "frame", "reason", "tap", "line", "tally", "columns")),
]
STRICT = ["-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror"]
SANITIZERS = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
CC = os.environ.get("CC", "cc")


def test_core(tmp_path: Path) -> None:
    if shutil.which(CC) is None:
        pytest.skip(f"no C compiler ({CC})")
    program = tmp_path / "test_core"
    build = [
        CC,
        "-std=c11",
        "-D_DEFAULT_SOURCE",
        "-g",
        "-O1",
        *STRICT,
        *SANITIZERS,
        "-Icsrc",
        *SOURCES,
        "-lm",
    ]
    built = subprocess.run([*build, "-o", program], cwd=ROOT, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    run = subprocess.run(
        [program, "tests/data/frames.csv"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stdout + run.stderr
