"""A plant whose line is simulated with the timing of a real one."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from commands import plant_file
from toy import Toy

from multidrop.sim import Simulator, Wire, simulated, wire


@pytest.fixture
def plant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Yield a plant file with two drives, of which only the first is simulated.

    Each reply arrives in one piece.
    """
    monkeypatch.setattr(wire, "CHUNK", 1.0)
    port = tmp_path / "ports" / "hall-1"
    port.parent.mkdir()
    with Simulator([Wire([simulated(Toy(1))], port=str(port))]):
        yield plant_file(tmp_path, dead=True)


@pytest.fixture(autouse=True)
def _short_measurement(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let `doctor` measure wake-ups for a moment instead of five seconds."""
    monkeypatch.setattr("multidrop.cli.doctor.WAKE_S", 0.02)
