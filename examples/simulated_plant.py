"""Play the drives of a plant file, so that the examples run without hardware. Not needed with real ports."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from multidrop import Plant, load_plant
from multidrop.sim import Faults, HostileWire, Simulator, simulated


@contextmanager
def simulated_plant(text: str, faults: Faults | None = None) -> Iterator[Plant]:
    """Yield the plant that the text describes; `{ports}` in it is a directory for simulated ports."""
    with TemporaryDirectory() as directory:
        path = Path(directory) / "plant.toml"
        path.write_text(text.replace("{ports}", directory))
        plant = load_plant(path)
        wires = [
            HostileWire(
                [simulated(polled.drive) for polled in line.drives], faults or Faults(), port=line.port
            )
            for line in plant.lines
        ]
        with Simulator(wires):
            yield plant
