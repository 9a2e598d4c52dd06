"""A plant whose line is simulated by a process of its own."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from commands import plant_file, running


@pytest.fixture
def plant(tmp_path: Path) -> Iterator[Path]:
    """A plant file whose port is there, with one of its two drives."""
    with running("simulate", plant_file(tmp_path), "--ports", tmp_path / "ports", "--unpaced") as (_, out):
        assert out.readline() == f"ready hall-1 {tmp_path}/ports/hall-1\n"
        yield plant_file(tmp_path, dead=True)
