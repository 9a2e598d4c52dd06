"""Every input that a fuzzer found worth keeping, run again: what was once mended stays so.

tests/fuzz/run looks for new ones.
"""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest
from c_programs import CC, SANITIZERS, STRICT
from harness import HERE, command
from readers import READERS, read

CORPUS = HERE / "corpus"
HARNESSES = sorted(path.stem.removeprefix("fuzz_") for path in HERE.glob("fuzz_*.c"))


def kept(name: str) -> list[Path]:
    return sorted((CORPUS / name).iterdir())


def test_every_parser_has_inputs_that_were_kept() -> None:
    assert len(HARNESSES) == 6
    assert {path.name for path in CORPUS.iterdir()} == {*HARNESSES, *READERS}
    assert sum(path.stat().st_size for name in (*HARNESSES, *READERS) for path in kept(name)) < 300_000


@pytest.mark.long
@pytest.mark.parametrize("name", HARNESSES)
def test_the_core_takes_what_was_kept(tmp_path: Path, name: str) -> None:
    if shutil.which(CC) is None:
        pytest.skip(f"no C compiler ({CC})")
    build = command(name, tmp_path / name, "replay.c", CC, *STRICT, *SANITIZERS)
    built = subprocess.run(build, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    run = subprocess.run(
        [tmp_path / name, *kept(name)], capture_output=True, text=True, check=False, timeout=60
    )
    assert run.returncode == 0, run.stderr[-3000:]


@pytest.mark.parametrize("name", READERS)
def test_a_reader_takes_or_refuses_what_was_kept(tmp_path: Path, name: str) -> None:
    for path in kept(name):
        read(name, path.read_bytes(), tmp_path)
