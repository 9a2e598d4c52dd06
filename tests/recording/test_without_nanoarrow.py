"""A machine without nanoarrow can still record."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pyarrow.ipc
import pytest

WITHOUT = "import sys; sys.modules['nanoarrow'] = None; from multidrop.cli import main; sys.exit(main())"


def multidrop(*words: str, folder: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", WITHOUT, *words]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


@pytest.mark.long
@pytest.mark.slow
def test_polling_and_recording_need_no_nanoarrow(tmp_path: Path) -> None:
    for name in ("run.arrows", "run.csv"):
        ran = multidrop("demo", "--seconds", "1", "--out", name, folder=tmp_path)
        assert ran.returncode == 0, ran.stderr
    assert pyarrow.ipc.open_stream(tmp_path / "run.arrows").read_all().num_rows > 5
    assert len((tmp_path / "run.csv").read_text().splitlines()) > 5


@pytest.mark.long
@pytest.mark.slow
def test_reading_without_nanoarrow_names_the_missing_library(tmp_path: Path) -> None:
    multidrop("demo", "--seconds", "1", "--out", "run.arrows", folder=tmp_path)
    for words in (("report", "run.arrows"), ("convert", "run.arrows", "run.csv")):
        ran = multidrop(*words, folder=tmp_path)
        assert ran.returncode == 2
        assert ran.stderr.startswith("multidrop: rows in Arrow's layout")
        assert ran.stderr.count("\n") == 1
    assert not (tmp_path / "run.csv").exists()
