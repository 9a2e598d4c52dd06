"""pytest fixtures for tests of your own programs: simulated drives with faults, fast time and replays.

pytest loads this module in every session. So it imports the simulator only when a test uses a fixture.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from multidrop.drive.family import Drive
    from multidrop.plant.model import Plant
    from multidrop.sim import Faults, FaultyWire, SimulatedDrive


@pytest.hookimpl(tryfirst=True)
def pytest_load_initial_conftests(early_config: pytest.Config) -> None:
    """Keep pytest from rewriting multidrop's assertions, as it does by default in packages with a plugin."""
    hook: Any = early_config.pluginmanager.rewrite_hook
    getattr(hook, "_must_rewrite", set()).discard("multidrop")


@dataclass(frozen=True)
class SimulatedPlant:
    """A plant at simulated ports, with its simulated lines and drives by name."""

    plant: Plant
    lines: Mapping[str, FaultyWire]
    drives: Mapping[str, SimulatedDrive]

    @property
    def ports(self) -> dict[str, str]:
        """The simulated port of each line, for `Plant.with_ports` or `--port LINE=PORT`."""
        return {name: wire.path for name, wire in self.lines.items()}


@pytest.fixture
def simulated_plant() -> Iterator[Callable[..., SimulatedPlant]]:
    """Return a function that simulates a plant until the test ends: `simulated_plant("plant.toml")`.

    `faults=Faults(...)` are the faults of lines and drives. With `speed=20` simulated time passes 20 times as
    fast. `capture="hall.pcapng"` replays the values in a capture.
    """
    with ExitStack() as stack:
        yield partial(_simulate, stack)


@pytest.fixture
def simulated_line() -> Iterator[Callable[..., FaultyWire]]:
    """Return a function that simulates drives on one line until the test ends: `simulated_line(YD1000(1))`.

    The function also takes the keywords of `simulated_plant`. A program opens the line's `path`.
    """
    with ExitStack() as stack:
        yield partial(_simulate_line, stack)


def _simulate_line(
    stack: ExitStack,
    *drives: Drive,
    faults: Faults | None = None,
    speed: float = 1.0,
    capture: Path | str | None = None,
) -> FaultyWire:
    from multidrop.plant.model import Plant, PlantLine, PolledDrive

    line = PlantLine("line", "pty", drives=[PolledDrive(drive) for drive in drives])
    return _simulate(stack, Plant([line]), faults=faults, speed=speed, capture=capture).lines["line"]


def _simulate(
    stack: ExitStack,
    plant: Plant | Path | str,
    *,
    faults: Faults | None = None,
    speed: float = 1.0,
    capture: Path | str | None = None,
) -> SimulatedPlant:
    from multidrop.capture.replay import Replay
    from multidrop.plant.model import Plant
    from multidrop.sim import Faults, FaultyWire, Simulator, simulated

    loaded = plant if isinstance(plant, Plant) else Plant.load(plant)
    faults = faults or Faults()
    for name in faults.drives:
        loaded.find_drive(name)  # called only because it raises ValueError for an unknown drive
    make = simulated if capture is None else Replay(capture, loaded).drive
    # a pty cannot be reopened under its old name
    serial = "socket://127.0.0.1:0" if faults.hang_up else "pty"
    lines = {}
    for line in loaded.lines:
        port = "tcp://127.0.0.1:0" if line.port.lower().startswith("tcp:") else serial
        sims = [make(polled.drive) for polled in line.drives]
        lines[line.name] = FaultyWire(sims, faults, name=line.name, port=port)
    stack.enter_context(Simulator([*lines.values()], speed=speed))
    drives = {sim.drive.name: sim for wire in lines.values() for sim in wire.drives}
    return SimulatedPlant(loaded.with_ports({name: wire.path for name, wire in lines.items()}), lines, drives)
