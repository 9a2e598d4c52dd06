"""Run every input of the fuzzing corpora as a regression test. tests/fuzz/run finds new inputs."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import corpora
import pytest
from c_programs import CC, SANITIZERS, STRICT
from harness import HERE, command
from readers import READERS, read

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
