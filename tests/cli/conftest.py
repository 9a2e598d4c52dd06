"""Fixtures of simulated lines, and a plant file for one line."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from commands import plant_file
from toy import Status, Toy

from multidrop.sim import Simulator, Wire, simulated, wire
from multidrop.sim.drive import Reason, Refusal, SimulatedDrive
from multidrop.sim.memory import MemoryCell


class Stubborn(SimulatedDrive):
    """A drive that limits acceleration times to 20 s, and refuses reads of its fault."""

    def accept(self, cell: MemoryCell, raw: int) -> int:
        return min(raw, 200) if cell.name == "acceleration_time" else super().accept(cell, raw)

    def read(self, function: int, start: int, count: int) -> list[int]:
        if start <= 4 < start + count:
            raise Refusal(Reason.READ_ADDRESS)
        return super().read(function, start, count)


@pytest.fixture
def toy() -> SimulatedDrive:
    return SimulatedDrive(Toy(1))


@pytest.fixture
def port(toy: SimulatedDrive) -> Iterator[str]:
    """Yield the port of a line without timing, with drives at the addresses 1 and 2."""
    toy["output_frequency"] = 49.9
    toy["output_current"] = 3.25
    toy["mystery"] = 777
    toy["status"] = Status.RUNNING
    toy["acceleration_time"] = 10.0
    with Simulator([Wire([toy, Stubborn(Toy(2))], unpaced=True)]) as simulator:
        yield simulator.wires[0].path


@pytest.fixture
def plant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Yield a plant file with two drives. Only the first is simulated, on a line with real timing."""
    monkeypatch.setattr(wire, "CHUNK", 1.0)
    port = tmp_path / "ports" / "hall-1"
    port.parent.mkdir()
    with Simulator([Wire([simulated(Toy(1))], port=str(port))]):
        yield plant_file(tmp_path, dead=True)


@pytest.fixture(autouse=True)
def _short_measurement(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let `doctor` measure wake-ups for a moment instead of five seconds."""
    monkeypatch.setattr("multidrop.cli.doctor.WAKE_S", 0.02)
